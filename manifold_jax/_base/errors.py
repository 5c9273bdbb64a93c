"""Readable messages for errors that occur while a compiled function runs."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, cast, TypeVar

import diffrax as dfx
import equinox as eqx


Function = TypeVar("Function", bound=Callable)


def clear_errors(function: Function) -> Function:
    """Wrap a function made by `equinox.filter_jit`. The message of an error comes first, where a log
    keeps it, and last, where a terminal shows it; a call with wrong arguments is told the signature;
    for an ensemble differentiated in forward mode the message says what to write."""
    signature, name = inspect.signature(function), getattr(function, "__name__", "")

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        try:
            return function(*args, **kwargs)
        except eqx.EquinoxRuntimeError as error:
            raise eqx.EquinoxRuntimeError(_message_first_and_last(str(error))) from None
        except TypeError as error:
            _check_call(name, signature, args, kwargs)
            if "custom_vjp" in str(error) and _is_reverse(signature.parameters, kwargs):
                raise TypeError(_FORWARDS) from error
            raise

    return cast(Function, call)  # editors show the arguments


_FORWARDS = (
    "The default `adjoint` of ensembles has derivatives in reverse mode (`jax.grad`, `jax.vjp`, `jax.jacrev`). For forward mode "
    "(`jax.jvp`, `jax.jacfwd`, `jax.linearize`) pass `adjoint=diffrax.ForwardMode()`."
)


def _is_reverse(parameters: Any, kwargs: Any) -> bool:
    return "adjoint" in parameters and not isinstance(kwargs.get("adjoint"), dfx.ForwardMode)


def _message_first_and_last(text: str) -> str:
    """Return the message around the stack, without the advice on debugging that Equinox appends."""
    stack, found, rest = text.rpartition("equinox.EquinoxRuntimeError: ")
    message, _, _ = rest.partition("\n-------------------\n")
    message = message.strip()
    return f"{message}\n\n{stack.strip()}\n\n{message}" if found else text


def _check_call(name: str, signature: inspect.Signature, args: Any, kwargs: Any) -> None:
    try:
        signature.bind(*args, **kwargs)
    except TypeError as error:
        names = ", ".join(signature.parameters)
        raise TypeError(f"`mj.{name}` takes the arguments `({names})`: {error}.") from None


def refuse_old_names(**names: str) -> Callable[[Function], Function]:
    """Return a decorator that makes renamed arguments raise with their new name, `old="new"`."""

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            __tracebackhide__ = True
            for old in names.keys() & kwargs.keys():
                raise TypeError(f"`{old}` has been renamed: write `{names[old]}=`.")
            return function(*args, **kwargs)

        return cast(Function, call)

    return decorate


def listed(names: list[str], most: int = 8) -> str:
    """Join names for a message."""
    text = ", ".join(f"`{name}`" for name in names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"
