"""Programs around the library: the command line, comparisons, certificates, films."""
