"""``meshsplats convert``: splats to a mesh."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from meshsplats._common.options import of_presets
from meshsplats._common.streams import is_of_closed_pipe
from meshsplats._common.words import command_line, plural
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options, usage_errors
from meshsplats.cli.common import (
    SplatOptions,
    again,
    draw_preview,
    named,
    say_origin,
    size_of,
    track,
    warnings_kept,
    written,
)
from meshsplats.cli.messages import (
    FAILED,
    NO_SPACE,
    OK,
    UsageError,
    about,
    error_record,
    exit_code,
    one_line,
    say,
    shown_path,
)
from meshsplats.cli.records import changes_since, write_configuration
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.options import PRESETS
from meshsplats.errors import DataWarning
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.formats.outputs import CONFIGURATION, Ending, beside, means_splats
from meshsplats.formats.splat_formats import written_ending
from meshsplats.operations.product import Product

if TYPE_CHECKING:
    from meshsplats.formats.streaming import SplatStream
    from meshsplats.operations.batches import Job
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.gaussians import GaussianCloud

_IDLE = ("fidelity", "no_preview", "no_sidecar", "stream", "threads")
"""Options that do not change the mesh."""
ENGINE_GAIN = "7 to 10 dB in minutes, on three scenes of up to 0.3 million splats"
"""What meshes for a depth buffer gain in three.js with MSAA: docs/viewers.md."""
ORDER_GAIN = "3 to 10 dB in three.js and Babylon.js; not for ray tracers and CesiumJS"
"""What a solved order gains there: benchmarks/results/viewers_ordered.md and large_captures.md."""


@as_cli_options(presets=False)
class FileOptions(MeshFileOptions):
    """How meshes are saved."""


@as_cli_options(defaults=of_presets(PRESETS))
class ConvertOptions(ConversionOptions):
    """In parentheses: the values of the presets."""


@as_cli_options(presets=False)
class ProductOptions(Product):
    files: FileOptions
    origin: option.Origin = "keep"
    conversion: ConvertOptions


@dataclass(frozen=True)
class Convert(Command):
    """Converts splats to a mesh of translucent, vertex-coloured triangles; several files or folders, into a
    folder. Converts meshes to other formats, and splats, too: with --as-splats, or a name such as scene.spz.

    Writes a preview and the configuration beside the result.
    """

    COMMON = (
        *("input", "output", "formats", "preset", "look", "cameras", "data", "up", "lit"),
        *("alpha", "as_splats", "max_splats", "max_triangles", "crop", "json", "force"),
    )
    EXCLUSIVE = (("cameras", "data"),)
    CONFIGURABLE = True

    input: tyro.conf.Positional[option.Inputs]
    """Splat file, the folder of a trained model, or a mesh; several of them; a folder of them; - for standard
    input."""
    output: option.Output
    """The mesh: .glb for engines, viewers and Blender; .npz or .ply, which keep everything; .usdc, .obj. Or
    splats: .spz, .sog, .splat, .compressed.ply, .usdz. Or a folder, for files named like the inputs."""
    formats: Annotated[tuple[Ending, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """With a folder: formats to write, all of meshes or all of splats. Default: glb."""
    product: Annotated[ProductOptions, Flat] = field(default_factory=ProductOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    threads: option.Threads = None
    json: bool = False
    """Print the results as JSON, a line for each input, errors too."""
    force: option.Force = False
    skip_existing: bool = False
    """Keep the meshes that are there, and make those that are missing. Says which of them are older than
    their input or were made with other options."""

    def execute(self) -> int:
        from meshsplats.operations.batches import formats_of, is_batch, jobs, sources, without_results

        if not self.input:
            raise UsageError("give a splat file, a mesh or a folder to convert")
        ending, product = written_ending(self.output.name), self.product
        if not product.as_splats and means_splats(self.formats or [ending]):
            return replace(self, product=replace(product, as_splats=True)).execute()
        folder = is_batch(self.input) or bool(self.formats) or self.output.is_dir()
        formats = formats_of(self.output, self.formats, folder=folder, as_splats=product.as_splats)
        if self.force and self.skip_existing:
            raise UsageError("give --force or --skip-existing, not both")
        found = sources(self.input)
        product.check(formats or [ending], found, self.output)
        if formats:
            found = without_results(found, self.input, self.output, formats)
        records = {"preview": not (product.no_preview or product.stream), "sidecars": not product.no_sidecar}
        todo = jobs(found, self.output, formats, **records, shown=shown_path)
        cameras = product.seen_by()
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

    def resolved(self) -> dict[str, Any]:
        from meshsplats.formats.sniff import identify

        if self.product.as_splats or all(identify(path) == "mesh" for path in self.input):
            return {}
        return vars(self.product.resolved(self.input))

    def _convert_all(self, todo: Sequence[Job], cameras: list[Camera] | None) -> int:
        """Does every job, also after failures; a full disk ends them. Returns the exit code: that of the
        failures if they are all of one kind."""
        codes, skipped = [], 0
        for job in track(todo, len(todo), "converting"):
            named = (job.shown, *(path.name for path in job.outputs))
            try:
                with usage_errors(), about(*named):
                    result = self._convert(job, cameras)
                skipped += result["skipped"]
                self._print_line(result, job)
            except (UsageError, ValueError, OSError, ImportError, MemoryError) as error:
                if is_of_closed_pipe(error):
                    raise
                codes.append(exit_code(error))
                with about(*named):
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
        from meshsplats.operations.conversion import ConversionCallbacks, Converter

        if not (self.product.as_splats or self.product.stream):
            self.product.check_kind(job, self.reading)
        callbacks = ConversionCallbacks(
            load=partial(self.reading.load, up=self.product.up, threads=self.threads),
            stream=self._opened,
            place=partial(written, origin=self.product.origin),
            record=self._record,
            preview=partial(draw_preview, threads=self.threads),
            opening=self._opening,
            tell_of=self.reading.tell_of,
        )
        return Converter(self.product, callbacks, self.threads).made(job, cameras)

    def _opened(self, source: Path) -> SplatStream:
        """The splats of an input in blocks, relative to the origin that is asked for."""
        origin = self.product.origin
        given = None if isinstance(origin, str) else origin
        found = self.reading.stream(source, given, up=self.product.up, threads=self.threads)
        say_origin(found.origin, origin, splats=self.product.as_splats)
        return found

    def _record(self, job: Job) -> None:
        for path, config in zip(job.outputs, job.configs, strict=False):
            write_configuration(config, "convert", self._alone(job, path))

    def _alone(self, job: Job, path: Path) -> Convert:
        """The command that writes ``path`` of ``job`` alone."""
        taken: Any = self.product.taken_by(path)
        return replace(self, input=(job.source,), output=path, formats=(), product=taken)

    def _opening(self, cloud: GaussianCloud, source: Path, given: Sequence[Camera] | None) -> Camera | None:
        from meshsplats.viewpoints.showing import default_views

        how: dict[str, Any] = {"up": self.product.direction, "threads": self.threads}
        if (found := default_views(cloud, source, 1, given=given or None, **how)) is None:
            return None
        say(found[1])
        return found[0][0] if found[0] else None

    def _changes(self, job: Job, index: int) -> str | None:
        """How the record beside an output of ``job`` differs from the options of now: see ``Job.plan``."""
        path = job.outputs[index]
        return changes_since(beside(path, CONFIGURATION), "convert", self._alone(job, path), _IDLE)

    def _print_result(self, result: dict[str, Any], job: Job, cameras: list[Camera] | None) -> None:
        """Prints the result of a single input."""
        self.finish(result, *self._lines(result, job, cameras), indent=None)

    def _lines(self, result: dict[str, Any], job: Job, cameras: list[Camera] | None) -> list[str]:
        from meshsplats.evaluation.viewers import AlphaChoice
        from meshsplats.operations.conversion import counts_in_words, seen_from, times_in_words
        from meshsplats.scene.origin import zero_origin

        made = named(self.output)
        if result["skipped"]:
            return [f"{made}: kept"]
        if "written" in result:
            read = plural(result["read"], "splat")
            lines = [f"{result['written']:,} of {read} in {result['seconds']:.2f} s", made]
        else:
            lines = [counts_in_words(result), f"{made}: {times_in_words(result['seconds'])}"]
            if (alpha := result.get("alpha")) and (line := AlphaChoice(**alpha).in_words()):
                lines.append(line)
                if "splats" in result and job.shown != "-" and self.product.conversion.crop is None:
                    lines.append(f"better there: an order in the file, --alpha ordered ({ORDER_GAIN})")
                    lines.append(f"or solid triangles: {self._for_depth_buffers()}")
        if result["preview"]:
            as_sorted = ", sorted" if result.get("alpha") else ""
            lines.append(f"preview{as_sorted}: {result['preview']}")
        if result.get("converted") is not None and self.product.files.compression == "none":
            lines.append(f"next: {self._next(seen_from(cameras, job.source, zero_origin()), result['look'])}")
        return lines

    def _print_line(self, result: dict[str, Any], job: Job) -> None:
        """Prints the result of one of several inputs."""
        from meshsplats.operations.conversion import counts_in_words

        if result["skipped"]:
            sizes = "kept"
        else:
            sizes = plural(result["written"], "splat") if "written" in result else counts_in_words(result)
        files = ", ".join(f"{path.name} ({size_of(path)})" for path in job.outputs)
        alpha = f", alpha {choice['alpha']}" if (choice := result.get("alpha")) else ""
        self.finish(result, f"{job.shown}: {sizes}: {files}{alpha}", indent=None)

    def _next(self, cameras: Sequence[Camera] | None, look: str) -> str:
        """The command that compares the mesh with the splats in its cameras, or one that renders it if only a
        part of them was converted."""
        folder, source, product = self.output.with_suffix(""), shown_path(self.input[0]), self.product
        if product.conversion.crop is not None or source == "-" or product.scale is not None:
            return command_line(["meshsplats", "render", self.output, "-o", f"{folder}-images"])
        words: list[str | Path] = ["meshsplats", "compare", source, self.output]
        words += ["--look", look] if look != "area" else []
        words += again(product, "data", missing="few")
        if cameras and product.data is None:
            words += ["--cameras", source if product.cameras is None else product.cameras]
        return command_line([*words, *self.reading.again(), "-o", f"{folder}-compare"])

    def _for_depth_buffers(self) -> str:
        """The command that makes a mesh for viewers that do not sort, and what is gained by it."""
        words: list[object] = ["meshsplats", "finetune", shown_path(self.input[0])]
        words += again(self.product, "data", missing="few") + again(self.product.conversion, "look")
        words += self.reading.again()
        words += ["-o", self.output.with_suffix(".solid.glb"), "--opacity", "cutoff", "--soft-share", "0.05"]
        return f"{command_line(words)} ({ENGINE_GAIN})"
