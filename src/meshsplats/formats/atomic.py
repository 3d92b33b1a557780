"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the folder of ``path``; what is written there becomes ``path`` if all goes well.

    The temporary file exists (empty) from the start, is hidden, keeps the suffix of ``path`` and is
    removed if the block raises, Ctrl-C included; an older file at ``path`` then stays as it was. A new
    file gets the usual permissions (the umask decides), one that replaces another gets the permissions of
    the other. Where ``path`` is a symbolic link, the file it points to is replaced and the link stays.

    Raises FileNotFoundError or NotADirectoryError for a missing folder, IsADirectoryError where ``path``
    is a folder, PermissionError where the folder or an existing file may not be written, OSError for a
    device or pipe: all before the block is entered.
    """
    shown, target = os.fspath(path), Path(os.path.realpath(path))
    if not target.name:
        raise IsADirectoryError(errno.EISDIR, "cannot write a file here, this is a folder", shown)
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = None
    if mode is not None:
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, "cannot write a file here, this is a folder", shown)
        if not stat.S_ISREG(mode):
            # Renaming over a device such as /dev/null would take it away from everyone.
            raise OSError(errno.EINVAL, "cannot write here, this is not a regular file", shown)
        if not os.access(target, os.W_OK):
            raise PermissionError(errno.EACCES, "the existing file is write-protected", shown)
    folder = target.parent
    if not folder.is_dir():
        if folder.exists():
            raise NotADirectoryError(
                errno.ENOTDIR, f"cannot write a file here, {folder} is not a folder", shown
            )
        raise FileNotFoundError(
            errno.ENOENT, f"cannot write a file here, create the folder {folder} first", shown
        )
    temporary = folder / f".{target.stem[:32]}.{secrets.token_hex(8)}{target.suffix[:16]}"
    try:
        # Created by os.open and not by tempfile, whose files only their owner may read.
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except PermissionError:
        raise PermissionError(errno.EACCES, f"no permission to write in the folder {folder}", shown) from None
    except OSError as error:
        raise OSError(error.errno, f"cannot write in the folder {folder}: {error.strerror}", shown) from None
    try:
        yield temporary
        if mode is not None:
            os.chmod(temporary, stat.S_IMODE(mode))
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def refuse_existing(paths: Iterable[str | os.PathLike[str]], force: bool) -> None:
    """Raises FileExistsError if one of the outputs ``paths`` exists already, unless ``force``.

    A command calls this before its work, so that an hour of it is not lost to a name that is taken.
    """
    if force:
        return
    taken = [os.fspath(path) for path in paths if os.path.lexists(path)]
    if taken:
        more = f" (and {len(taken) - 1} more)" if len(taken) > 1 else ""
        raise FileExistsError(
            errno.EEXIST, f"the output exists already{more}; give --force to overwrite it", taken[0]
        )
