"""Standard output and error of a command, whatever they are connected to."""

from __future__ import annotations

import errno
import io
import os
import sys


def open_missing_streams() -> None:
    """Opens standard output and error where the process began without them (``>&-``), lest a result file take
    their numbers and get the messages."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - as long as the process


def close_output() -> None:
    """Keeps Python from failing again, when it ends, to print the rest."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def write_all_names() -> None:
    """Has standard output write what its encoding lacks with backslashes, as standard error does: the name of
    a file that cannot be printed must not end the command."""
    if not isinstance(sys.stdout, io.TextIOWrapper):
        return
    unicode = sys.stdout.encoding.lower().replace("_", "-").startswith("utf-8")
    if sys.stdout.errors == "strict" or (sys.stdout.errors == "surrogateescape" and not unicode):
        sys.stdout.reconfigure(errors="backslashreplace")  # the second: redirected, on Windows


def is_of_closed_pipe(error: BaseException) -> bool:
    """Whether nobody reads standard output any more: EPIPE, on Windows EINVAL without a file."""
    if isinstance(error, BrokenPipeError):
        return True
    named = getattr(error, "filename", None) is not None
    return sys.platform == "win32" and getattr(error, "errno", None) == errno.EINVAL and not named
