"""Ensembles of any size, written to disk chunk by chunk."""

import errno
import operator
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._base.errors import clear_errors, refuse_old_names
from ..._base.types import RealScalarLike
from ..._solve.setup import Consistent
from ..lanes.solution import messages_of
from ..stored.arrays import (
    clear_partial,
    clear_write_errors,
    create_arrays,
    create_group,
    is_partial,
    named,
    write,
    zarr,
)
from ..stored.faults import faults_of_chunks, faults_of_descriptions, finished_chunks
from ..stored.lock import LOCK_FILE, only_writer
from ..stored.store import stored_at, StoredEnsemble
from .devices import default_lanes
from .progress import ChunkMeter
from .sampling import drawn
from .settings import check_settings, settings_of
from .solve_ensemble import solve_ensemble


# Indices of trajectories are 32-bit integers unless JAX has 64 bits enabled.
_LARGEST_SIZE = 2**31 - 1


@refuse_old_names(out="path")
@clear_errors
def stream_ensemble(
    sample: Callable[[Array, Array], tuple[Any, Any]],
    size: int,
    path: str | Path,
    terms: dfx.AbstractTerm,
    solver: dfx.AbstractSolver,
    t0: RealScalarLike | Callable[[Array, Array], Any],
    t1: RealScalarLike | Callable[[Array, Array], Any],
    dt0: RealScalarLike | None,
    *,
    saveat: dfx.SaveAt = dfx.SaveAt(t1=True),
    stepsize_controller: dfx.AbstractStepSizeController = dfx.ConstantStepSize(),
    max_steps: int = 4096,
    event: dfx.Event | None = None,
    resets: Any = (),
    max_resets: int = 100,
    lanes: int | None = None,
    consistent: Consistent = "project",
    chunk: int = 8192,
    seed: int = 0,
    resume: bool = False,
    progress: bool = True,
) -> StoredEnsemble:
    """Solve for more trajectories than fit into memory, or than you can afford to lose: generate them
    chunk by chunk, solve them with [`solve_ensemble`][] and write them to a folder.

    ```python
    def sample(index, key):  # of one trajectory, any JAX code
        angle = jax.random.uniform(key, minval=-3.0, maxval=3.0)
        q = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        return (q, jnp.zeros(2)), problem.args

    stored = mj.stream_ensemble(
        sample, 1_000_000, "swings", problem.terms, solver, 0.0, 10.0, None,
        stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
    )
    stored.ys["0"][:100]  # positions at the end, of the first hundred
    ```

    Memory is that of one chunk, whatever the `size`. A run that was interrupted, also by a
    killed process, is continued by the same call with `resume=True`: at most one chunk is computed
    again, and the files are bit-identical to those of a run without interruption (on the same kind of
    device and with the same versions). Every file is written under another name and then renamed.

    **Arguments:**

    - `sample`: `(index, key) -> (y0, args)`, the initial value and the parameters of the trajectory
        numbered `index`, from 0 on; `key` is `jax.random.fold_in(jax.random.key(seed), index)`.
        Traced and mapped over: write it with `jax.numpy`. It must depend on nothing else that changes.
        Leaves of `args` that it does not compute are common to all.
    - `size`: the number of trajectories.
    - `path`: the folder; made if it does not exist, and refused if it is not empty unless `resume`.
    - `terms`, `solver`, `dt0`, `saveat`, `stepsize_controller`, `max_steps`, `event`, `resets`, `max_resets`, `lanes`,
        `consistent`: as of [`solve_ensemble`][].
    - `t0`, `t1`: common to all, or functions `(index, key)` like `sample`.
    - `chunk`: how many trajectories are solved and written together. Much larger than `lanes`, as
        lanes run empty at the end of each chunk.
    - `seed`: of the random numbers.
    - `resume`: continue the run in `path`, or begin one if the folder is empty. Chunks that are missing or
        damaged are computed again. Refused if the settings stored there differ, `terms`, constraint
        and `sample` included, except for the function that a `jax.pure_callback` calls.
    - `progress`: show how far it is, trajectories per second, and how many have failed.

    **Returns:**

    A [`StoredEnsemble`][], as [`open_ensemble`][] opens it later, from which arrays are read in parts.
    A trajectory that fails has a result code there, and `stored.failures()` lists the first.

    **Raises:**

    As `solve_ensemble`; `FileExistsError` for a folder that is not empty, `BlockingIOError` for one that
    another process is writing, `OSError` if it cannot be written to, `ValueError` for other settings, `ImportError` without zarr
    (`pip install "manifold_jax[ensemble]"`).
    """
    zarr()
    size = _positive("size", size)
    chunk = min(_positive("chunk", chunk), size)
    key, folder = _key(seed), Path(path)
    _check_functions(sample, t0, t1)
    given = {
        "sample": sample,
        "terms": terms,
        "solver": solver,
        "t0": t0,
        "t1": t1,
        "dt0": dt0,
        "saveat": saveat,
        "stepsize_controller": stepsize_controller,
        "max_steps": max_steps,
        "lanes": default_lanes(None) if lanes is None else lanes,
        "consistent": consistent,
    }
    if event is not None:
        given["event"] = event
    if resets:
        given |= {"resets": resets, "max_resets": max_resets}
    call = lambda start: (given, key, jnp.asarray(start), size, chunk)
    examples = eqx.filter_eval_shape(_solve_chunk, *call(0))
    named(examples)  # refuses names before anything is written
    lowered = _solve_chunk.lower(*call(0))
    settings = {"size": size, "chunk": chunk, "seed": int(seed), **given}
    described = settings_of(settings, lowered.as_text()) | {"checksums": "crc32c"}
    with clear_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with only_writer(folder):
        stored = _opened(folder, described, messages_of(solver, bool(resets)), examples, resume)
        _compute(stored, lowered, call, progress)
    return stored


def _compute(stored: StoredEnsemble, lowered: Any, call: Callable, progress: bool) -> None:
    """Compute the chunks that are missing or damaged."""
    size, chunk = stored.size, stored.chunk
    damaged = {fault.chunk for fault in faults_of_chunks(stored.group)}
    whole = [k for k in finished_chunks(stored.group) if k not in damaged]
    starts = [k * chunk for k in range(-(-size // chunk)) if k not in whole]
    count = lambda start: min(chunk, size - start)
    finished = size - sum(map(count, starts))
    failed = sum(np.count_nonzero(stored.result[k * chunk : (k + 1) * chunk]) for k in whole)
    with ChunkMeter(size, finished, int(failed), progress) as meter:
        if starts:
            meter.compiling()
            program = lowered.compile()
            meter.begin()
        for start in starts:
            values = program(*call(start))
            write(stored.group, start, values)
            meter.advance(count(start), int(np.count_nonzero(values["result"][: count(start)])))


@eqx.filter_jit
def _solve_chunk(
    given: dict[str, Any], key: Array, start: Array, size: int, chunk: int
) -> dict[str, Any]:
    """Solve a chunk, filled up with copies of the last trajectory: all chunks share one program."""
    index = jnp.minimum(start + jnp.arange(chunk), size - 1)
    samples = drawn(given["sample"], given["t0"], given["t1"], key, index)
    options = {name: x for name, x in given.items() if name != "sample"} | samples
    solution = solve_ensemble(**options)
    result = solution.reasons().astype(jnp.int8)
    values = {"ts": solution.ts, "ys": solution.ys, "stats": solution.stats, "result": result}
    return values if solution.resets is None else values | {"resets": vars(solution.resets)}


def _opened(
    out: Path, settings: dict[str, Any], messages: Sequence[str], examples: Any, resume: bool
) -> StoredEnsemble:
    """Open the folder, new or existing, with these settings and all of its arrays."""
    with clear_write_errors(out):
        files = [file for file in out.iterdir() if file.name != LOCK_FILE]
    if all(resume and is_partial(file) for file in files):
        stored = StoredEnsemble(create_group(out, settings, messages, examples))
    elif not resume:
        raise FileExistsError(
            errno.EEXIST,
            f"`path={str(out)!r}` is not empty: take another folder, or `resume=True` to continue the ensemble there.",
        )
    else:
        stored = stored_at(out, "r+")
        if stored is None:
            raise FileExistsError(
                errno.EEXIST,
                f"`path={str(out)!r}` is not empty, and holds no ensemble to continue: there is no `zarr.json` of one.",
            )
        check_settings(out, stored.settings, settings)
    clear_partial(out)
    with clear_write_errors(out):
        for fault in faults_of_descriptions(out, dict(stored.group.attrs)):
            (out / fault.file).unlink(missing_ok=True)
        create_arrays(stored.group, stored.size, stored.chunk, examples)
    return stored


def _positive(name: str, value: Any) -> int:
    try:
        number = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = 0
    if not 1 <= number <= _LARGEST_SIZE:
        raise ValueError(
            f"`{name}` must be a positive integer, at most {_LARGEST_SIZE}, got {value!r}."
        )
    return number


def _key(seed: Any) -> Array:
    try:
        return jax.random.key(operator.index(seed))
    except (TypeError, OverflowError) as error:
        raise ValueError(f"`seed` must be an integer of 64 bits, got {seed!r}.") from error


def _check_functions(sample: Any, t0: Any, t1: Any) -> None:
    if not callable(sample):
        raise TypeError(
            "`sample` must be a function `(index, key) -> (y0, args)` that makes one trajectory, got "
            f"{type(sample).__name__}. Arrays of all of them are for `mj.solve_ensemble`."
        )
    for name, t in (("t0", t0), ("t1", t1)):
        if not callable(t) and np.ndim(t) > 0:
            raise ValueError(
                f"`{name}` must be one number, or a function `(index, key)` of each trajectory."
            )
