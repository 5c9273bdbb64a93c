"""Docstrings as `help` shows them."""

import inspect
import re
from collections.abc import Iterable, Mapping
from typing import Any


_LINK = re.compile(r"\[(`[^`]+`)\]\[[\w.]*\]")


def unlink_docstrings(*namespaces: Mapping[str, Any]) -> None:
    """Turn what is a link on the site into the name alone, in the docstrings of all public functions, classes
    and their members, in place."""
    for namespace in namespaces:
        public = [x for name, x in namespace.items() if not name.startswith("_")]
        for thing in public:
            if inspect.isfunction(thing) or inspect.isclass(thing):
                for x in (thing, *_members(thing)):
                    if isinstance(x.__doc__, str) and "][" in x.__doc__:
                        x.__doc__ = _LINK.sub(r"\1", x.__doc__)


def _members(thing: Any) -> Iterable[Any]:
    """The functions and properties of a class of this library."""
    if inspect.isclass(thing) and thing.__module__.startswith("manifold_jax"):
        for name in vars(thing):
            member = getattr(thing, name, None)
            member = getattr(member, "__func__", member)
            if inspect.isfunction(member) or isinstance(member, property):
                yield member
