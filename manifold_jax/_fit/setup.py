"""The start of a fit: checks of options, and the objective with its scales."""

from typing import Any

import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx

from .data import Records
from .model import Piece, Simulator
from .objective import Objective
from .optimize import Options


# Number of unknowns of a trajectory beyond which one reverse sweep is cheaper than forward sweeps.
_MANY_UNKNOWNS = 50


def refuse_tracers(**given: Any) -> None:
    # Inside `jit`, constants turn into tracers as soon as they are used.
    named = [(f"`{name}` is", value) for name, value in given.items()]
    for what, value in [*named, ("all numbers are", jnp.zeros(()) + 0)]:
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jtu.tree_leaves(value)):
            raise TypeError(
                f"`fit` cannot be called inside `jax.jit`, `vmap` or a derivative ({what} "
                "traced there): its loop runs in Python and looks at numbers. Call it outside; its "
                "steps are compiled, and many trajectories are records of one fit. Inside, write "
                "your loss with `mj.diffeqsolve`, and take its `jax.grad` or give it to "
                "`optimistix.least_squares`."
            )


def check_initial(simulator: Simulator, grid: tuple[int, ...]) -> None:
    y0, transform = simulator.y0, simulator.transform
    y0 = y0(transform.unravel(transform.start)) if callable(y0) else y0
    if y0 is None or not simulator.many:
        return
    for leaf in jtu.tree_leaves(y0):
        if np.shape(leaf)[:1] != grid[:1]:
            raise ValueError(
                f"`y0` must have a leading axis of {grid[0]} records as `ts` has, got a leaf of shape "
                f"{np.shape(leaf)}."
            )


def check_options(options: Options, loss: Any, segments: Any, records: Records) -> None:
    optimizer, by_gradient = options.optimizer, options.by_gradient
    squares = isinstance(optimizer, optx.AbstractLeastSquaresSolver)
    if not by_gradient and not squares and not isinstance(optimizer, optx.AbstractMinimiser):
        raise TypeError(
            "`optimizer` must be an Optimistix least-squares solver or minimizer, or an Optax "
            f"optimizer such as `optax.adam(1e-2)`, got {type(optimizer).__name__}."
        )
    if loss is not None and squares:
        raise ValueError(
            "`loss` is no sum of squares that a least-squares solver could use. Write "
            "`optimizer=optx.BFGS(rtol=1e-6, atol=1e-6)` or an Optax optimizer."
        )
    if segments != 1 and not squares:
        raise ValueError(
            "`segments` (multiple shooting) needs a least-squares optimizer and no `loss`."
        )
    for name in ("steps", "patience", "starts"):
        value = getattr(options, name)
        if type(value) is not int or value < 1:
            raise ValueError(f"`{name}` must be a positive whole number, got {value!r}.")
    size, count = options.batch_size, records.ts.shape[0]
    if size is None:
        return
    if not by_gradient:
        raise ValueError("`batch_size` needs an Optax optimizer: `optimizer=optax.adam(1e-2)`.")
    if type(size) is not int or not 1 <= size <= count:
        raise ValueError(
            f"`batch_size` must be a whole number from 1 to {count}, the number of records (an "
            f"empty batch has nothing to fit), got {size!r}."
        )


def make_objective(
    simulator: Simulator,
    records: Records,
    pieces: Piece,
    loss: Any,
    fit_initial: bool,
    options: Options,
) -> Objective:
    unknowns, d = simulator.transform.start.size, pieces.basis.shape[-1]
    first = np.asarray(pieces.first)
    free = np.flatnonzero(~first | fit_initial)
    joints = np.flatnonzero(~np.roll(first, -1))
    # A gap counts as much as a residual of the same relative size.
    known = records.weights > 0
    size = np.sqrt(np.mean(records.data[known] ** 2))
    states = np.sqrt(np.mean(np.asarray(pieces.guess) ** 2))
    scale = np.sqrt(np.mean(records.weights[known] ** 2)) * size
    dtype = simulator.transform.start.dtype
    zeros = jtu.tree_map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), records.observed)
    return Objective(
        simulator=simulator,
        pieces=pieces,
        free=jnp.asarray(free),
        joints=jnp.asarray(joints),
        stiffness=jnp.asarray(scale / states if states > 0 else 1.0, dtype),
        shift=jnp.zeros((joints.size, d), dtype),
        penalty=jnp.ones((), dtype),
        loss=loss,
        unravel=jfu.ravel_pytree(zeros)[1],
        reverse=options.by_gradient and unknowns + d > _MANY_UNKNOWNS,
    )
