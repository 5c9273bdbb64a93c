"""The files of a stored ensemble, and how they are written."""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.tree_util as jtu
import numpy as np


# Marks trajectories in `result` that have not been computed.
_MISSING = -1
# Files that were being written when the process was killed.
_PARTIAL = re.compile(r"[^.]*\.[0-9a-f]{32}\.partial")


def zarr() -> Any:
    """Return the package zarr, which only stored ensembles need."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            "Ensembles are written to the disk by zarr (version 3.1.6 or newer), which is not installed: "
            '`pip install zarr`, or install `"manifold_jax[ensemble]"`.'
        ) from error
    return zarr


def create_group(
    path: Path, settings: dict[str, Any], messages: Sequence[str], examples: Any
) -> Any:
    """Create the group. Its description is written first, so that all other files in a folder belong to
    one: settings, and fingerprints of the files `zarr.json` that follow and of itself."""
    files: dict[str, Any] = {}
    planned = zarr().create_group(zarr().storage.MemoryStore(files))
    create_arrays(planned, settings["size"], settings["chunk"], examples)
    attributes: dict[str, Any] = {"settings": settings, "messages": list(messages)}
    attributes["files"] = {
        name: fingerprint_of_description(json.loads(files[name].to_bytes()))
        for name in sorted(files)
        if name != "zarr.json"
    }
    attributes["fingerprint"] = fingerprint_of_attributes(attributes)
    with clear_write_errors(path):
        return zarr().create_group(path, attributes=attributes)


def create_arrays(group: Any, size: int, chunk: int, examples: Any) -> None:
    """Create the arrays that are missing, for chunks as [`write`][] gets them. Each chunk of each array
    is one file, which ends with its checksum."""
    codecs = zarr().codecs
    for name, x in named(examples):
        for end in (at for at, letter in enumerate(name) if letter == "/"):
            group.require_group(name[:end])
        if name in group:
            continue
        group.create_array(
            name,
            shape=(size, *x.shape[1:]),
            chunks=(chunk, *(max(1, length) for length in x.shape[1:])),
            dtype=x.dtype,
            fill_value=_fill_value(name, x.dtype),
            compressors=[codecs.ZstdCodec(), codecs.Crc32cCodec()],
        )


def write(group: Any, start: int, values: Any) -> None:
    """Write one chunk. Each file is there as a whole or not at all; that of `result` comes last."""
    with clear_write_errors(group.store.root):
        for name, x in named(values):
            # Chunks of zeros are written, too: a file that is missing is one that was lost.
            array = group[name].with_config({"write_empty_chunks": True})
            stop = min(start + x.shape[0], array.shape[0])
            array[start:stop] = np.asarray(x)[: stop - start]


def named(values: Any) -> list[tuple[str, Any]]:
    """Return the leaves of a dictionary of trees with the names of their arrays, that of `result` last."""
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


def fingerprint_of_attributes(attributes: dict[str, Any]) -> str:
    """Return a fingerprint of the attributes that this library has written; others may add to them."""
    return _fingerprint([attributes.get(name) for name in ("settings", "messages", "files")])


def fingerprint_of_description(description: dict[str, Any]) -> str:
    """Return a fingerprint of a file `zarr.json` without its attributes, which are free for others."""
    added = ("attributes", "consolidated_metadata")
    return _fingerprint({name: x for name, x in description.items() if name not in added})


def _fingerprint(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def is_partial(file: Path) -> bool:
    return _PARTIAL.fullmatch(file.name) is not None


def clear_partial(path: Path) -> None:
    with clear_write_errors(path):
        for file in filter(is_partial, list(path.rglob("*.partial"))):
            file.unlink()


def _fill_value(name: str, dtype: Any) -> Any:
    if name == "result":
        return _MISSING
    return np.nan if np.issubdtype(dtype, np.inexact) else np.zeros((), dtype).item()


@contextlib.contextmanager
def clear_write_errors(path: Path) -> Iterator[None]:
    """Convert errors of a full disk or a folder without permission into messages with advice."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(
            error.errno,
            f"cannot write to `path={str(path)!r}`: {reason}. The chunks that are finished are kept; go on with "
            "`resume=True` once that is repaired.",
        ) from error
