"""Stored ensembles that are damaged at random: a change is named or has no effect, and mended."""

import dataclasses
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import manifold_jax as mj

from .checks import Fault


Damage = Callable[[Path, np.random.Generator], None]


def _lose(file: Path, rng: np.random.Generator) -> None:
    del rng
    file.unlink()


def _cut(file: Path, rng: np.random.Generator) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(rng.integers(len(content)))])


def _flip(file: Path, rng: np.random.Generator) -> None:
    content = bytearray(file.read_bytes())
    content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    file.write_bytes(content)


def _clear(file: Path, rng: np.random.Generator) -> None:
    del rng
    file.write_bytes(bytes(file.stat().st_size))


def _lengthen(file: Path, rng: np.random.Generator) -> None:
    file.write_bytes(file.read_bytes() + rng.bytes(int(rng.integers(1, 20))))


DAMAGES = (_lose, _cut, _flip, _clear, _lengthen)


@dataclasses.dataclass(frozen=True)
class Store:
    """An ensemble of `size` trajectories in chunks of `chunk`, with `saved` values of each."""

    index: int
    seed: int
    size: int
    chunk: int
    saved: int
    dimension: int

    @property
    def spec(self) -> str:
        return (
            f"{self.size} trajectories, chunks of {self.chunk}, {self.saved} of R^{self.dimension}"
        )

    def stream(self, out: Path, resume: bool = False) -> mj.StoredEnsemble:
        n = self.dimension
        skew = np.triu(np.cos(1.0 + np.arange(n * n)).reshape(n, n), 1)
        turn = jnp.asarray(skew - skew.T)

        def sample(number: Any, key: Any) -> Any:
            y0 = jax.random.normal(key, (n,))
            # Every eleventh trajectory fails.
            return jnp.where(number % 11 == 5, jnp.nan, y0 / jnp.linalg.norm(y0)), {"turn": turn}

        sphere = mj.Constraint(lambda t, y, args: y @ y - 1)
        return mj.stream_ensemble(
            sample,
            self.size,
            out,
            dfx.ODETerm(lambda t, y, args: args["turn"] @ y),
            mj.Projected(dfx.Heun(), sphere),
            0.0,
            1.0,
            0.1,
            saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, self.saved)),
            max_steps=50,
            chunk=self.chunk,
            seed=self.index,
            progress=False,
            resume=resume,
        )


def store(index: int, seed: int) -> Store:
    rng = np.random.default_rng((seed, index, 20))
    size = int(rng.integers(20, 200))
    chunk = int(rng.integers(8, 64))
    return Store(index, seed, size, chunk, int(rng.integers(1, 5)), int(rng.integers(2, 6)))


def examine(one: Store, draws: int, faults: list[Fault]) -> dict[str, Any]:
    """`draws` copies, each with one to three files that are damaged."""
    rng = np.random.default_rng((one.seed, one.index, 21))
    counts = dict.fromkeys(("named", "without effect", "refused"), 0)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        one.stream(whole)
        expected = _contents(mj.open_ensemble(whole))
        for k in range(draws):
            copy = Path(folder) / f"copy{k}"
            shutil.copytree(whole, copy)
            what = _damage(copy, rng)
            outcome = _outcome(one, copy, expected, what, faults)
            counts[outcome] = counts.get(outcome, 0) + 1
            shutil.rmtree(copy)
    return {"cases": draws} | counts


def _damage(copy: Path, rng: np.random.Generator) -> str:
    words = []
    for _ in range(int(rng.integers(1, 4))):
        files = sorted(f for f in copy.rglob("*") if f.is_file() and f.stat().st_size > 0)
        file = files[int(rng.integers(len(files)))]
        damage = DAMAGES[int(rng.integers(len(DAMAGES)))]
        damage(file, rng)
        words.append(f"{damage.__name__.strip('_')} {file.relative_to(copy)}")
    return ", ".join(words)


def _outcome(
    one: Store, copy: Path, expected: list[np.ndarray], what: str, faults: list[Fault]
) -> str:
    """What opening it says, and what resuming makes of it."""
    outcome = "without effect"
    try:
        stored = mj.open_ensemble(copy)
        if stored.finished < one.size:
            outcome = "unfinished"  # as after a run that was stopped, and it says so
        elif not _same(_contents(stored), expected):
            faults.append(Fault("silent", f"other numbers after {what}"))
    except (ValueError, FileNotFoundError):
        outcome = "named"
    except Exception as error:
        faults.append(Fault("crash", f"{type(error).__name__} on opening after {what}"))
    try:
        if not _same(_contents(one.stream(copy, resume=True)), expected):
            faults.append(Fault("silent", f"other numbers when resumed after {what}"))
    except (ValueError, FileExistsError):
        outcome = "refused"  # of a description that is lost
        if "zarr.json" not in what:
            faults.append(Fault("refused", f"not resumed after {what}"))
    except Exception as error:
        faults.append(Fault("crash", f"{type(error).__name__} on resuming after {what}"))
    return outcome


def _contents(stored: mj.StoredEnsemble) -> list[np.ndarray]:
    return [_values(part) for part in (stored.ts, stored.ys, stored.stats, stored.result)]


def _values(part: Any) -> np.ndarray:
    """Of an array, or of all arrays of a group, one after the other."""
    if hasattr(part, "shape"):
        return np.asarray(part[:], dtype=float).ravel()
    return np.concatenate([_values(each) for _, each in sorted(part.members())])


def _same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    same = lambda a, b: np.array_equal(a, b, equal_nan=True)
    return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
