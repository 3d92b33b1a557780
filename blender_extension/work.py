# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading and converting in a thread, so that Blender's window stays responsive and the user can cancel."""

import threading
import traceback
import warnings
from contextlib import contextmanager
from dataclasses import dataclass

Z_AXES = {"z-up": (0.0, 0.0, 1.0), "z-down": (0.0, 0.0, -1.0)}
"""Choices of what points up in a file, besides those of ``load_gaussians``."""


class Stopped(Exception):
    """The user pressed Escape."""


@dataclass(frozen=True)
class Result:
    """A file that was read: a mesh, or the levels of a chain."""

    path: str
    name: str
    prepared: tuple
    """Arguments of ``objects.add``; of a chain, for each level, the finest first."""
    level_paths: tuple = ()
    """Of a chain: the file of each level."""
    screen_sizes: tuple = ()
    """Of a chain: of each level, the size for which it was made, in pixels."""
    views: tuple | None = None
    """A ``Camera`` for each view of a place from within, relative to the file's origin, the first one to open
    with; none of an object. None: not looked for."""

    def remember_views(self, obj):
        """Stores them with ``obj``, the finest level."""
        from meshsplats.blender.inside import views

        if self.views is not None:
            origin = self.prepared[0]["origin"]
            views.remember(obj, [view.relative_to(origin) for view in self.views])


@contextmanager
def own_warnings():
    """Yields a list that collects what MeshSplats warns of, not what other add-ons do meanwhile."""
    from meshsplats.errors import DataWarning

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", DataWarning)
        yield caught


class Work:
    """Reads files and prepares their meshes. ``progress`` runs from 0 to 1, ``stage`` names the current
    step."""

    def __init__(self, paths, choices):
        self.paths = list(paths)
        self.choices = dict(choices)
        self.progress = 0.0
        self.stage = ""
        self.results = []
        """A ``Result`` for each file that could be read."""
        self.problems = []
        """Messages for the files that could not."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run_all, name="meshsplats", daemon=True)

    def start(self):
        self._thread.start()

    def cancel(self):
        """Asks the thread to stop at the next stage; its results are discarded."""
        self._stop.set()

    @property
    def cancelled(self):
        return self._stop.is_set()

    @property
    def finished(self):
        return not self._thread.is_alive()

    def run(self):
        """Runs in this thread, for Blender without a window."""
        self._run_all()

    def _run_all(self):
        for index, path in enumerate(self.paths):
            try:
                with own_warnings() as caught:
                    self.results.append(self._one(path, index))
                self.problems += [f"{path}: {warning.message}" for warning in caught]
            except Stopped:
                return
            except Exception as error:
                if not isinstance(error, (ValueError, OSError, ImportError, MemoryError)):
                    traceback.print_exc()
                self.problems.append(str(error) or type(error).__name__)

    def _at(self, progress, stage):
        if self._stop.is_set():
            raise Stopped
        self.progress = progress / max(len(self.paths), 1)
        self.stage = stage

    def _one(self, path, index):
        from pathlib import Path

        from meshsplats.blender.levels import is_chain, read_chain
        from meshsplats.formats.splat_paths import subject_name

        if not is_chain(Path(path)):
            prepared, views = self._prepared(path, index, 1.0)
            return Result(path, subject_name(Path(path)), (prepared,), views=views)
        chain = read_chain(Path(path))
        files = tuple(str(level.path) for level in chain.levels)
        share = 1 / len(files)
        levels, views = [], None
        for i, file in enumerate(files):  # what is seen from within the finest is seen in all
            prepared, views = self._prepared(file, index + i * share, share, views)
            levels.append(prepared)
        sizes = tuple(level.screen_size for level in chain.levels)
        return Result(path, chain.name, tuple(levels), files, sizes, views)

    def _prepared(self, path, begin, share, views=None):
        """Arguments of ``objects.add``, and views from within a place, which are looked for unless given.
        Progress, in files, goes from ``begin`` on by ``share``."""
        from pathlib import Path

        from meshsplats.formats.sniff import identify

        self._at(begin, "reading")
        if identify(Path(path)) == "mesh":
            from meshsplats.formats.meshes import load_mesh

            scene = mesh = load_mesh(path)
        else:
            scene = self._splats(path)
            self._at(begin + 0.3 * share, "converting")
            mesh = self._converted(scene, source=Path(path))
        if views is None and self.choices.get("frame_view"):
            self._at(begin + 0.4 * share, "looking for a view")
            views = self._views(scene, path)
        # One alone is a given start camera: what light needs is still to be found.
        known = None if views is None or len(views) == 1 else views
        return self._ready(mesh, begin, share, known), views

    def _splats(self, path):
        from dataclasses import replace

        from meshsplats.formats.gaussians import load_gaussians

        axes = self.choices["axes"]
        if axes not in Z_AXES:
            return load_gaussians(path, axes=axes)
        return replace(load_gaussians(path, axes="y-down"), up=Z_AXES[axes])  # y-down: as the file has it

    def _views(self, scene, path):
        """The views of a place from within, the first one to open with; none of an object, and of a mesh that
        is no fans of splats."""
        from pathlib import Path

        from meshsplats.blender.subject import VIEWS
        from meshsplats.conversion.recovery import splats_of
        from meshsplats.viewpoints.showing import default_views, opening_beside

        cloud = splats_of(scene)
        if cloud is None:
            return ()
        opening = opening_beside(Path(path), cloud.origin)
        found = default_views(cloud, Path(path), VIEWS if opening is None else 1, side=(400, 400))
        return tuple(found[0]) if found else ()

    def _converted(self, cloud, up=None, source=None, **options):
        """The mesh of ``cloud``; a place that a limit wants merged is merged as it is seen from within."""
        from meshsplats.conversion import ConversionOptions
        from meshsplats.conversion.merging_views import convert_within_limits

        options["max_triangles"] = self.choices["max_triangles"] or None
        if self.choices["min_opacity"] > 0:
            options["min_opacity"] = self.choices["min_opacity"]
        if self.choices["shading"] == "lit":
            # Crossed ellipses stand upright on the surface and catch too little light.
            options["mode"] = "flat"
        preset, chosen = self.choices["preset"], ConversionOptions(**options)
        return convert_within_limits(cloud, chosen, preset=preset, up=up, source=source)

    def _ready(self, mesh, begin, share, views=None):
        from meshsplats.blender.inside import objects

        lit = self.choices["shading"] == "lit"
        self._at(begin + 0.6 * share, "counting layers")
        phases = iter((0.6, 0.7, 0.8, 0.9))

        def announce(phase):  # Escape takes effect between phases
            self._at(begin + next(phases, 0.9) * share, f"{phase} for light")

        fast = self.choices.get("fast", False)
        prepared = objects.prepare(mesh, lit, fast=fast, views=views, announce=announce)
        self._at(begin + share, "building")
        return prepared


class CloudWork(Work):
    """Converts splats that are in the scene already: ``cloud``, with ``up`` in its frame."""

    def __init__(self, cloud, name, up, choices):
        super().__init__([name], choices)
        self._cloud, self._up = cloud, up

    def _one(self, path, index):
        from meshsplats.blender.subject import views_within

        self._at(index, "converting")
        mesh, views = self._converted(self._cloud, self._up), None
        if self.choices.get("frame_view"):
            self._at(index + 0.4, "looking for a view")
            views = tuple(views_within(self._cloud, up=self._up))
        return Result("", path, (self._ready(mesh, index, 1.0, views),), views=views)


class AgainWork(Work):
    """Converts objects again, by their names: files from ``paths``, or, of objects that were edited or joined
    since, the splats of their meshes ``own``. ``views`` are those within places, where they are known."""

    def __init__(self, paths, own, views, choices):
        super().__init__([*paths, *own], choices)
        self.own = own
        self._files, self._views_of = paths, views

    def _one(self, name, index):
        from meshsplats.blender.inside import sources

        views = self._views_of[name]
        if name in self._files:
            path = self._files[name]
            return Result(path, name, (self._prepared(path, index, 1.0, views)[0],))
        self._at(index, "converting")
        cloud = sources.own_splats(self.own[name], name)
        # They are as wide as their fans, which the first conversion has made wider and shrunk.
        mesh = self._converted(cloud, footprint="none", shrink_faint=False)
        return Result("", name, (self._ready(mesh, index, 1.0, views),))


class LightWork(Work):
    """Prepares ``sources``, meshes or splats that Blender draws (``objects.light_source``), by the names of
    their objects: unlit or lit; the latter are lit."""

    def __init__(self, sources, shading, fast=False):
        import bpy

        from meshsplats.blender.inside import objects, stand_ins

        super().__init__(sources, {"shading": shading, "fast": fast})
        self._sources = sources
        named = {name: bpy.data.objects[name] for name in sources}
        self.shapes = {name: stand_ins.shape(obj.data) for name, obj in named.items()}
        self._views_of = {name: objects.views_within(obj) for name, obj in named.items()}

    def _one(self, path, index):
        return Result("", path, (self._ready(self._sources[path], index, 1.0, self._views_of[path]),))


class Modal:
    """Mix-in for operators that wait for ``Work`` while Blender stays responsive; Escape cancels."""

    def begin(self, context, work):
        """Return value of ``execute``."""
        from meshsplats.blender.inside import notes

        self._work = work
        notes.take()  # of what scripts did before
        # What Adjust Last Operation or Repeat Last begins must be done at once: Blender lists it twice among
        # the last operations if it becomes modal, and crashes.
        if bpy_background() or self.options.is_repeat or self.options.is_repeat_last:
            with waiting(context):
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
            self.report({"INFO"}, "MeshSplats: cancelled")
            self.cancelled()
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        context.window_manager.progress_update(100 * work.progress)
        context.workspace.status_text_set(f"MeshSplats: {work.stage} {work.progress:.0%} (Esc cancels)")
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
        if self._work.paths and not self._work.results:
            self.cancelled()
            return {"CANCELLED"}
        try:
            self.done(context, self._work)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        report_notes(self)
        return {"FINISHED"}

    def cancelled(self):
        """Called when there is no result."""


def report_notes(operator):
    """``operator`` reports what was done in passing since notes were taken last."""
    from meshsplats.blender.inside import notes

    for note in notes.take():
        operator.report({"INFO"}, f"MeshSplats: {note}")


@contextmanager
def waiting(context):
    """The wait cursor, while an operator computes without a thread."""
    window = None if bpy_background() else context.window
    if window is not None:
        window.cursor_modal_set("WAIT")
    try:
        yield
    finally:
        if window is not None:
            window.cursor_modal_restore()


def hide_start_scene(operator, scene):
    """Hides what Blender starts with from ``scene``, as ``operator`` then reports."""
    from meshsplats.blender.inside import setting

    hidden = setting.hide_start_scene(scene)
    if hidden:
        operator.report({"INFO"}, f"MeshSplats: hid what Blender starts with: {', '.join(hidden)}")


def settle(operator, context, objs):
    """Selects new splat meshes, hides Blender's start scene, shows them in the viewports, a place from
    within, and, if ``operator`` is to, sets up the render for all of the scene."""
    from meshsplats.blender.inside import objects, setting, views

    for other in context.selected_objects:
        other.select_set(False)
    for obj in objs:
        obj.select_set(True)
    if operator.hide_start_scene:
        hide_start_scene(operator, context.scene)
    context.view_layer.update()
    if operator.frame_view:
        windows = context.window_manager.windows
        view = views.opening(objs)
        if view is None:
            setting.frame_in_viewports(windows, objs)
            setting.frame_in_start_camera(context.scene, objs)
        else:
            setting.look_from(view, windows, context.scene)
    if operator.show_colors:
        setting.show_colors(context.window_manager.windows, "MATERIAL")
    if operator.use_cycles:
        context.scene.render.engine = "CYCLES"
    if operator.set_up_scene:
        # Rays may pass through several meshes.
        every = objects.splat_objects(context.scene)
        chosen = operator.properties.is_property_set("set_up_scene")
        setting.set_up_render(context.scene, every, operator.shading == "lit", chosen=chosen)
        clash = objects.clash(every, operator.shading == "lit")
        if clash:
            operator.report({"WARNING"}, f"MeshSplats: {clash}")


def follow_shading(operator, scene, lit):
    """Sets up the render for splat meshes that have become ``lit`` or unlit, unless others in the ``scene``
    are of the other kind: ``operator`` then says so."""
    from meshsplats.blender.inside import objects, setting

    every = objects.splat_objects(scene)  # Blender's own splats are right in light's settings, lit or not
    if all(objects.is_lit(obj) == lit for obj in every):
        setting.set_up_render(scene, every, lit)
    else:
        operator.report(
            {"WARNING"},
            "MeshSplats: some splats are lit and others not: choose under Render settings whose colours are"
            " right",
        )


def take_over(operator, work):
    """Gives the objects that ``work``, a ``LightWork``, was about their new meshes, but for those that were
    edited or deleted meanwhile. Returns the names of those that got theirs; ``operator`` reports the others,
    and what was lost."""
    import bpy

    from meshsplats.blender.inside import objects, stand_ins

    from .checks import report_lost

    done, changed = [], []
    for result in work.results:
        obj = bpy.data.objects.get(result.name)
        if obj is None or stand_ins.shape(obj.data) != work.shapes[result.name]:
            changed.append(result.name)
            continue
        report_lost(operator, {obj.name: objects.take_light(obj, result.prepared[0])})
        obj.meshsplats.shading = work.choices["shading"]
        done.append(result.name)
    if changed:
        what = "was edited, renamed or deleted meanwhile, and left out"
        operator.report({"WARNING"}, f"MeshSplats: {', '.join(changed)}: {what}")
    return done


def bpy_background():
    import bpy

    return bpy.app.background
