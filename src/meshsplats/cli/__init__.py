"""The command ``meshsplats``. Each sub-command is a dataclass in a module of its own, whose fields are its
options.

A module is imported only when its command runs, so that ``meshsplats --version`` and the overview are quick.
"""

from __future__ import annotations

import errno
import importlib
import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

COMMANDS = {
    "convert": ("meshsplats.cli.convert:Convert", "splats to a mesh of translucent triangles"),
    "clean": ("meshsplats.cli.clean:Clean", "splats or a mesh without its floaters"),
    "render": ("meshsplats.cli.render:Render", "pictures of splats or a mesh, and a turntable"),
    "compare": ("meshsplats.cli.compare:Compare", "mesh against splats: PSNR, SSIM, pictures side by side"),
    "finetune": ("meshsplats.cli.finetune:Finetune", "the mesh brought closer to splats or photographs"),
    "simplify": ("meshsplats.cli.simplify:Simplify", "fewer splats that look the same"),
    "levels": ("meshsplats.cli.levels:Levels", "levels of detail: meshes for ever smaller sizes"),
    "bake": ("meshsplats.cli.bake:Bake", "the filter of a mesh made part of its triangles"),
    "base": ("meshsplats.cli.base:Base", "a classical mesh of the surface that splats form"),
    "prior": ("meshsplats.cli.prior:Prior", "splats on a classical mesh, trained and edited with it"),
    "deform": ("meshsplats.cli.deform:Deform", "the splats of a prior moved to an edited base mesh"),
    "evaluate": ("meshsplats.cli.evaluate:Evaluate", "scores against photographs: PSNR, SSIM, LPIPS"),
    "blender": ("meshsplats.cli.blender:Blender", "pictures and scenes by Blender: exact ones, and lit ones"),
    "info": ("meshsplats.cli.info:Info", "what is in a splat file, mesh, camera file or model folder"),
    "doctor": ("meshsplats.cli.doctor:Doctor", "what is installed here, and what is missing"),
}
"""Name: where its dataclass is, and one line of help."""

_TAKES_SIGN = ("--up", "--azimuth", "--elevation")
_standard_input: str | None = None
"""The file that holds what standard input had, where the command was given -."""


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a full disk, as in ``_files.atomic``."""
OK, FAILED, USAGE, EXISTS, NO_SPACE, LACKING = 0, 1, 2, 3, 4, 5
"""Exit codes. FAILED: the input, or a place that was named, is wrong. LACKING: a library, a program or memory
is not there. Ended by signal n: 128 + n."""
KINDS = {FAILED: "input", USAGE: "usage", EXISTS: "exists", NO_SPACE: "space", LACKING: "missing"}
"""What the errors in JSON call them."""


class UsageError(Exception):
    """Options that contradict each other: exit code 2."""


class Terminated(BaseException):
    """A signal asks the process to end; ``number`` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line ``argv`` (without the program's name; None: that of the process).

    Returns the exit code: 0, 1 for an error in the input, 2 for wrong usage, 3 for an output that exists
    already, 4 for a full disk, 5 for a library, program or memory that is missing, 130 for Ctrl-C, 143 for
    SIGTERM. With ``--json``, an error is printed as JSON too: ``{"error": {"kind", "code", "message", "path",
    "type"}}``.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else ""
    debug, as_json = "--debug" in arguments, "--json" in arguments
    try:
        with warnings.catch_warnings(), _signals_raise():
            code = _answer(name) if name not in COMMANDS else _run(name, _plain(arguments[1:]))
            sys.stdout.flush()
            return code
    except SystemExit as stop:  # tyro has shown help, or what is wrong with the arguments
        code = stop.code if isinstance(stop.code, int) else USAGE
        if code == USAGE and as_json:
            _tell_json(USAGE, UsageError("the options were not understood; standard error says why"))
        return code
    except (KeyboardInterrupt, Terminated) as stop:
        number = getattr(stop, "number", signal.SIGINT)
        say(f"{_ENDINGS.get(number, 'ended')}; no file was left half-written")
        return 128 + number
    except BrokenPipeError:
        _close_output()  # its reader has gone, `| head` say
        return FAILED
    except (UsageError, ValueError, OSError, ImportError, MemoryError) as error:
        if debug:
            raise
        if isinstance(error, OSError) and error.errno in FULL and error.filename is None:
            # All files have names in their errors.
            error = OSError(error.errno, error.strerror, "standard output")
            _close_output()
        hint = f" (see meshsplats {name} --help)" if isinstance(error, UsageError) else ""
        say(f"error: {one_line(error)}{hint}")
        code = exit_code(error)
        if as_json:
            _tell_json(code, error)
        return code


def exit_code(error: BaseException) -> int:
    """The exit code that tells of ``error``."""
    if isinstance(error, UsageError):
        return USAGE
    if isinstance(error, FileExistsError):
        return EXISTS
    if isinstance(error, OSError) and error.errno in FULL:
        return NO_SPACE
    return LACKING if isinstance(error, (ImportError, MemoryError)) else FAILED


def error_record(error: BaseException) -> dict[str, Any]:
    """``error`` for JSON."""
    path = os.fsdecode(error.filename) if isinstance(error, OSError) and error.filename else None
    code = exit_code(error)
    named = {"kind": KINDS[code], "code": code, "message": one_line(error), "path": path}
    return named | {"type": type(error).__name__}


def _tell_json(code: int, error: BaseException) -> None:
    try:
        print(json.dumps({"error": error_record(error)}), flush=True)
    except OSError:  # the message stands on standard error
        _close_output()


def _close_output() -> None:
    """Python must not find out again, when it ends, that nothing more can be printed."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


_ENDINGS = {signal.SIGINT: "interrupted"} | {
    getattr(signal, name): f"ended by {name}" for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)
}


@contextmanager
def _signals_raise() -> Iterator[None]:
    """While the block runs, SIGTERM and SIGHUP raise ``Terminated``, so that what is under way is tidied up
    as after Ctrl-C; once, as another one must not break off the tidying. Signals that are ignored (nohup)
    stay so."""

    def end(number: int, frame: object) -> None:
        for other in ours:
            signal.signal(other, signal.SIG_IGN)
        raise Terminated(number)

    ours = []
    if threading.current_thread() is threading.main_thread():
        ours = [n for n in _ENDINGS if n != signal.SIGINT and signal.getsignal(n) == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _run(name: str, arguments: list[str]) -> int:
    from meshsplats.errors import DataWarning

    warnings.simplefilter("always", DataWarning)
    warnings.showwarning = lambda message, *_, **__: say(f"warning: {one_line(message)}")

    with _input_read(_joined(arguments)) as given:
        return _command(name, given)


def _command(name: str, arguments: list[str]) -> int:
    import tyro

    from meshsplats._files.atomic import promises_kept

    module, _, attribute = COMMANDS[name][0].partition(":")
    command = getattr(importlib.import_module(module), attribute)
    options = tyro.cli(
        command,
        args=arguments,
        prog=f"meshsplats {name}",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    with promises_kept():
        return options.run() or OK


def shown_path(path: str | os.PathLike[str]) -> str:
    """``path`` as it was given: - for standard input."""
    return "-" if _standard_input is not None and os.fspath(path) == _standard_input else os.fspath(path)


@contextmanager
def _input_read(arguments: list[str]) -> Iterator[list[str]]:
    """``arguments`` with the name of a file in place of -, which holds what standard input has: readers look
    at their files several times."""
    global _standard_input
    _standard_input = None
    places = [
        i
        for i, argument in enumerate(arguments)
        if argument == "-" and (i == 0 or arguments[i - 1] not in ("-o", "--output"))
    ]
    if not places:
        yield arguments
        return
    if len(places) > 1:
        raise UsageError("- stands for standard input, which can be read once")
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("- reads standard input: lead a file there, < scene.ply say")
    import shutil
    import tempfile

    with tempfile.TemporaryDirectory(prefix="meshsplats-") as folder:
        path = os.path.join(folder, "standard-input")
        try:
            with open(path, "wb") as file:
                shutil.copyfileobj(sys.stdin.buffer, file, 1 << 20)
        except OSError as error:
            raise OSError(error.errno, f"standard input does not fit here: {error.strerror}", path) from None
        _standard_input = path  # until the next command: errors are told when this one has ended
        yield [*arguments[: places[0]], path, *arguments[places[0] + 1 :]]


def _answer(name: str) -> int:
    """What is said where no command was named."""
    if name in ("", "-h", "--help", "help"):
        print(_overview())
        return OK
    if name in ("-V", "--version"):
        import meshsplats

        print(f"meshsplats {meshsplats.__version__}")
        return OK
    return _unknown(name)


def _plain(arguments: list[str]) -> list[str]:
    return [argument for argument in arguments if argument != "--debug"]


def _joined(arguments: list[str]) -> list[str]:
    """``--up -y`` as ``--up=-y``: a value that begins with a minus sign would be taken for an option."""
    joined: list[str] = []
    for argument in arguments:
        if (
            joined
            and joined[-1] in _TAKES_SIGN
            and argument.startswith("-")
            and not argument.startswith("--")
        ):
            joined[-1] += "=" + argument
        else:
            joined.append(argument)
    return joined


def _overview() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
    return (
        "usage: meshsplats COMMAND ...\n\n"
        "Gaussian splats as ordinary triangle meshes: convert, render exactly, compare, save.\n\n"
        f"commands:\n{commands}\n\n"
        "  meshsplats COMMAND --help   options of a command\n"
        "  meshsplats --version\n"
        "  --debug                     with any command: the full traceback of an error\n\n"
        "exit codes: 0 done, 1 wrong input, 2 wrong usage, 3 the output exists, 4 no space, 5 something is\n"
        "missing here (a library, a program, memory)\n\n"
        "start with:\n"
        "  meshsplats convert scene.ply -o scene.glb"
    )


def _unknown(name: str) -> int:
    import difflib

    close = difflib.get_close_matches(name, COMMANDS, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"commands: {', '.join(COMMANDS)}"
    say(f"error: there is no command {name!r}; {hint}")
    return USAGE


def one_line(error: object) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f"{os.fsdecode(error.filename)}: {error.strerror}"
    else:
        text = str(error)
    if isinstance(error, MemoryError) and not text:
        text = "out of memory"
    if _standard_input is not None:
        text = text.replace(_standard_input, "standard input")
    return " ".join(text.split()) or type(error).__name__


def say(text: str) -> None:
    print(f"meshsplats: {text}", file=sys.stderr)
