"""The command ``meshsplats``. Each sub-command is a dataclass in a module of its own, whose fields are its
options.

A module is imported only when its command runs, so that ``meshsplats --version`` and the overview are quick.
"""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Sequence

COMMANDS = {
    "convert": ("meshsplats.cli.convert:Convert", "splats to a mesh of translucent triangles"),
    "render": ("meshsplats.cli.render:Render", "pictures of splats or a mesh, and a turntable"),
    "compare": ("meshsplats.cli.compare:Compare", "mesh against splats: PSNR, SSIM, pictures side by side"),
    "finetune": ("meshsplats.cli.finetune:Finetune", "the mesh brought closer to splats or photographs"),
    "simplify": ("meshsplats.cli.simplify:Simplify", "fewer splats that look the same"),
    "levels": ("meshsplats.cli.levels:Levels", "levels of detail: meshes for ever smaller sizes"),
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


class UsageError(Exception):
    """Options that contradict each other: exit code 2."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line ``argv`` (without the program's name; None: that of the process).

    Returns the exit code: 0, 1 for an error in the input or the files, 2 for wrong usage, 130 for Ctrl-C.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_overview())
        return 0
    if arguments[0] in ("-V", "--version"):
        import meshsplats

        print(f"meshsplats {meshsplats.__version__}")
        return 0
    name = arguments[0]
    if name not in COMMANDS:
        return _unknown(name)
    debug = "--debug" in arguments
    try:
        with warnings.catch_warnings():
            return _run(name, [a for a in arguments[1:] if a != "--debug"])
    except SystemExit as stop:  # tyro has shown help, or what is wrong with the arguments
        return stop.code if isinstance(stop.code, int) else 2
    except KeyboardInterrupt:
        _say("interrupted; no file was left half-written")
        return 130
    except BrokenPipeError:
        # The reader of our output has gone, `| head` say. Python must not find that out again when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except UsageError as error:
        if debug:
            raise
        _say(f"error: {error} (see meshsplats {name} --help)")
        return 2
    except (ValueError, OSError, ImportError, MemoryError) as error:
        if debug:
            raise
        _say(f"error: {_one_line(error)}")
        return 1


def _run(name: str, arguments: list[str]) -> int:
    from meshsplats.errors import DataWarning

    warnings.simplefilter("always", DataWarning)
    warnings.showwarning = lambda message, *_, **__: _say(f"warning: {_one_line(message)}")

    import tyro

    module, _, attribute = COMMANDS[name][0].partition(":")
    command = getattr(importlib.import_module(module), attribute)
    options = tyro.cli(
        command,
        args=_joined(arguments),
        prog=f"meshsplats {name}",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    return options.run() or 0


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
        "start with:\n"
        "  meshsplats convert scene.ply -o scene.glb"
    )


def _unknown(name: str) -> int:
    import difflib

    close = difflib.get_close_matches(name, COMMANDS, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"commands: {', '.join(COMMANDS)}"
    _say(f"error: there is no command {name!r}; {hint}")
    return 2


def _one_line(error: object) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f"{os.fsdecode(error.filename)}: {error.strerror}"
    else:
        text = str(error)
    if isinstance(error, MemoryError) and not text:
        text = "out of memory"
    return " ".join(text.split()) or type(error).__name__


def _say(text: str) -> None:
    print(f"meshsplats: {text}", file=sys.stderr)
