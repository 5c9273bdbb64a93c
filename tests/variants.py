"""Variants of a test: some of them by default, all of them with the slow part."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def variants(every: Iterable[Any], default: Callable[[Any], bool] | Iterable[Any]) -> list[Any]:
    """`default`: those that run always, or what tells them. Where each variant compiles programs of its own,
    one of each kind."""
    if not callable(default):
        names = tuple(default)
        default = lambda variant: variant in names
    values = lambda variant: variant if isinstance(variant, tuple) else (variant,)
    return [v if default(v) else pytest.param(*values(v), marks=pytest.mark.slow) for v in every]
