"""Locks that end with the process that holds them, even if it is killed."""

from __future__ import annotations

import os
import re
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = re.compile(r"\..*\.[0-9a-f]{8}\.lock")
"""Names of locks on outputs: see ``lock_of``."""


def lock_of(output: Path) -> Path:
    """The hidden file whose lock the process holds that writes ``output``."""
    return output.with_name(f".{output.stem[:32]}.{zlib.crc32(os.fsencode(output.name)):08x}.lock")


def try_lock(path: Path) -> int | None:
    """An open file descriptor that holds the lock of the file ``path``, created if missing; None if another
    process holds it. The lock ends when the descriptor, and every copy in child processes, is closed."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            if not _lock(descriptor):
                os.close(descriptor)
                return None
            # The previous holder may have removed the file between our two calls.
            if sys.platform == "win32" or os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Whether this process holds the lock of ``path`` within the block; the file is removed afterwards."""
    descriptor = try_lock(path)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            if sys.platform == "win32":  # cannot remove open files
                os.close(descriptor)
            with suppress(OSError):
                path.unlink()
            if sys.platform != "win32":
                os.close(descriptor)


def _lock(descriptor: int) -> bool:
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: no process can hold one
        return True
    return True
