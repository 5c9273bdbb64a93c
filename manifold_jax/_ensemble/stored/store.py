"""Ensembles on disk: arrays in a folder, in the format Zarr."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import zarr
from .faults import (
    described,
    Fault,
    faults_of_chunks,
    faults_of_descriptions,
    finished_chunks,
    in_words,
)


class StoredEnsemble:
    """An ensemble in a folder: [`stream_ensemble`][] writes it, [`open_ensemble`][] opens it.

    Nothing is read before it is asked for: `stored.ys[:100]` reads the first hundred. Where a state
    is a tree, `stored.ys` is a group of arrays, by their names: `stored.ys["0"][:100]` for the
    first of a tuple, `stored.ys["angle"]` for one of a named tuple or a dictionary.

    - `group`: the folder as a `zarr.Group`, of the arrays below.
    - `ts`, `ys`, `stats`: as of [`EnsembleSolution`][], `zarr.Array`s or groups of them.
    - `resets`: those of [`EnsembleSolution`][], if there are any.
    - `result`: result codes, 0 for success, -1 for trajectories that have not been computed yet;
        `messages` has their meaning.
    - `settings`: the settings of the run.
    - `faults()`: which of its files are missing or damaged.
    - `size`, `chunk`, `finished`: how many trajectories it has at its end, in one piece, and by now.
    - `num_failed`: how many of those that are finished failed.
    """

    def __init__(self, group: Any):
        self.group = group

    ts = property(lambda self: self.group["ts"])
    ys = property(lambda self: self.group["ys"])
    stats = property(lambda self: self.group["stats"])
    resets = property(lambda self: self.group.get("resets"))
    result = property(lambda self: self.group["result"])

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.group.attrs["settings"])

    @property
    def messages(self) -> list[str]:
        return list(self.group.attrs["messages"])

    @property
    def size(self) -> int:
        return int(self.group.attrs["settings"]["size"])

    @property
    def chunk(self) -> int:
        return int(self.group.attrs["settings"]["chunk"])

    @property
    def finished(self) -> int:
        """The number of trajectories computed so far; `result` is the last array of a chunk."""
        ends = ((k + 1) * self.chunk for k in finished_chunks(self.group))
        return sum(self.chunk - max(0, end - self.size) for end in ends)

    def faults(self) -> list[Fault]:
        """Return the files that are missing or damaged, reading all; `str` of a fault describes it."""
        path = Path(self.group.store.root)
        return faults_of_descriptions(path, dict(self.group.attrs)) or faults_of_chunks(self.group)

    @property
    def num_failed(self) -> int:
        return sum(int(np.count_nonzero(codes)) for _, codes in self._codes())

    def failures(self, most: int = 10) -> list[tuple[int, str]]:
        """Return indices and reasons of the first that failed, as [`EnsembleSolution`][] does."""
        out: list[tuple[int, str]] = []
        for start, codes in self._codes():
            for i in np.flatnonzero(codes)[: most - len(out)]:
                out.append((start + int(i), self.messages[codes[i]]))
            if len(out) >= most:
                break
        return out

    def failures_by_reason(self, most: int = 3) -> dict[str, tuple[int, list[int]]]:
        """Return for each reason how many failed, and the indices of the first."""
        counts: dict[int, int] = {}
        first: dict[int, list[int]] = {}
        for start, codes in self._codes():
            for code in np.unique(codes[codes != 0]):
                numbers = np.flatnonzero(codes == code)
                counts[int(code)] = counts.get(int(code), 0) + numbers.size
                known = first.setdefault(int(code), [])
                known += [start + int(i) for i in numbers[: most - len(known)]]
        return {self.messages[code]: (counts[code], first[code]) for code in sorted(counts)}

    def _codes(self) -> Iterator[tuple[int, np.ndarray]]:
        for k in finished_chunks(self.group):
            start = k * self.chunk
            yield start, np.asarray(self.result[start : start + self.chunk])

    def __repr__(self) -> str:
        return f"StoredEnsemble({self.finished} of {self.size} trajectories, {self.group.store})"


def open_ensemble(path: str | Path, *, check: bool = True) -> StoredEnsemble:
    """Open an ensemble that [`stream_ensemble`][] has written, or is writing.

    **Arguments:**

    - `path`: its folder. Without this library, `zarr.open_group(path)` opens the same.
    - `check`: read all of its files once, and refuse if some are missing or damaged. Otherwise nothing
        but its description is read: a chunk that is missing reads as NaN (as -1 in `result`),
        one that is damaged is an error of zarr's, and `faults()` of the result lists them.

    **Returns:**

    A [`StoredEnsemble`][].

    **Raises:**

    `FileNotFoundError` if there is none; `ValueError` that names what is missing or damaged;
    `ImportError` without zarr.
    """
    stored = stored_at(Path(path))
    if stored is None:
        raise FileNotFoundError(f"`path={str(path)!r}` has no ensemble of `mj.stream_ensemble`.")
    if check and (faults := stored.faults()):
        raise ValueError(
            f"`path={str(path)!r}`: {in_words(faults, stored.chunk, stored.size)}. Call `mj.stream_ensemble` as before with "
            "`resume=True`, which computes them again, or open what is left with `check=False`."
        )
    return stored


def stored_at(path: Path, mode: str = "r") -> StoredEnsemble | None:
    """Open an ensemble without checks; `None` if there is none."""
    package = zarr()
    if described(path) is None:
        return None
    return StoredEnsemble(package.open_group(path, mode=mode))
