"""Dense, banded and sparse linear algebra, and the Newton iterations on it."""
