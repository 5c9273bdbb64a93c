"""Missing and damaged files of a stored ensemble."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from .arrays import fingerprint_of_attributes, fingerprint_of_description, zarr


# Largest number of files that a message lists.
_MOST = 5


class Fault(NamedTuple):
    """A fault of one file: its name, what is wrong, the number of its chunk (None for a description)."""

    file: str
    what: str
    chunk: int | None = None

    def __str__(self) -> str:
        return f"`{self.file}` is {self.what}"


def described(path: Path) -> dict[str, Any] | None:
    """Return the attributes of an ensemble, `None` if there is none in the folder."""
    description, fault = _read(path, "zarr.json")
    if fault is not None and fault.what == "missing":
        return None
    attributes = (description or {}).get("attributes", {})
    if fault is None and "settings" not in attributes:
        return None
    if fault is None and attributes.get("fingerprint") != fingerprint_of_attributes(attributes):
        fault = Fault("zarr.json", "damaged")
    if fault is not None:
        raise ValueError(
            f"{str(path)!r}: {fault}. It says what the ensemble was computed with, and cannot be made again: put a copy "
            "of that file there, or compute the ensemble in another folder."
        )
    return attributes


def faults_of_descriptions(path: Path, attributes: dict[str, Any]) -> list[Fault]:
    """Return the faults of the files `zarr.json` of groups and arrays, which are needed to read them.
    Before the first chunk they are still being written."""
    out = []
    for name, fingerprint in attributes["files"].items():
        description, fault = _read(path, name)
        if description is not None and fingerprint_of_description(description) != fingerprint:
            fault = Fault(name, "damaged")
        if fault is not None:
            out.append(fault)
    lost = bool(out) and _has_chunks(path)
    return [fault for fault in out if lost or fault.what != "missing"]


def faults_of_chunks(group: Any) -> list[Fault]:
    """Return the faults of the chunks that have been computed, reading each. The last may be
    unfinished: `result` is its last array."""
    root, arrays = group.store.root, _arrays(group)
    there = {name: _chunks_there(root, name, array) for name, array in arrays.items()}
    begun = max((max(chunks, default=-1) for chunks in there.values()), default=-1)
    computed = range(max(begun, max(there.get("result", []), default=-1) + 1))
    out = []
    for k in computed:
        for name, array in arrays.items():
            file = _file_of(name, array, k)
            if k not in there[name]:
                out.append(Fault(file, "missing", k))
            elif not _is_readable(array, k):
                out.append(Fault(file, "damaged", k))
    return out


def finished_chunks(group: Any) -> list[int]:
    """Return the numbers of the chunks that have a `result`, which is the last array of each."""
    if "result" not in group:
        return []
    return sorted(_chunks_there(group.store.root, "result", group["result"]))


def in_words(faults: list[Fault], chunk: int, size: int) -> str:
    """Return a list of the faults, with the trajectories of the `size` that chunks of so many hold."""

    def words(fault: Fault) -> str:
        if fault.chunk is None:
            return str(fault)
        start = fault.chunk * chunk
        return f"{fault} (trajectories from {start} to {min(start + chunk, size) - 1})"

    more = f", and {len(faults) - _MOST} files more" if len(faults) > _MOST else ""
    return ", ".join(map(words, faults[:_MOST])) + more


def _read(path: Path, name: str) -> tuple[dict[str, Any] | None, Fault | None]:
    """Return the contents of a JSON file, or its fault."""
    file = path / name
    try:
        description = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None, Fault(name, "missing")
    except ValueError:  # not text, or not JSON
        return None, Fault(name, "damaged" if file.stat().st_size else "empty")
    if not isinstance(description, dict):
        return None, Fault(name, "damaged")
    return description, None


def _has_chunks(path: Path) -> bool:
    return any(file.name.isdecimal() and file.is_file() for file in path.rglob("*"))


def _arrays(group: Any) -> dict[str, Any]:
    """Return the arrays that have numbers in their chunks, by name."""
    names = [name.removesuffix("/zarr.json") for name in group.attrs["files"]]
    nodes = {name: group[name] for name in names if name in group}
    return {name: x for name, x in nodes.items() if isinstance(x, zarr().Array) and x.size}


def _chunks_there(root: Path, name: str, array: Any) -> set[int]:
    folder = root / name / "c"
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    numbers = {int(name) for name in names if name.isdecimal()}
    return {k for k in numbers if (root / _file_of(name, array, k)).is_file()}


def _file_of(name: str, array: Any, k: int) -> str:
    """Return the file of a chunk, a part of the leading axis."""
    return "/".join([name, "c", str(k), *["0"] * (array.ndim - 1)])


def _is_readable(array: Any, k: int) -> bool:
    """Whether the checksum of a chunk is correct."""
    length = array.chunks[0]
    try:
        array[k * length : (k + 1) * length]
    except (ValueError, RuntimeError):
        return False
    return True
