"""Functions of the user: refused where they are given, not where they are first called."""

import inspect
from typing import Any


def check_function(name: str, function: Any, call: str, *keywords: str, advice: str = "") -> None:
    """Refuse what cannot be called like `call`, for example `g(t, y, args)`: with that many
    arguments, and `keywords` for a `**kwargs` at their end."""
    if not callable(function):
        advice = f" {advice}" if advice else ""
        raise TypeError(
            f"`{name}` must be a callable `{call}`, got {type(function).__name__}.{advice}"
        )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some that are not written in Python have none
        return
    arguments = call[call.index("(") + 1 : -1].removesuffix(", **kwargs").split(", ")
    try:
        signature.bind(*arguments, **dict.fromkeys(keywords))
    except TypeError as error:
        raise TypeError(
            f"`{name}` must be a callable `{call}`, got one with the arguments `{signature}`: {error}."
        ) from None
