"""Dense, banded and sparse linear algebra, and Newton iterations."""
