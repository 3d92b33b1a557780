# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading and converting in a thread of its own, so that Blender's window stays alive and the work can be
given up."""

import threading
import traceback
import warnings


class Stopped(Exception):
    """The user has pressed Escape."""


class Work:
    """Reads files and prepares their meshes. ``progress`` runs from 0 to 1, ``stage`` says what is being
    done."""

    def __init__(self, paths, choices):
        self.paths = list(paths)
        self.choices = dict(choices)
        self.progress = 0.0
        self.stage = ""
        self.results = []
        """Of each file that could be read: its path and what ``objects.add`` takes."""
        self.problems = []
        """Messages of the files that could not."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run_all, name="meshsplats", daemon=True)

    def start(self):
        self._thread.start()

    def cancel(self):
        """Asks the thread to stop at the next stage; what it still makes is thrown away."""
        self._stop.set()

    @property
    def cancelled(self):
        return self._stop.is_set()

    @property
    def finished(self):
        return not self._thread.is_alive()

    def run(self):
        """The same in this thread, for Blender without a window."""
        self._run_all()

    def _run_all(self):
        for number, path in enumerate(self.paths):
            try:
                with warnings.catch_warnings(record=True) as told:
                    warnings.simplefilter("always")
                    self.results.append((path, self._one(path, number)))
                self.problems += [f"{path}: {warning.message}" for warning in told]
            except Stopped:
                return
            except Exception as error:
                if not isinstance(error, (ValueError, OSError, ImportError, MemoryError)):
                    traceback.print_exc()
                self.problems.append(str(error) or type(error).__name__)

    def _at(self, number, share, stage):
        if self._stop.is_set():
            raise Stopped
        self.progress = (number + share) / len(self.paths)
        self.stage = stage

    def _one(self, path, number):
        from pathlib import Path

        from meshsplats.blender.inside import objects
        from meshsplats.formats.sniff import identify

        self._at(number, 0.0, "reading")
        if identify(Path(path)) == "mesh":
            from meshsplats.formats.meshes import load_mesh

            mesh = load_mesh(path)
        else:
            from meshsplats.conversion import convert
            from meshsplats.formats.gaussians import load_gaussians

            cloud = load_gaussians(path, axes=self.choices["axes"])
            self._at(number, 0.3, "converting")
            options = {"max_triangles": self.choices["max_triangles"] or None}
            if self.choices["min_opacity"] > 0:
                options["min_opacity"] = self.choices["min_opacity"]
            if self.choices["shading"] == "lit":
                options["mode"] = (
                    "flat"  # crossed ellipses stand upright on the surface and catch too little light
                )
            mesh = convert(cloud, preset=self.choices["preset"], **options)
        self._at(number, 0.6, "shading normals" if self.choices["shading"] == "lit" else "counting layers")
        prepared = objects.prepare(mesh, self.choices["shading"] == "lit")
        self._at(number, 1.0, "building")
        return prepared


class Modal:
    """An operator that waits for ``Work`` while Blender goes on; Escape gives up. Mixed into operators."""

    def begin(self, context, work):
        """What ``execute`` returns."""
        self._work = work
        if bpy_background():
            work.run()
            return self._end(context)
        work.start()
        window = context.window_manager
        self._timer = window.event_timer_add(0.1, window=context.window)
        window.progress_begin(0, 100)
        window.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        work = self._work
        if event.type == "ESC" and event.value == "PRESS":
            work.cancel()
            self._clean(context)
            self.report({"INFO"}, "MeshSplats: given up")
            self.given_up()
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        context.window_manager.progress_update(100 * work.progress)
        context.workspace.status_text_set(f"MeshSplats: {work.stage} {work.progress:.0%} (Esc gives up)")
        if not work.finished:
            return {"RUNNING_MODAL"}
        self._clean(context)
        return self._end(context)

    def _clean(self, context):
        window = context.window_manager
        window.progress_end()
        window.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)

    def _end(self, context):
        for problem in self._work.problems:
            self.report({"WARNING"} if self._work.results else {"ERROR"}, problem)
        if not self._work.results:
            self.given_up()
            return {"CANCELLED"}
        self.done(context, self._work)
        return {"FINISHED"}

    def given_up(self):
        """Called when there is no result."""


def bpy_background():
    import bpy

    return bpy.app.background
