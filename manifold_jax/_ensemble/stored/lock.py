"""A lock that allows one writer of a folder at a time."""

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from .arrays import clear_write_errors


# There while a process writes, or after it was killed: then the system has released its lock.
LOCK_FILE = "writer.lock"

if sys.platform == "win32":
    import msvcrt

    def _try_to_lock(file: IO) -> None:
        # Lock a byte far beyond the text, which others can then still read.
        file.seek(2**30)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        file.seek(0)

else:
    import fcntl

    def _try_to_lock(file: IO) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def only_writer(out: Path) -> Iterator[None]:
    """Hold the lock of the folder, or refuse because another process does.

    The lock belongs to the open file, not to its existence, so that a process that was killed leaves
    nothing that blocks. If the file system has no locks there is none.
    """
    path = out / LOCK_FILE
    file = _locked(path, out)
    try:
        yield
    finally:
        # On Windows a file cannot be removed while it is open.
        if sys.platform == "win32":
            file.close()
        path.unlink(missing_ok=True)
        file.close()


def _locked(path: Path, out: Path) -> IO:
    while True:
        with clear_write_errors(out):
            file = path.open("a+")
        try:
            _try_to_lock(file)
        except (BlockingIOError, PermissionError) as error:
            with file:
                raise BlockingIOError(error.errno, _is_taken(out, file)) from None
        except OSError:
            pass
        if _is_still_there(path, file):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
            return file
        file.close()


def _is_still_there(path: Path, file: IO) -> bool:
    """Whether the file has not been removed by its holder since it was opened."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _is_taken(out: Path, file: IO) -> str:
    file.seek(0)
    who = file.read() or "another process"
    return (
        f"`path={str(out)!r}` is being written by {who}. Wait until that has ended, or end it, and go on with "
        "`resume=True`; or take another folder."
    )
