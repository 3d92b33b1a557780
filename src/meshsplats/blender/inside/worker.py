"""Runs a job inside Blender: ``python -m meshsplats.blender.inside.worker job.json``, or Blender
itself with ``--python worker.py -- job.json``. ``meshsplats.blender.launch`` writes the job and reads the
result."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

if __package__ in (None, ""):  # run as a file by Blender, whose Python does not know this package
    # It alone: beside it may lie what was installed for another Python, NumPy above all.
    package = Path(__file__).resolve().parents[2]
    spec = importlib.util.spec_from_file_location(package.name, package / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    sys.modules[package.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[package.name])

MARK = "@meshsplats "
"""Prefix of output lines for the parent process."""


def report(**message: object) -> None:
    print(MARK + json.dumps(message), flush=True)


def end_with_parent() -> None:
    """Ends Blender when the process that started it ends: at once where the kernel does it (Linux), else as
    soon as Python runs, by the pipe on standard input."""
    if sys.platform.startswith("linux"):
        import ctypes
        import signal

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG

    def watch() -> None:
        if os.read(0, 1):  # nothing comes if a wrapper script has not passed the pipe on
            while os.read(0, 4096):
                pass
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def report_stage(text: str, *_: object) -> None:
    """Reports Blender's status text of the current image."""
    sample = re.search(r"Sample (\d+)/(\d+)", text)
    left = re.search(r"Remaining: ?([\d:.]+)", text)
    share = int(sample[1]) / max(int(sample[2]), 1) if sample else 0.0
    words = [part.strip() for part in text.split("|")]
    stage = sample[0] if sample else words[-1]
    if sample or "Updating" in stage or "Building" in stage:
        report(stage=stage[:60], share=share, left=left[1] if left else None)


def main(job_path: str) -> None:
    end_with_parent()
    import numpy as np

    try:
        import bpy
    except ModuleNotFoundError:
        raise
    except ImportError as error:
        report(unloadable=str(error))
        sys.exit(1)

    from meshsplats._files.atomic import atomic_path
    from meshsplats.blender.inside import far_to_near, rendering, stage, versions, written
    from meshsplats.blender.inside.scene import Subject, build
    from meshsplats.blender.options import LightOptions, SceneOptions
    from meshsplats.scene.camera import Camera

    if bpy.app.version < versions.OLDEST:
        raise ValueError(f"Blender 4.2 or newer is needed, this is {bpy.app.version_string}")
    while not os.path.exists(job_path):  # it is prepared meanwhile
        time.sleep(0.02)
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    subject, *coarser = (
        Subject(**{name: np.load(file, allow_pickle=False) for name, file in arrays.items()}, **facts)
        for arrays, facts in job["subjects"]
    )
    light = job["options"].pop("light")
    if light is not None:
        light["hdri"] = Path(light["hdri"]) if light["hdri"] else None
        light = LightOptions(**light)
    options = SceneOptions(light=light, **job["options"])
    if light is not None and job["images"] and all(path.lower().endswith(".exr") for path in job["images"]):
        # An .exr holds linear light without exposure, the background too.
        options = replace(options, light=replace(light, exposure=0.0))
    cameras = [Camera(np.array(c.pop("world_to_camera")), **c) for c in job["cameras"]]
    temporary, new = job["temporary"], job["new"]
    blend, targets = job["blend"], [Path(target) for target in job["images"]]

    start, processor = time.perf_counter(), time.process_time()
    report(stage="building the scene", share=0.0, left=None)
    built = build(
        subject,
        cameras,
        options,
        job["limit"],
        edges=bool(blend),
        coarser=coarser,
        announce=lambda phase: report(stage=phase, share=0.0, left=None),
    )
    report(
        built=round(time.perf_counter() - start, 3),
        processor=round(time.process_time() - processor, 3),
        blender=bpy.app.version_string,
    )
    if blend:
        bpy.context.preferences.filepaths.save_version = 0
        with atomic_path(blend, temporary=Path(temporary[blend]), new=blend in new) as path:
            bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, compress=True, check_existing=False)
            written.check_blend(path)
        report(saved=blend)
    factor = options.samples if light is None else 1
    if light is None:
        # Unlit splats throw no shadows, for which EEVEE would take most of the time of an image.
        versions.set_if_there(built.scene.eevee, use_shadows=False)
    bpy.app.handlers.render_stats.append(report_stage)
    for i, target in enumerate(targets):
        camera, obj = cameras[i], built.cameras[i]
        built.scene.frame_set(i)  # the timeline makes camera i the active one
        stage.aim(built.scene, camera, obj, factor)
        far_to_near.follow_camera(built.scene)
        start, processor = time.perf_counter(), time.process_time()
        name = str(target)
        with atomic_path(target, temporary=Path(temporary[name]), new=name in new) as path:
            rendering.render_to(built.scene, path, factor, scratch=Path(job_path).parent)
        report(
            image=str(target),
            seconds=round(time.perf_counter() - start, 3),
            processor=round(time.process_time() - processor, 3),
        )
    report(done=True)


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    try:
        main(arguments[0])
    except Exception as error:
        import traceback

        traceback.print_exc()
        if isinstance(error, OSError) and error.filename is not None:
            report(error=[error.errno, error.strerror, os.fsdecode(error.filename)])
            sys.exit(1)
        report(error=f"{type(error).__name__}: {error}")
        sys.exit(1)
