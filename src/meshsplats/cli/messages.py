"""Messages of all commands: errors, exit codes, lines on standard error."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from meshsplats import errors
from meshsplats._common.streams import close_output
from meshsplats._common.words import naming, printable
from meshsplats._files import DISK_FULL

OK, FAILED, USAGE, EXISTS, NO_SPACE, LACKING = 0, 1, 2, 3, 4, 5
"""Exit codes. FAILED: the input, or a path that was named, is wrong. LACKING: a library, a program, a GPU or
memory is missing. Ended by signal n: 128 + n."""
UNREAD = 128 + 13
"""Exit code where the reader of standard output has gone, `| head` say: of programs which SIGPIPE ends."""
KINDS = {FAILED: "input", USAGE: "usage", EXISTS: "exists", NO_SPACE: "space", LACKING: "missing"}
"""Names of the exit codes in JSON."""
ENDINGS = {signal.SIGINT: "interrupted"} | {
    getattr(signal, name): f"ended by {name}"
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK")
    if hasattr(signal, name)
}
"""Message for each signal that ends a command."""

_standard_input: str | None = None
"""The temporary file that holds standard input, if the input is -."""
subject: tuple[str, ...] = ()
"""Names of the input that messages are about, and of its outputs, where there are several."""
_spelled: Callable[[str], str] | None = None
"""How the command writes its options, where the library names them."""


class UsageError(Exception):
    """Options that contradict each other: exit code 2."""


class Terminated(BaseException):
    """A signal asks the process to end; ``number`` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def exit_code(error: BaseException) -> int:
    """The exit code for ``error``."""
    if isinstance(error, (UsageError, errors.OverwritingError, errors.OptionValueError)):
        return USAGE
    if isinstance(error, FileExistsError):
        return EXISTS
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return NO_SPACE
    lacking = (ImportError, MemoryError, errors.DeviceError, errors.ClusterError)
    return LACKING if isinstance(error, lacking) else FAILED


def error_record(error: BaseException) -> dict[str, Any]:
    """``error`` for JSON."""
    code, name = exit_code(error), getattr(error, "filename", None)
    path = shown_path(os.fsdecode(name)) if name else None
    named = {"kind": KINDS[code], "code": code, "message": one_line(error), "path": path}
    return named | {"type": type(error).__name__}


def print_json_error(error: BaseException) -> None:
    """Prints ``error`` as JSON on standard output."""
    try:
        print(json.dumps({"error": error_record(error)}), flush=True)
    except OSError:  # the message is on standard error, too
        close_output()


def read_from_standard_input(path: str | None) -> None:
    """Messages name the file at ``path`` "standard input" until the next command."""
    global _standard_input
    _standard_input = path


def write_options(how: Callable[[str], str]) -> None:
    """Messages of the library have its options as ``how`` writes them, until the next command."""
    global _spelled
    _spelled = how


def with_flags(text: str) -> str:
    """``text`` with flags for the names of options in double backquotes, fit for terminals."""
    named = errors.with_options(text, _spelled or flag)
    return printable(re.sub(r"(--[\w-]+) '(\w+)'", r"\1 \2", named))  # as shells take it


def shown_path(path: str | os.PathLike[str]) -> str:
    """``path`` as the user gave it: - for standard input."""
    return "-" if _standard_input is not None and os.fspath(path) == _standard_input else os.fspath(path)


def one_line(error: object) -> str:
    """Message of ``error`` in one line, with the path of the file that it is about."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        reason = error.strerror
        if sys.platform == "win32" and isinstance(error, PermissionError) and os.path.isdir(error.filename):
            # To open a folder is "Permission denied" there; other calls say what is wrong.
            reason = os.strerror(errno.EISDIR) if getattr(error, "winerror", None) is None else reason
        text = f"{os.fsdecode(error.filename)}: {reason}"
    else:
        text = error.spelled(_spelled or flag) if isinstance(error, errors.NamingOptions) else str(error)
    if isinstance(error, MemoryError) and not text:
        text = "out of memory"
    if _standard_input is not None:
        text = text.replace(_standard_input, "standard input")
    return with_flags(" ".join(text.split())) or type(error).__name__


def say(text: str) -> None:
    """Prints a line on standard error, if anybody reads it."""
    with suppress(OSError):
        print(f"meshsplats: {with_flags(naming(text, subject))}", file=sys.stderr, flush=True)


@contextmanager
def about(*names: str) -> Iterator[None]:
    """Within the block, lines are about one of several inputs: ``naming``."""
    global subject
    subject = tuple("standard input" if name == "-" else name for name in names)
    try:
        yield
    finally:
        subject = ()


def flag(name: str) -> str:
    """The option of a field: ``max_splats`` is ``--max-splats``. What replaces old files has one flag."""
    return "--force" if name == "replace_old" else "--" + name.replace("_", "-")
