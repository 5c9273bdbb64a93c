"""Ensembles on the disk: arrays in a folder, in the format Zarr."""

import contextlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.tree_util as jtu
import numpy as np


# Marks in `result` the trajectories that are not there yet.
_MISSING = -1
# Files that were being written when the process was killed.
_PARTIAL = re.compile(r"[^.]*\.[0-9a-f]{32}\.partial")


def zarr() -> Any:
    """The package, which is not needed for anything else."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            "Ensembles are written to the disk by zarr (version 3.1.6 or newer), which is not installed: "
            '`pip install zarr`, or install `"manifold_jax[ensemble]"`.'
        ) from error
    return zarr


class StoredEnsemble:
    """An ensemble in a folder: [`stream_ensemble`][] writes it, [`open_ensemble`][] opens it.

    Nothing is read before it is asked for: `stored.ys[:100]` reads the first hundred. Where a state
    is a tree, `stored.ys` is a group of arrays, by their names: `stored.ys["0"][:100]` for the
    first of a tuple, `stored.ys["angle"]` for one of a named tuple or a dictionary.

    - `group`: the folder as a `zarr.Group`, of the arrays below.
    - `ts`, `ys`, `stats`: as of [`EnsembleSolution`][], `zarr.Array`s or groups of them.
    - `result`: numbers of what happened, 0 where all is well, -1 for what has not been computed yet;
        `messages` says what they mean.
    - `settings`: what it was computed with.
    - `size`, `chunk`, `finished`: how many trajectories it has at its end, in one piece, and by now.
    - `num_failed`: how many of those that are finished failed.
    """

    def __init__(self, group: Any):
        self.group = group

    @property
    def ts(self) -> Any:
        return self.group["ts"]

    @property
    def ys(self) -> Any:
        return self.group["ys"]

    @property
    def stats(self) -> Any:
        return self.group["stats"]

    @property
    def result(self) -> Any:
        return self.group["result"]

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
        """Chunks are written one after the other, `result` as the last array of each."""
        if "result" not in self.group:
            return 0
        return min(self.size, self.chunk * int(self.result.nchunks_initialized))

    @property
    def num_failed(self) -> int:
        return sum(int(np.count_nonzero(codes)) for _, codes in self._codes())

    def failures(self, most: int = 10) -> list[tuple[int, str]]:
        """Numbers and reasons of the first that failed, as of [`EnsembleSolution`][]."""
        out: list[tuple[int, str]] = []
        for start, codes in self._codes():
            for i in np.flatnonzero(codes)[: most - len(out)]:
                out.append((start + int(i), self.messages[codes[i]]))
            if len(out) >= most:
                break
        return out

    def failures_by_reason(self, most: int = 3) -> dict[str, tuple[int, list[int]]]:
        """For each reason how many failed, and the numbers of the first."""
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
        for start in range(0, self.finished, self.chunk):
            yield start, np.asarray(self.result[start : start + self.chunk])

    def __repr__(self) -> str:
        return f"StoredEnsemble({self.finished} of {self.size} trajectories, {self.group.store})"


def open_ensemble(path: str | Path) -> StoredEnsemble:
    """Open an ensemble that [`stream_ensemble`][] has written, or is writing.

    **Arguments:**

    - `path`: its folder. Without this library, `zarr.open_group(path)` opens the same.

    **Returns:**

    A [`StoredEnsemble`][]; nothing but its description has been read.

    **Raises:**

    `FileNotFoundError` if there is none; `ImportError` without zarr.
    """
    stored = stored_at(Path(path))
    if stored is None:
        raise FileNotFoundError(f"`path={str(path)!r}` has no ensemble of `mj.stream_ensemble`.")
    return stored


def stored_at(path: Path, mode: str = "r") -> StoredEnsemble | None:
    """`None` if there is none."""
    package = zarr()
    if not (path / "zarr.json").is_file():
        return None
    group = package.open_group(path, mode=mode)
    return StoredEnsemble(group) if "settings" in group.attrs else None


def created(path: Path, settings: dict[str, Any], messages: Sequence[str]) -> StoredEnsemble:
    """Its settings come first, so that whatever a folder has belongs to some."""
    attributes = {"settings": settings, "messages": list(messages)}
    with clear_write_errors(path):
        return StoredEnsemble(zarr().create_group(path, attributes=attributes))


def is_partial(file: Path) -> bool:
    return _PARTIAL.fullmatch(file.name) is not None


def clear_partial(path: Path) -> None:
    with clear_write_errors(path):
        for file in filter(is_partial, list(path.rglob("*.partial"))):
            file.unlink()


def ensure_arrays(stored: StoredEnsemble, examples: Any) -> None:
    """Of one chunk, as [`write`][] is given them."""
    with clear_write_errors(stored.group.store.root):
        for name, x in named(examples):
            if name in stored.group:
                continue
            stored.group.create_array(
                name,
                shape=(stored.size, *x.shape[1:]),
                chunks=(stored.chunk, *(max(1, length) for length in x.shape[1:])),
                dtype=x.dtype,
                fill_value=_fill_value(name, x.dtype),
                # So that what is there tells what has been computed.
                config={"write_empty_chunks": True},
            )


def write(stored: StoredEnsemble, start: int, values: Any) -> None:
    """One chunk. Each file is there as a whole or not at all; that of `result` comes last."""
    stop = min(start + stored.chunk, stored.size)
    with clear_write_errors(stored.group.store.root):
        for name, x in named(values):
            stored.group[name][start:stop] = np.asarray(x)[: stop - start]


def named(values: Any) -> list[tuple[str, Any]]:
    """Leaves of a dictionary of trees with the names of their arrays, that of `result` last."""
    leaves = jtu.tree_flatten_with_path(values)[0]
    out = [(jtu.keystr(path, simple=True, separator="/"), x) for path, x in leaves]
    names = sorted(name for name, _ in out)
    for name, following in zip(names, [*names[1:], ""], strict=True):
        if not re.fullmatch(r"(\w[\w.-]*/)*\w[\w.-]*", name) or following == name:
            raise ValueError(
                f"{name!r} cannot be the name of an array on the disk: let the keys of dictionaries in the state be "
                "letters, digits and underscores."
            )
    return sorted(out, key=lambda pair: pair[0] == "result")


def _fill_value(name: str, dtype: Any) -> Any:
    if name == "result":
        return _MISSING
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype).item()


@contextlib.contextmanager
def clear_write_errors(path: Path) -> Iterator[None]:
    """A full disk, a folder that may not be written to: what to do."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(
            error.errno,
            f"cannot write to `out={str(path)!r}`: {reason}. The chunks that are finished are kept; go on with "
            "`resume=True` once that is repaired.",
        ) from error
