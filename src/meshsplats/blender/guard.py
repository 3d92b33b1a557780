"""Runs Blender and ends it when its parent process ends, however that happens; nothing is left behind.

Run as a file, without this package: ``python guard.py plan.json``. The plan: ``command``, ``remove`` (files
and folders), ``outputs``, and ``attempts``: how often Blender is started while it crashes before it has
written an output. Standard input is a pipe from the parent that carries no data. It closes when the parent
ends, by kill -9 too, or wants Blender to end; then Blender's process group is killed.

A process of its own, because threads in Blender's Python wait while Blender works and would notice late.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading

MARK = "@meshsplats "
"""Prefix of output lines for the parent process, as in ``inside.worker``."""
CRASHES = {-getattr(signal, name) for name in ("SIGSEGV", "SIGABRT", "SIGBUS") if hasattr(signal, name)}


def main(plan_path: str) -> int:
    with open(plan_path, encoding="utf-8") as file:
        plan = json.load(file)
    before = _written(plan["outputs"])
    abandoned = threading.Event()
    running: list[subprocess.Popen[bytes]] = []

    def watch() -> None:
        while os.read(0, 4096):
            pass
        abandoned.set()
        for process in running:
            _kill(process)

    threading.Thread(target=watch, daemon=True).start()
    status, folder = 0, os.path.dirname(os.path.abspath(plan_path))
    for _ in range(plan["attempts"]):
        running[:] = [_started(plan["command"], folder)]
        if abandoned.is_set():
            _kill(running[0])
        status = running[0].wait()
        if abandoned.is_set() or status not in CRASHES or _written(plan["outputs"]) != before:
            break
        for path in filter(os.path.isfile, plan["remove"]):
            os.unlink(path)
    if abandoned.is_set():
        for path in plan["remove"]:
            if os.path.isdir(path):
                shutil.rmtree(path, ignore_errors=True)
            elif os.path.exists(path):
                os.unlink(path)
        return 1
    print(MARK + json.dumps({"ended": status}), flush=True)
    return 0


def _started(command: "list[str]", folder: str) -> "subprocess.Popen[bytes]":
    # Python and Blender's own import from the current folder first, which may be a stranger's: it is ours.
    # Blender leads a process group of its own, so that children of a wrapper script end with it.
    process = subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, start_new_session=True)
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.write(b"\n")  # shows the worker that this pipe is ours
        process.stdin.flush()
    return process


def _written(paths: "list[str]") -> "list[int]":
    """When each of the files was written, 0 where there is none."""
    return [os.stat(path).st_mtime_ns if os.path.exists(path) else 0 for path in paths]


def _kill(process: "subprocess.Popen[bytes]") -> None:
    with contextlib.suppress(OSError):  # it may have ended meanwhile
        if sys.platform == "win32":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
