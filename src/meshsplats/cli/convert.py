"""``meshsplats convert``: splats to a mesh."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._words import optional_up
from meshsplats.camera import Camera
from meshsplats.cli.common import (
    again,
    alpha_in_words,
    draw_preview,
    plural,
    say_origin,
    size_of,
    track,
    warnings_kept,
    written,
)
from meshsplats.cli.convert_options import ConvertCommand
from meshsplats.cli.images import views_of_a_place
from meshsplats.cli.messages import (
    FAILED,
    NO_SPACE,
    OK,
    UsageError,
    command_line,
    error_record,
    exit_code,
    one_line,
    say,
    shown_path,
)
from meshsplats.cli.records import changes_since, write_configuration
from meshsplats.errors import DataWarning
from meshsplats.file_conversion import Callbacks, Converter, seen_from
from meshsplats.formats.mesh_formats import mesh_format_to_write
from meshsplats.formats.outputs import CONFIGURATION, beside, check_mesh_suffix, means_splats
from meshsplats.formats.splat_formats import written_ending
from meshsplats.formats.streaming import SplatStream
from meshsplats.gaussians import GaussianCloud
from meshsplats.jobs import Job, is_batch, jobs, sources, without_results

_IDLE = ("fidelity", "no_preview", "no_sidecar", "stream")
"""Options that do not change the mesh."""
ENGINE_GAIN = "7 to 10 dB in minutes, on three scenes"
"""What meshes for a depth buffer gain in three.js with MSAA: docs/viewers.md."""
ORDER_GAIN = "7 to 10 dB in three.js and Babylon.js in half a minute; not for ray tracers and CesiumJS"
"""What a solved order gains there: benchmarks/results/viewers_ordered.md."""


@dataclass(frozen=True)
class Convert(ConvertCommand):
    """Converts splats to a mesh of translucent, vertex-coloured triangles; several files or folders, into a
    folder. Converts meshes to other formats, and splats, too: with --as-splats, or a name such as scene.spz.

    Writes a preview and the configuration beside the result.
    """

    def execute(self) -> int:
        if not self.input:
            raise UsageError("give a splat file, a mesh or a folder to convert")
        ending = written_ending(self.output.name)
        if not self.as_splats and means_splats(self.formats or [ending]):
            return replace(self, as_splats=True).execute()
        batch = is_batch(self.input)
        folder = batch or bool(self.formats) or self.output.is_dir()
        formats = self._formats(folder)
        self.check_options(formats or [ending])
        found = sources(self.input)
        preview = not (self.no_preview or self.stream)
        if formats:
            found = without_results(found, self.input, self.output, formats)
        todo = jobs(
            found, self.output, formats, preview=preview, sidecars=not self.no_sidecar, shown=shown_path
        )
        cameras = self.seen_by()
        if not folder:
            self._print_result(self._convert(todo[0], cameras), todo[0], cameras)
            return OK
        new = not self.output.exists()
        if new:
            self.output.mkdir()
        try:
            return self._convert_all(todo, cameras)
        finally:
            if new:
                with suppress(OSError):
                    self.output.rmdir()  # where nothing was written

    def _formats(self, folder: bool) -> Sequence[str]:
        """Suffixes to write in a folder; none for a single file."""
        if not folder:
            if not self.as_splats:
                _check_file(self.output)
            return ()
        _check_folder(self.output)
        return self.formats or (("ply",) if self.as_splats else ("glb",))

    def _convert_all(self, todo: Sequence[Job], cameras: list[Camera] | None) -> int:
        """Does every job, also after failures; a full disk ends them. Returns the exit code: that of the
        failures if they are all of one kind."""
        codes, skipped = [], 0
        for job in track(todo, "converting", len(todo)):
            try:
                result = self._convert(job, cameras)
                skipped += result["skipped"]
                self._print_line(result, job)
            except BrokenPipeError:
                raise
            except (UsageError, ValueError, OSError, ImportError, MemoryError) as error:
                codes.append(exit_code(error))
                say(f"error: {one_line(error)}")
                if self.json:
                    print(json.dumps({"input": job.shown, "error": error_record(error)}), flush=True)
                if codes[-1] == NO_SPACE:
                    break
        if not self.json and NO_SPACE not in codes:
            made = len(todo) - len(codes) - skipped
            kept = f", {skipped} kept" if skipped else ""
            print(f"{made} of {len(todo)} converted{kept}: {self.output}/")
        return OK if not codes else codes[-1] if len(set(codes)) == 1 or codes[-1] == NO_SPACE else FAILED

    def _convert(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """Does ``job``; its result, for JSON."""
        import meshsplats

        with warnings_kept() as warned, job.claimed(self.force):
            plan = job.plan(
                force=self.force, skip_existing=self.skip_existing, changes=partial(self._changes, job)
            )
            for mesh in plan.kept:
                if remark := mesh.remark:
                    warnings.warn(remark, DataWarning, stacklevel=1)
            result = {} if plan.finished else self._made(plan.job, cameras)
        outputs = [{"path": str(path), "bytes": path.stat().st_size} for path in job.outputs]
        image = job.preview if job.preview and job.preview.exists() else None
        base = {"input": job.shown, "outputs": outputs, "preview": str(image) if image else None}
        more = {"skipped": plan.finished, "warnings": warned, "meshsplats": meshsplats.__version__}
        return base | result | more

    def _made(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``; counts, scores and seconds."""
        if not (self.as_splats or self.stream):
            self.check_kind(job)
        callbacks = Callbacks(
            load=partial(self.reading.load, up=self.up),
            stream=self._opened,
            place=partial(written, origin=self.origin),
            record=self._record,
            preview=draw_preview,
            opening=self._opening,
        )
        return Converter(self.product(), callbacks).made(job, cameras)

    def _opened(self, source: Path) -> SplatStream:
        """The splats of an input in blocks, relative to the origin that is asked for."""
        given = None if isinstance(self.origin, str) else self.origin
        found = self.reading.stream(source, given, up=self.up)
        say_origin(found.origin, self.origin, splats=self.as_splats)
        return found

    def _record(self, job: Job) -> None:
        for path, config in zip(job.outputs, job.configs, strict=False):
            write_configuration(config, "convert", self.alone(job, path))

    def _opening(self, cloud: GaussianCloud, source: Path, given: Sequence[Camera] | None) -> Camera | None:
        found = views_of_a_place(cloud, source, 1, up=optional_up(self.up), given=given or None)
        return found[0] if found else None

    def _changes(self, job: Job, index: int) -> str | None:
        """How the record beside an output of ``job`` differs from the options of now: see ``Job.plan``."""
        path = job.outputs[index]
        return changes_since(beside(path, CONFIGURATION), "convert", self.alone(job, path), _IDLE)

    def _print_result(self, result: dict[str, Any], job: Job, cameras: list[Camera] | None) -> None:
        """Prints the result of a single input."""
        if self.json:
            print(json.dumps(result))
            return
        if result["skipped"]:
            print(f"{self.output} ({size_of(self.output)}): kept")
            return
        if "written" in result:
            print(f"{result['written']:,} of {result['read']:,} splats in {result['seconds']:.2f} s")
            print(f"{self.output} ({size_of(self.output)})")
        else:
            print(_counts(result))
            seconds = result["seconds"]
            words = {"read": "read", "convert": "converted", "save": "saved", "choose alpha": "chose alpha"}
            words["solve order"] = "solved the order"
            timing = ", ".join(f"{words[name]} {value:.2f} s" for name, value in seconds.items() if value)
            print(f"{self.output} ({size_of(self.output)}): {timing}")
            if line := alpha_in_words(result.get("alpha")):
                print(line)
                if "splats" in result and job.shown != "-" and self.conversion.crop is None:
                    print(f"better there: {self._for_depth_buffers()}")
                    print(f"or, with an order in the file, --alpha ordered ({ORDER_GAIN})")
        if result["preview"]:
            print(f"preview: {result['preview']}")
        if result.get("converted") is not None and self.files.compression == "none":
            print(f"next: {self._next(seen_from(cameras, job.source, np.zeros(3)))}")

    def _print_line(self, result: dict[str, Any], job: Job) -> None:
        """Prints the result of one of several inputs."""
        if self.json:
            print(json.dumps(result), flush=True)
            return
        if result["skipped"]:
            sizes = "kept"
        else:
            sizes = f"{result['written']:,} splats" if "written" in result else _counts(result)
        files = ", ".join(f"{path.name} ({size_of(path)})" for path in job.outputs)
        choice = result.get("alpha")
        print(f"{job.shown}: {sizes}: {files}" + (f", alpha {choice['alpha']}" if choice else ""), flush=True)

    def _next(self, cameras: Sequence[Camera] | None) -> str:
        """The command that compares the mesh with the splats in its cameras, or one that renders it if only a
        part of them was converted."""
        folder, source = self.output.with_suffix(""), shown_path(self.input[0])
        if self.conversion.crop is not None or source == "-" or self.scale is not None:
            return command_line(["meshsplats", "render", self.output, "-o", f"{folder}-images"])
        words: list[str | Path] = ["meshsplats", "compare", source, self.output]
        words += ["--look", self.look_of_result] if self.look_of_result != "area" else []
        words += again(self, "data", missing="few")
        if cameras and self.data is None:
            words += ["--cameras", source if self.cameras is None else self.cameras]
        return command_line([*words, *self.reading.again(), "-o", f"{folder}-compare"])

    def _for_depth_buffers(self) -> str:
        """The command that makes a mesh for viewers that do not sort, and what is gained by it."""
        words: list[str | Path] = ["meshsplats", "finetune", shown_path(self.input[0])]
        words += [
            *again(self, "data", missing="few"),
            *self.reading.again(),
            "-o",
            self.output.with_suffix(".solid.glb"),
        ]
        command = command_line([*words, "--opacity", "cutoff", "--soft-share", "0.05"])
        return f"{command} ({ENGINE_GAIN})"


def _check_folder(output: Path) -> None:
    """UsageError if ``output`` names a mesh file, where a folder for several is wanted."""
    if mesh_format_to_write(output) is not None and not output.is_dir():
        raise UsageError(f"several inputs or formats need a folder: -o {output.with_suffix('')}, say")


def _check_file(output: Path) -> None:
    """UsageError if no mesh can be written as ``output``."""
    try:
        check_mesh_suffix(output)
    except UsageError as error:
        raise UsageError(f"{error}; for a folder, name the formats: --formats glb") from None


def _counts(result: dict[str, Any]) -> str:
    """Sizes before and after."""
    sizes = f"{result['triangles']:,} triangles, {result['vertices']:,} vertices"
    if "splats" in result:
        share = result["converted"] / result["splats"]
        kept = f", merged into {result['converted']:,} ({share:.1%})"
        if result["converted"] == result["splats"]:
            kept = ""
        elif not result["merged"]:
            kept = f", {result['converted']:,} of them converted ({share:.1%})"
        sizes = f"{result['splats']:,} splats{kept} -> {sizes}"
    fidelity = result["fidelity"]
    if fidelity is None:
        return sizes
    psnr = "equal" if fidelity["psnr"] is None else f"{fidelity['psnr']:.2f} dB"
    views = plural(fidelity["views"], "view")
    scores = f"{psnr}, SSIM {fidelity['ssim']:.4f} against the splats"
    return f"{sizes}; {scores}, {views}, look {fidelity['look']}"
