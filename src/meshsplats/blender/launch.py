"""Runs Blender as a process of its own, apart from our memory and output, and safe from its crashes."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import is_promised, temporary_beside, write_text
from meshsplats._files.locks import try_lock
from meshsplats.blender import guard
from meshsplats.blender.inside import MISSING, worker
from meshsplats.blender.options import SceneOptions
from meshsplats.errors import MissingDependencyError
from meshsplats.scene.camera import Camera

OLDEST = (4, 2)
JOB = "job.json"
"""For which the worker waits, in the folder of the process."""

EEVEE_ATTEMPTS = 3
"""How often Blender is started for EEVEE. Without a graphics card, 5.3.0 crashes now and then."""

_GRAPHICS = "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri"
_LIBRARIES = (
    " It needs these libraries of the system, even where there is no screen; on Debian and Ubuntu:"
    " apt install libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1 libgomp1"
    if sys.platform.startswith("linux")
    else ""
)


@dataclass(frozen=True)
class Progress:
    """Progress of a Blender job."""

    done: int
    """Images finished."""
    images: int
    """Images in all."""
    share: float
    """Share of the samples of the current image, 0 to 1."""
    stage: str
    """Current step, in Blender's words."""
    left: str | None
    """Blender's estimate of the time left for the current image, if any."""

    @property
    def phase(self) -> str:
        """What is done before the images; '' for a step of an image, in Blender's words."""
        return self.stage if self.stage[:1].islower() else ""


class BlenderError(ChildProcessError):
    """Blender failed; the message quotes it."""


def command(executable: Path | None) -> list[str]:
    """The command line that runs the worker, without its argument.

    Raises:
        MissingDependencyError: no bpy, and no executable given.
        FileNotFoundError: the executable is missing.
        ValueError: the executable is not Blender, or too old.
    """
    if executable is None:
        if importlib.util.find_spec("bpy") is None:
            raise MissingDependencyError(MISSING)
        return [sys.executable, "-m", worker.__name__]
    # A path is without its "./", so that a file here is second to a program of that name.
    # As text: on Windows, which() of Python 3.11 takes no Path. It adds no ending to the last name of a path.
    program, ending = os.fspath(executable), ".exe" if sys.platform == "win32" else ""
    tried = (program, os.path.abspath(program), os.path.abspath(program) + ending)
    found = next(filter(None, map(shutil.which, tried)), None)
    if found is None:
        raise FileNotFoundError(f"{executable}: there is no such program; --executable names Blender's own")
    try:
        answer = subprocess.run([found, "--version"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ValueError(f"{found}: cannot be run as Blender ({error})") from None
    text = answer.stdout or answer.stderr  # the latter where libraries are missing
    version = re.search(r"Blender (\d+)\.(\d+)", text)
    if version is None:
        raise ValueError(f"{found}: not Blender; asked for its version, it says {text.strip()[:200]!r}")
    if (int(version[1]), int(version[2])) < OLDEST:
        raise ValueError(f"{found}: Blender {version[1]}.{version[2]} is too old; 4.2 or newer is needed")
    flags = ["--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    return [os.path.abspath(found), *flags, str(Path(worker.__file__).resolve()), "--"]


@dataclass(frozen=True)
class Job:
    """A job of Blender's, which has been started and loads; see ``begun``."""

    process: subprocess.Popen[str]
    folder: Path
    """Of the process."""
    options: SceneOptions
    images: Sequence[Path]
    blend: Path | None
    temporary: Mapping[str, str]
    """Where each output is written before it has its name."""

    def run(
        self,
        subjects: Sequence[tuple[dict[str, np.ndarray], dict[str, Any]]],
        cameras: Sequence[Camera],
        *,
        limit: int,
        progress: Callable[[Progress], object] | None = None,
    ) -> dict[str, Any]:
        """Has Blender build the scene, save the file and render the images; once.

        Args:
            subjects: arrays and facts, the fields of ``inside.scene.Subject``; of a chain, those of each
                level, the finest first.
            cameras: at least one per image.
            limit: on transparent bounces.
            progress: called whenever Blender reports progress.

        Returns:
            ``{"blender": version, "build_seconds": s, "build_processor_seconds": s, "image_seconds": [s,
            ...], "image_processor_seconds": [s, ...]}``.

        Raises:
            BlenderError: Blender failed; the message quotes it.
            MissingDependencyError: system libraries are missing; see also ``command``.
            OSError: an output cannot be written (a full disk, a name that another process has taken
            meanwhile).
        """
        stored = []
        for level, (arrays, facts) in enumerate(subjects):
            files = {name: str(self.folder / f"{name}_{level}.npy") for name in arrays}
            for name, array in arrays.items():
                np.save(files[name], array, allow_pickle=False)
            stored.append((files, facts))
        job = {
            "subjects": stored,
            "cameras": [_plain_camera(camera) for camera in cameras],
            "options": _plain_options(self.options),
            "limit": limit,
            "blend": None if self.blend is None else os.path.abspath(self.blend),
            "images": [os.path.abspath(path) for path in self.images],
            "temporary": dict(self.temporary),
            "new": [path for path in self.temporary if is_promised(path)],
        }
        write_text(self.folder / JOB, json.dumps(job))
        return _follow(self.process, self.options, len(self.images), progress)


@contextmanager
def begun(
    options: SceneOptions,
    *,
    images: Sequence[Path] = (),
    blend: Path | None = None,
    executable: Path | None = None,
) -> Iterator[Job]:
    """Starts Blender, which loads while its job is prepared.

    Blender ends with the context and with this process, however that ends, and leaves nothing behind
    (``guard``).

    Args:
        images, blend: what the job will write.

    Raises MissingDependencyError where libraries for EEVEE are missing, and what ``command`` raises.
    """
    start = command(executable)
    if options.engine == "eevee":
        _check_graphics()
    outputs = [path for path in (*images, blend) if path is not None]
    with _scratch() as (folder, lock):
        temporary = {os.path.abspath(path): str(temporary_beside(path)) for path in outputs}
        plan = {
            "command": [*start, str(folder / JOB)],
            "remove": [*temporary.values(), str(folder)],
            "outputs": list(temporary),
            "attempts": EEVEE_ATTEMPTS if options.engine == "eevee" else 1,
        }
        (folder / "plan.json").write_bytes(json.dumps(plan).encode())
        process = _start(start, folder, lock)
        try:
            yield Job(process, folder, options, images, blend, temporary)
        except BaseException:
            _end(process)
            raise
        finally:
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()
            for path in temporary.values():  # of a Blender that crashed
                Path(path).unlink(missing_ok=True)


@contextmanager
def _scratch() -> Iterator[tuple[Path, int]]:
    """A temporary folder and the descriptor of its lock, which marks it as in use. Removes folders out of
    use, left by processes that were killed together with their guards."""
    prefix = "meshsplats-blender-"
    for old in Path(tempfile.gettempdir()).glob(f"{prefix}*/lock"):
        with suppress(OSError):
            descriptor = try_lock(old)
            if descriptor is not None:
                os.close(descriptor)
                shutil.rmtree(old.parent, ignore_errors=True)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix)).absolute()  # TMPDIR may be "."
        descriptor = None
        with suppress(FileNotFoundError):  # another process has just removed it
            descriptor = try_lock(folder / "lock")
        if descriptor is not None:
            break
    try:
        yield folder, descriptor
    finally:
        os.close(descriptor)
        shutil.rmtree(folder, ignore_errors=True)


def _start(command: Sequence[str], folder: Path, lock: int) -> subprocess.Popen[str]:
    environment = dict(os.environ)
    if command[1] == "-m":
        # The worker must import this very package, wherever this process found it, from another folder.
        given = filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))
        paths = [*map(os.path.abspath, given), str(Path(worker.__file__).resolve().parents[3])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
    # Blender's own temporary files go into our folder.
    environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    return subprocess.Popen(
        [sys.executable, "-I", "-S", guard.__file__, str(folder / "plan.json")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment,
        text=True,
        errors="replace",
        start_new_session=True,  # the guard must survive our process group to clean up
        pass_fds=() if sys.platform == "win32" else (lock,),
    )


def _end(process: subprocess.Popen[str]) -> None:
    """Has the guard end Blender."""
    assert process.stdin is not None
    with suppress(OSError):
        process.stdin.close()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _follow(
    process: subprocess.Popen[str],
    options: SceneOptions,
    images: int,
    progress: Callable[[Progress], object] | None,
) -> dict[str, Any]:
    """What the worker says, until it ends."""
    result: dict[str, Any] = {"image_seconds": [], "image_processor_seconds": []}
    said: deque[str] = deque(maxlen=40)
    finished, failure, unloadable, status = False, None, None, None
    at = Progress(0, images, 0.0, "starting", None)
    assert process.stdout is not None
    for line in process.stdout:
        if not line.startswith(worker.MARK):
            said.append(line.rstrip())
            continue
        message = json.loads(line[len(worker.MARK) :])
        if "built" in message:
            result |= {"blender": message["blender"], "build_seconds": message["built"]}
            result["build_processor_seconds"] = message["processor"]
        elif "image" in message:
            result["image_seconds"].append(message["seconds"])
            result["image_processor_seconds"].append(message["processor"])
            at = Progress(at.done + 1, images, 0.0, "", None)
        elif "stage" in message:
            at = replace(at, share=message["share"], stage=message["stage"], left=message["left"])
        status = message.get("ended", status)
        if progress is not None and ("image" in message or "stage" in message):
            progress(at)
        finished |= "done" in message
        failure = message.get("error", failure)
        unloadable = message.get("unloadable", unloadable)
    ended = process.wait()
    status = ended if status is None else status
    if unloadable is not None:
        raise MissingDependencyError(f"Blender's module bpy cannot be loaded: {unloadable}.{_LIBRARIES}")
    if isinstance(failure, list):
        raise OSError(*failure)
    if failure is not None:
        raise BlenderError(f"Blender stopped: {failure}")
    if not finished:
        raise BlenderError(_post_mortem(status, said, options))
    return result


def _post_mortem(status: int, said: Sequence[str], options: SceneOptions) -> str:
    words = " / ".join(line for line in list(said)[-6:] if line) or "nothing"
    how = f"with exit code {status}" if status >= 0 else f"by signal {signal.Signals(-status).name}"
    advice = ""
    if sys.platform != "win32" and status == -signal.SIGKILL:
        advice = " The system ends programs that need more memory than there is: use fewer triangles."
    elif options.engine == "eevee":
        advice = (
            " EEVEE needs OpenGL 4.3, with or without a screen; on Debian and Ubuntu:"
            f" apt install {_GRAPHICS}. Without a graphics card, it also crashes now and then."
            " --engine cycles does without."
        )
    return f"Blender ended {how} before it was done.{advice} It said: {words}"


def _check_graphics() -> None:
    """Raises MissingDependencyError where libraries that EEVEE needs are missing (Linux)."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        raise MissingDependencyError(
            "EEVEE draws with OpenGL, and libEGL.so.1 is not on this system; on Debian and Ubuntu:"
            f" apt install {_GRAPHICS}. --engine cycles does without"
        ) from None


def _plain_camera(camera: Camera) -> dict[str, Any]:
    fields = ("fx", "fy", "cx", "cy", "width", "height", "near", "name")
    return {name: getattr(camera, name) for name in fields} | {
        "world_to_camera": camera.world_to_camera.tolist()
    }


def _plain_options(options: SceneOptions) -> dict[str, Any]:
    plain = asdict(replace(options, within=None))  # Blender gets what was made of them
    if options.light is not None and options.light.hdri is not None:
        plain["light"]["hdri"] = os.path.abspath(options.light.hdri)
    return plain
