"""Files that appear whole or not at all."""

from __future__ import annotations

import ctypes
import errno
import itertools
import json
import os
import re
import secrets
import shutil
import socket
import stat
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from meshsplats._files import DISK_FULL
from meshsplats._files.locks import LOCK, locked

_LEFTOVER = re.compile(r"\..*\.([0-9a-f]+)-([0-9a-f]{8})\.[0-9a-f]{16}(\..*)?")
"""Names of temporary files: process and machine, then a random part."""
_PAUSES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Seconds between attempts to move or remove what another program has open, on Windows."""
_swept: set[Path] = set()
"""Folders that this process has searched for leftovers."""
_promised: set[Path] | None = None
"""Outputs that must still be free when they are written; see ``promises_kept``."""
_waiting: list[_Finished] | None = None
"""Finished files that wait for others; see ``together``."""


def replace_folder(finished: Path, target: Path, is_own: Callable[[str], bool]) -> None:
    """Renames the folder ``finished`` to ``target``, in place of an older one or a link to one, of which the
    files that are not its own stay: ``is_own`` tells by the path in the folder, with slashes."""
    old = target.with_name(f".{target.name}.old")
    if target.exists():
        _hand_over(old, target, is_own)  # what a run left that was killed here
        patiently(partial(os.rename, target, old))
    patiently(partial(os.rename, finished, target))
    _hand_over(old, target, is_own)


def patiently(action: Callable[[], object]) -> None:
    """Runs ``action``, which moves or removes a file or folder.

    Windows refuses that while another program has it open: mostly a virus scanner, for a moment. There it is
    tried for some seconds until the PermissionError is raised.
    """
    for pause in _PAUSES if sys.platform == "win32" else ():
        with suppress(PermissionError):
            action()
            return
        time.sleep(pause)
    action()


def _hand_over(old: Path, target: Path, is_own: Callable[[str], bool]) -> None:
    """Removes the folder ``old`` after moving what is not its own to ``target``; a file whose name is taken
    there stays, with its folder."""
    for folder, folders, files in os.walk(old, topdown=False):
        place = Path(folder)
        links = [name for name in folders if (place / name).is_symlink()]
        for path in (place / name for name in (*files, *links)):
            inside = path.relative_to(old)
            if is_own(inside.as_posix()):
                patiently(path.unlink)
            elif not os.path.lexists(target / inside):
                (target / inside).parent.mkdir(parents=True, exist_ok=True)
                shutil.move(path, target / inside)  # to another disk where the older folder was a link
        with suppress(OSError):
            place.unlink() if place.is_symlink() else place.rmdir()


@contextmanager
def atomic_path(
    path: str | os.PathLike[str],
    *,
    needs: int | Callable[[], int | None] | None = None,
    temporary: Path | None = None,
    new: bool = False,
) -> Iterator[Path]:
    """A temporary path in the folder of ``path``; its file becomes ``path`` at the end of the block.

    The temporary file exists (empty) from the start, is hidden and keeps the suffix of ``path``. If the block
    raises, Ctrl-C included, it is removed, and an older file at ``path`` stays as it was. A new file gets the
    permissions of the umask; a file that replaces another gets the permissions of the other. If ``path`` is a
    symbolic link, its target is replaced and the link stays. Temporary files that killed processes of this
    machine left in the folder are removed.

    Args:
        path: the file.
        needs: its estimated size in bytes, for the message about a full disk; or what tells it then.
        temporary: the temporary path, as ``temporary_beside`` names it, if others have to know it.
        new: ``path`` must not exist. Of several processes that write it at a time, exactly one succeeds.

    Raises:
        FileNotFoundError, NotADirectoryError: the folder is missing. Like the next three, before the block.
        IsADirectoryError: ``path`` is a folder.
        PermissionError: the folder or an existing file is not writable.
        OSError: ``path`` is a device or pipe; or, with errno ENOSPC, EDQUOT or EFBIG and the space that is
            missing, the disk is full.
        FileExistsError: ``path`` exists, with ``new``; before the block or after it.
    """
    shown, target = os.fspath(path), Path(os.path.realpath(path))
    if not target.name:
        raise IsADirectoryError(errno.EISDIR, "cannot write a file here, this is a folder", shown)
    promised = _promised is not None and target in _promised
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = None
    if mode is not None:
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, "cannot write a file here, this is a folder", shown)
        if not stat.S_ISREG(mode):
            # Renaming over a device such as /dev/null would remove it for all programs.
            raise OSError(errno.EINVAL, "cannot write here, this is not a regular file", shown)
        if new or promised:
            raise _written_meanwhile(shown)
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
    _sweep(folder)
    temporary = temporary or temporary_beside(target)
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
        finished = _Finished(temporary, target, shown, new or promised)
        if _waiting is None:
            finished.place()
        else:
            _waiting.append(finished)
    except BaseException as error:
        written = 0
        with suppress(OSError):
            written = temporary.stat().st_size
        with suppress(OSError):
            temporary.unlink()
        number = _full(error)
        if number is None:
            raise
        wanted = needs() if callable(needs) else needs
        raise OSError(number, _no_room(number, folder, wanted, written), shown) from None


@contextmanager
def together() -> Iterator[None]:
    """Files that are finished within the block appear at its end, one right after the other; none of them if
    the block raises.

    So a process that is killed leaves all or nothing of a result in several files, but for the moment of the
    last renames. Within the block, the files are not yet at their paths.
    """
    global _waiting
    if _waiting is not None:  # part of a larger block
        yield
        return
    _waiting = []
    try:
        yield
        while _waiting:
            _waiting[0].place()
            del _waiting[0]
    finally:
        for finished in _waiting:
            with suppress(OSError):
                finished.temporary.unlink()
        _waiting = None


def temporary_beside(path: str | os.PathLike[str]) -> Path:
    """A new temporary path for ``path``: hidden, with its suffix and the id of this process."""
    target = Path(os.path.realpath(path))
    owner = f"{os.getpid():x}-{_machine():08x}"
    return target.parent / f".{target.stem[:32]}.{owner}.{secrets.token_hex(8)}{target.suffix[:16]}"


def may_write_in(folder: Path) -> bool:
    """Whether this process has the permission to make files in ``folder``, which exists.

    On Windows access() knows nothing of the rights of users: a file is made, and removed.
    """
    if sys.platform != "win32":
        return os.access(folder, os.W_OK)
    probe = temporary_beside(folder / "probe")
    try:
        os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    except (PermissionError, FileNotFoundError):  # the latter by the protection of folders against ransomware
        return False
    except OSError:  # a full disk, say: whatever writes will name it
        return True
    with suppress(OSError):
        patiently(probe.unlink)
    return True


def write_bytes(path: str | os.PathLike[str], content: bytes | memoryview) -> None:
    """Writes ``content`` to ``path`` whole or not at all."""
    with atomic_path(path, needs=len(content)) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes ``text`` to ``path`` as UTF-8, whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: str | os.PathLike[str], content: object) -> None:
    """Writes ``content`` to ``path`` as JSON, whole or not at all. ValueError for numbers that JSON lacks."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def refuse_existing(paths: Iterable[str | os.PathLike[str]], force: bool) -> None:
    """Raises FileExistsError if one of the outputs ``paths`` exists already, unless ``force``.

    A command calls this before its work, so that no work is lost to a name that is taken. Within
    ``promises_kept`` the paths must still be free when they are written.
    """
    paths = [os.fspath(path) for path in paths]
    real = {Path(os.path.realpath(path)) for path in paths}
    if force:
        if _promised is not None:
            _promised.difference_update(real)
        return
    taken = [path for path in paths if os.path.lexists(path)]
    if taken:
        more = f" (and {len(taken) - 1} more)" if len(taken) > 1 else ""
        raise FileExistsError(
            errno.EEXIST, f"the output exists already{more}; give ``force`` to overwrite it", taken[0]
        )
    if _promised is not None:
        _promised.update(real)


def is_promised(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` must be new when it is written, by ``refuse_existing``."""
    return _promised is not None and Path(os.path.realpath(path)) in _promised


@contextmanager
def promises_kept() -> Iterator[None]:
    """Within the block, paths that ``refuse_existing`` found free are written only if they are still free: if
    another process has written one meanwhile, ours gets a FileExistsError."""
    global _promised
    before, _promised = _promised, set()
    try:
        yield
    finally:
        _promised = before


@dataclass(frozen=True)
class _Finished:
    """A file that is complete, under its temporary name."""

    temporary: Path
    target: Path
    shown: str
    new: bool
    """Whether ``target`` must not exist."""

    def place(self) -> None:
        """Gives the file its name. FileExistsError if it is taken and must not be."""
        if not self.new:
            _replace(self.temporary, self.target, self.shown)
            return
        _place_new(self.temporary, self.target, self.shown)
        if _promised is not None:
            _promised.discard(self.target)  # ours: it may be replaced from now on


def _replace(temporary: Path, target: Path, shown: str) -> None:
    """Moves ``temporary`` to ``target``, in place of an older file.

    Where another program keeps the older one open on Windows, a viewer say, the new file stays beside it, and
    a PermissionError says so.
    """
    try:
        patiently(partial(os.replace, temporary, target))
        return
    except PermissionError:
        if sys.platform != "win32":
            raise
    names = (f"{target.stem}.new{number or ''}{target.suffix}" for number in itertools.count())
    kept = next(path for path in map(target.with_name, names) if not os.path.lexists(path))
    os.rename(temporary, kept)
    reason = f"another program has this file open, so the new one is {kept.name}: close it there, and rename"
    raise PermissionError(errno.EACCES, reason, shown)


def _place_new(temporary: Path, target: Path, shown: str) -> None:
    """Moves ``temporary`` to ``target``. FileExistsError if ``target`` exists by then."""
    try:
        if sys.platform == "win32":
            patiently(partial(os.rename, temporary, target))  # never replaces a file on Windows
            return
        try:
            os.link(temporary, target)
        except FileExistsError:
            raise
        except OSError:
            # A file system without hard links: reserve the name with an empty file.
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            os.replace(temporary, target)
            return
    except FileExistsError:
        raise _written_meanwhile(shown) from None
    temporary.unlink()


def _written_meanwhile(shown: str) -> FileExistsError:
    return FileExistsError(
        errno.EEXIST,
        "another process has written this output meanwhile; give another name, or ``force`` to overwrite it",
        shown,
    )


def _full(error: BaseException) -> int | None:
    """The error number if ``error`` means a full disk, also by the message of another library."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno if error.errno in DISK_FULL else None
    if not isinstance(error, Exception):
        return None
    text = str(error).lower()
    return next((number for number in DISK_FULL if os.strerror(number).lower() in text), None)


def _no_room(number: int, folder: Path, needs: int | None, written: int) -> str:
    wanted = f"needs more than {in_words(written)}" if written else ""
    if needs is not None:
        wanted = f"needs about {in_words(needs)}"
    if number == errno.EFBIG:
        return "larger than a file may be here (ulimit -f, or the file system)" + (
            wanted and f": it {wanted}"
        )
    if number == errno.EDQUOT:
        return "the disk quota is used up" + (wanted and f": the file {wanted}")
    facts = [f"the file {wanted}"] if wanted else []
    with suppress(OSError):
        facts.append(f"{in_words(shutil.disk_usage(folder).free)} are free")
    return ": ".join(["no space left on the disk", *([", ".join(facts)] if facts else [])])


def in_words(count: float) -> str:
    """A number of bytes for people: 3.2 MB."""
    for unit in ("bytes", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def _machine() -> int:
    """Identifies the machine, or the container on it, that our process ids belong to."""
    name = socket.gethostname()
    with suppress(OSError):
        name += os.readlink("/proc/self/ns/pid")
    return zlib.crc32(name.encode("utf-8", "surrogateescape"))


def _sweep(folder: Path) -> None:
    """Removes the temporary files and locks of killed processes from ``folder``, once for each folder."""
    if folder in _swept:
        return
    _swept.add(folder)
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _LEFTOVER.fullmatch(entry.name) if entry.name.startswith(".") else None
            if match and int(match[2], 16) == _machine() and not _alive(int(match[1], 16)):
                with suppress(OSError):
                    os.unlink(entry.path)
            elif LOCK.fullmatch(entry.name):
                with suppress(OSError), locked(Path(entry.path)):
                    pass  # removes it, unless a process holds it


def _alive(process: int) -> bool:
    if sys.platform == "win32":  # os.kill(.., 0) ends processes there
        kernel32 = ctypes.WinDLL("kernel32", use_last_error=True)
        return _alive_on_windows(process, kernel32, ctypes.get_last_error)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _alive_on_windows(process: int, kernel32: Any, last_error: Callable[[], int]) -> bool:
    """As ``_alive``, by the Windows API. Processes of others may not be opened, but are there."""
    synchronize, invalid_parameter, signalled = 0x100000, 87, 0
    kernel32.OpenProcess.restype = ctypes.c_void_p
    handle = kernel32.OpenProcess(synchronize, False, ctypes.c_uint32(process))
    if not handle:
        return last_error() != invalid_parameter
    handle = ctypes.c_void_p(handle)
    try:
        return bool(kernel32.WaitForSingleObject(handle, 0) != signalled)  # it is when the process has ended
    finally:
        kernel32.CloseHandle(handle)
