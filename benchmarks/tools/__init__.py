"""What benchmarks share: timing, tables, pictures and problems."""
