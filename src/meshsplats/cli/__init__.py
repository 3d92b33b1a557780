"""The command ``meshsplats``. Each sub-command is a dataclass in a module of its own, whose fields are its
options.

A module is imported only when its command runs, so that ``meshsplats --version`` and the overview are quick.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from meshsplats._common import streams
from meshsplats._files import DISK_FULL
from meshsplats.cli import messages
from meshsplats.cli.messages import OK, USAGE, Terminated, UsageError, exit_code, one_line, say
from meshsplats.errors import ClusterError, DeviceError

COMMANDS = {
    "demo": ("meshsplats.cli.demo:Demo", "the first commands, on a scene of its own"),
    "convert": ("meshsplats.cli.convert:Convert", "splats to a mesh of translucent triangles"),
    "clean": ("meshsplats.cli.clean:Clean", "splats or a mesh without its floaters"),
    "view": ("meshsplats.cli.view:View", "a scene in the browser, or in one .html file for anyone"),
    "render": ("meshsplats.cli.render:Render", "images of splats or a mesh, and a turntable"),
    "compare": ("meshsplats.cli.compare:Compare", "mesh against splats: PSNR, SSIM, images side by side"),
    "finetune": ("meshsplats.cli.finetune:Finetune", "a mesh optimised to look like splats or photographs"),
    "train": ("meshsplats.cli.train:Train", "photographs to a mesh, without splats"),
    "cameras": ("meshsplats.cli.cameras:Cameras", "cameras that see a scene well, found from its splats"),
    "simplify": ("meshsplats.cli.simplify:Simplify", "fewer splats that look the same"),
    "levels": ("meshsplats.cli.levels:Levels", "levels of detail: meshes for smaller and smaller sizes"),
    "tiles": ("meshsplats.cli.tiles:Tiles", "a 3D Tiles tileset of any number of splats"),
    "bake": ("meshsplats.cli.bake:Bake", "a mesh with its low-pass filter applied, for other programs"),
    "surface": ("meshsplats.cli.surface:Surface", "a light, textured mesh of the surface that splats form"),
    "prior": ("meshsplats.cli.prior:Prior", "splats bound to a classical mesh, trained and edited with it"),
    "deform": ("meshsplats.cli.deform:Deform", "the splats of a prior moved to an edited base mesh"),
    "evaluate": ("meshsplats.cli.evaluate:Evaluate", "scores on held-out views: PSNR, SSIM, LPIPS"),
    "blender": ("meshsplats.cli.blender:Blender", "images and scenes by Blender, unlit or lit"),
    "info": ("meshsplats.cli.info:Info", "the content of a splat file, mesh, camera file or model folder"),
    "doctor": ("meshsplats.cli.doctor:Doctor", "installed libraries, and missing ones"),
}
"""Name: where its dataclass is, and one line of help."""

_TAKES_SIGN = ("--up", "--azimuth", "--elevation")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line ``argv`` (without the program's name; None: that of the process).

    Returns the exit code: 0, 1 for an error in the input, 2 for wrong usage, 3 for an output that exists
    already, 4 for a full disk, 5 for a library, program or memory that is missing, 130 for Ctrl-C, 143 for
    SIGTERM, 141 where nobody reads standard output any more (``| head``). With ``--json``, an error is
    printed as JSON too: ``{"error": {"kind", "code", "message", "path", "type"}}``.
    """
    streams.open_missing_streams()
    streams.write_all_names()
    if "numpy" not in sys.modules:
        # The core has threads of its own. Those of NumPy's BLAS, which wait in loops for the next small
        # product, would take a fifth of the processor time of a conversion.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else ""
    debug, as_json = "--debug" in arguments, "--json" in arguments
    try:
        with warnings.catch_warnings(), _signals_raise():
            code = _answer(name) if name not in COMMANDS else _run(name, arguments[1:])
            sys.stdout.flush()
            return code
    except SystemExit as stop:  # help has been printed
        return stop.code if isinstance(stop.code, int) else USAGE
    except (KeyboardInterrupt, Terminated) as stop:
        number = getattr(stop, "number", signal.SIGINT)
        say(f"{messages.ENDINGS.get(number, 'ended')}; no file was left half-written")
        return 128 + number
    except (UsageError, ValueError, OSError, ImportError, MemoryError, DeviceError, ClusterError) as error:
        if streams.is_of_closed_pipe(error):
            streams.close_output()
            return messages.UNREAD
        if debug:
            raise
        if isinstance(error, OSError) and error.errno in DISK_FULL and error.filename is None:
            # All files have names in their errors.
            error = OSError(error.errno, error.strerror, "standard output")
            streams.close_output()
        hint = f" (see meshsplats {name} --help)" if isinstance(error, UsageError) else ""
        say(f"error: {one_line(error)}{hint}")
        if as_json:
            messages.print_json_error(error)
        return exit_code(error)


@contextmanager
def _signals_raise() -> Iterator[None]:
    """While the block runs, SIGTERM and its like raise ``Terminated``, so that unfinished files are removed
    as after Ctrl-C; once, as another one must not break off the tidying. Ignored signals (nohup) stay so."""

    def end(number: int, frame: object) -> None:
        for other in ours:
            signal.signal(other, signal.SIG_IGN)
        raise Terminated(number)

    ours = []
    if threading.current_thread() is threading.main_thread():
        ours = [n for n in messages.ENDINGS if n != signal.SIGINT and signal.getsignal(n) == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _run(name: str, arguments: list[str]) -> int:
    from meshsplats.errors import DataWarning, StraysWarning

    warned: list[tuple[str, ...]] = []

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if isinstance(message, StraysWarning):
            if messages.subject in warned:
                return  # splats and their mesh have the same
            warned.append(messages.subject)
        say(f"warning: {one_line(message)}")

    warnings.simplefilter("always", DataWarning)
    warnings.showwarning = show

    words = _joined([word for word in arguments if word != "--debug"])
    with _standard_input_as_file(words) as words:
        return _execute(name, words)


def _execute(name: str, words: list[str]) -> int:
    from meshsplats._files.atomic import promises_kept
    from meshsplats.cli.arguments import parse, spelled, usage_errors

    module, _, attribute = COMMANDS[name][0].partition(":")
    kind = getattr(importlib.import_module(module), attribute)
    messages.write_options(lambda name: spelled(kind, name))
    with usage_errors(), promises_kept():
        return parse(kind, f"meshsplats {name}", words).execute() or OK


@contextmanager
def _standard_input_as_file(arguments: list[str]) -> Iterator[list[str]]:
    """``arguments`` with the path of a file in place of -, which holds standard input: readers open their
    files several times."""
    messages.read_from_standard_input(None)
    places = [
        i
        for i, argument in enumerate(arguments)
        if argument == "-" and (i == 0 or arguments[i - 1] not in ("-o", "--output", "--config"))
    ]
    if not places:
        yield arguments
        return
    if len(places) > 1:
        raise UsageError("- is standard input, which can be read once")
    if sys.stdin is None or sys.stdin.isatty():
        where = ", in cmd" if sys.platform == "win32" else ""  # PowerShell has no <
        raise UsageError(f"- reads standard input, a terminal here: redirect a file, < scene.ply{where}")
    import shutil
    import tempfile

    with tempfile.TemporaryDirectory(prefix="meshsplats-") as folder:
        try:
            head = sys.stdin.buffer.read(8)
            # What is USD, only its name tells the library that reads it.
            name = "standard-input.usd" if head.startswith((b"PXR-USDC", b"#usda")) else "standard-input"
            path = os.path.join(folder, name)
            with open(path, "wb") as file:
                file.write(head)
                shutil.copyfileobj(sys.stdin.buffer, file, 1 << 20)
        except OSError as error:
            raise OSError(error.errno, f"cannot store standard input: {error.strerror}", folder) from None
        messages.read_from_standard_input(path)  # until the next command: errors are printed after this one
        yield [*arguments[: places[0]], path, *arguments[places[0] + 1 :]]


def _answer(name: str) -> int:
    """Answers --help and --version; an error for an unknown command."""
    if name in ("", "-h", "--help", "help"):
        print(_overview())
        return OK
    if name in ("-V", "--version"):
        import meshsplats

        print(f"meshsplats {meshsplats.__version__}")
        return OK
    from meshsplats._common.options import did_you_mean
    from meshsplats._common.words import command_line

    if os.path.exists(name):
        say(f"error: a file needs a command before it: {command_line(['meshsplats', 'view', name])}")
        return USAGE
    hint = did_you_mean(name, COMMANDS) or f"commands: {', '.join(COMMANDS)}"
    say(f"error: there is no command {name!r}; {hint}")
    return USAGE


def _joined(arguments: list[str]) -> list[str]:
    """``--up -y`` as ``--up=-y``: a value that begins with a minus sign would be taken for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _TAKES_SIGN and argument[:1] == "-" != argument[1:2]:
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
        "  meshsplats COMMAND --help   the most used options of a command; --help-all: all of them\n"
        "  --set NAME=VALUE            with most commands: an option without a flag (docs/options.md)\n"
        "  meshsplats --version\n"
        "  --debug                     with any command: the full traceback of an error\n\n"
        "exit codes: 0 done, 1 wrong input, 2 wrong usage, 3 the output exists, 4 no space, 5 something is\n"
        "missing (a library, a program, memory); 128 + n ended by signal n, 141 by `| head`\n\n"
        "start with:\n"
        "  meshsplats demo                          without a file\n"
        "  meshsplats view scene.ply                in the browser\n"
        "  meshsplats convert scene.ply -o scene.glb"
    )
