"""Terms with a changed vector field, and terms that depend on the direction of time."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

from .._base.types import Args, RealScalarLike, Y
from .._base.user_functions import call_traced_once


class DirectedTerm(dfx.AbstractTerm):
    """`dy = (f(t, y) + s d(t, y)) dt` with `s` the sign of the step: damping `d` that damps backwards
    in time, too. The vector field returns `(f, d)`; `rate` (1/time) is that of the fastest decay."""

    vector_field: Callable
    rate: RealScalarLike

    def vf(self, t: RealScalarLike, y: Y, args: Args) -> tuple[Y, Y]:
        return self.vector_field(t, y, args)

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs: Any) -> RealScalarLike:
        return t1 - t0

    def prod(self, vf: tuple[Y, Y], control: RealScalarLike) -> Y:
        field, damping = vf
        sign = jnp.sign(control)
        return jtu.tree_map(lambda f, d: (control * (f + sign * d)).astype(f.dtype), field, damping)


class RewrittenTerm(dfx.AbstractTerm):
    """`term` with the vector field `field(term, t, y, args)`."""

    term: dfx.AbstractTerm
    field: Callable

    def vf(self, t: RealScalarLike, y: Y, args: Args) -> Any:
        return self.field(self.term, t, y, args)

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs: Any) -> Any:
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf: Any, control: Any) -> Y:
        return self.term.prod(vf, control)

    def is_vf_expensive(self, t0: RealScalarLike, t1: RealScalarLike, y: Y, args: Args) -> bool:
        return self.term.is_vf_expensive(t0, t1, y, args)


class TracedOnce(eqx.Module):
    """A vector field that is traced once."""

    vector_field: Callable

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        return call_traced_once(self.vector_field, t, y, args)


def traced_once(terms: Any) -> Any:
    """Return the terms with vector fields that are traced once."""
    is_leaf = lambda x: type(x) is dfx.ODETerm  # a subclass may have another field
    once = lambda x: dfx.ODETerm(TracedOnce(x.vector_field)) if is_leaf(x) else x
    return jtu.tree_map(once, terms, is_leaf=is_leaf)


def rewrite_terms(terms: Any, rewrite: Callable[[dfx.AbstractTerm], dfx.AbstractTerm]) -> Any:
    """Rewrite each term of a pytree of terms, also inside `MultiTerm`s."""
    is_leaf = lambda x: isinstance(x, dfx.AbstractTerm) and not isinstance(x, dfx.MultiTerm)
    return jtu.tree_map(rewrite, terms, is_leaf=is_leaf)


def has_several(terms: Any) -> bool:
    """Whether a pytree of terms has a sum of terms in it."""
    is_leaf = lambda x: isinstance(x, dfx.MultiTerm)
    return any(is_leaf(leaf) for leaf in jtu.tree_leaves(terms, is_leaf=is_leaf))
