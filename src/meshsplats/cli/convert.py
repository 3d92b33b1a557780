"""``meshsplats convert``: splats to a mesh."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args, get_type_hints

import numpy as np
import tyro

from meshsplats.camera import Camera, load_cameras, orbit
from meshsplats.cli import UsageError
from meshsplats.cli.common import (
    File,
    Folder,
    Output,
    SplatOptions,
    Text,
    cameras_beside,
    check_mesh_suffix,
    check_outputs,
    configuration,
    data_cameras,
    identify,
    parse_up,
    recorded_options,
    size_of,
    write_json,
)
from meshsplats.conversion import ConversionOptions, convert, simplify
from meshsplats.conversion.selection import choose_splats
from meshsplats.errors import FileFormatError
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh

_CHOOSING = ("crop", "min_opacity", "max_splats", "budget")
"""Options of the conversion that choose splats, and so serve --as-splats too."""
_OF_SPLATS = (
    *("input", "output", "cameras", "data", "as_splats", "no_preview", "conversion", "reading", "json"),
    "force",
)
"""Options of the command that do."""


def _with_placeholders(options: type[ConversionOptions]) -> type[ConversionOptions]:
    """The same options, described to tyro: ``--rings N`` where it would say ``--rings {None}|INT (default:
    None)``. Their docstrings are the help and say what happens without them."""
    typed, named = {}, {}
    for name, hint in get_type_hints(options).items():
        kind = next(part for part in get_args(hint) if part is not type(None))
        choices = "{" + ",".join(map(str, get_args(kind))) + "}"
        placeholders = {int: "N", float: "X", bool: "{True,False}"}
        metavar = "X0 Y0 Z0 X1 Y1 Z1" if name == "crop" else placeholders.get(kind, choices)
        typed[name] = Annotated[hint, tyro.conf.arg(metavar=metavar, help_behavior_hint="")]  # type: ignore[valid-type]
    for option in fields(options):
        named[option.name] = option.default
    about = "What is not given is left to the preset."
    described = type(options.__name__, (options,), {"__annotations__": typed, "__doc__": about, **named})
    return dataclass(frozen=True)(described)


if TYPE_CHECKING:
    _Options = ConversionOptions
else:
    _Options = _with_placeholders(ConversionOptions)


@dataclass(frozen=True)
class Convert:
    """Turns splats into a mesh of translucent, vertex-coloured triangles: .glb, .ply or .npz by the name
    given. With --as-splats, into a splat .ply: other formats made plain, or a part cut out.

    Writes a preview picture and the configuration beside it.
    """

    input: tyro.conf.Positional[Path]
    """Splat file, or the folder of a trained model."""
    output: Output
    """The mesh: .glb for engines, viewers and Blender; .npz or .ply, which keep everything; .usdc, .obj."""
    preset: Literal["default", "paper"] = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    cameras: File = None
    """Where the mesh will be seen from: a JSON list of cameras, a cameras.json of a 3DGS trainer, or the
    model folder that has one. Default: the cameras of the input where it is a model folder, else none."""
    data: Folder = None
    """Data set of the photographs: the cameras of its training views are where the mesh will be seen from."""
    up: Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, else -y."""
    lit: bool = False
    """.glb, .usd: a material that lights and shadows act on, not one that shows the colours as they are."""
    color_type: Literal["uint16", "float32"] = "uint16"
    """.glb: how colours are stored."""
    alpha: Literal["blend", "mask", "hash-friendly"] = "blend"
    """.glb: blend: true opacities. For viewers that neither sort nor blend well: mask draws solid what is at
    least 20 % opaque; hash-friendly gives each splat a cutoff of its own, right on average, grainy."""
    compression: Literal["none", "meshopt"] = "none"
    """.glb: about a fifth of the size, for viewers; needs the program gltfpack."""
    as_splats: bool = False
    """Write splats, not a mesh: a float .ply as the 3DGS code lays it out, of all splats or of what --crop,
    --min-opacity and --max-splats leave."""
    no_preview: bool = False
    """Draw no preview."""
    conversion: _Options = field(default_factory=_Options)
    reading: SplatOptions = field(default_factory=SplatOptions)
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def run(self) -> None:
        from meshsplats.formats.meshes import save_mesh

        suffix = self.output.suffix.lower()
        if self.as_splats:
            self._save_splats(suffix)
            return
        check_mesh_suffix(self.output)
        if self.lit and suffix != ".glb" and not suffix.startswith(".usd"):
            raise UsageError(f"--lit is for .glb and .usd files: {suffix} has no material")
        glb_only = (self.color_type, self.alpha, self.compression)
        if suffix != ".glb" and glb_only != ("uint16", "blend", "none"):
            raise UsageError("--color-type, --alpha and --compression are for .glb files")
        up = None if self.up is None else parse_up(self.up)
        preview, config = self._records()
        self._check_input()
        cameras = self._cameras()
        self.conversion.resolved(self.preset, has_cameras=bool(cameras))  # mistakes are told before the work

        times = [time.perf_counter()]
        cloud = self.reading.load(self.input)
        times.append(time.perf_counter())
        mesh = convert(cloud, preset=self.preset, cameras=cameras, up=up, **asdict(self.conversion))
        times.append(time.perf_counter())
        save_mesh(
            mesh,
            self.output,
            lit=True if self.lit else None,
            color_type=None if self.color_type == "uint16" else self.color_type,
            alpha=None if self.alpha == "blend" else self.alpha,
            compression=None if self.compression == "none" else self.compression,
        )
        times.append(time.perf_counter())
        write_json(config, configuration("convert", self))
        if preview:
            draw_preview(mesh, preview)
        made_of = mesh.splat_count or 0
        read, made, saved = np.diff(times).round(4).tolist()
        if self.json:
            result = {
                "mesh": str(self.output),
                "preview": str(preview) if preview else None,
                "splats": len(cloud),
                "converted": made_of,
                "triangles": len(mesh.faces),
                "vertices": len(mesh.vertices),
                "bytes": self.output.stat().st_size,
                "seconds": {"read": read, "convert": made, "save": saved},
            }
            print(json.dumps(result, indent=1))
            return
        kept = "" if made_of == len(cloud) else f", {self._kept(made_of, len(cloud))}"
        print(
            f"{len(cloud):,} splats{kept} -> {len(mesh.faces):,} triangles, {len(mesh.vertices):,} vertices"
        )
        timing = f"read {read:.2f} s, converted {made:.2f} s, saved {saved:.2f} s"
        print(f"{self.output} ({size_of(self.output)}): {timing}")
        if preview:
            print(f"preview: {preview}")
        if self.compression == "none":  # what is compressed is not read here
            print(f"next: {self._next(cameras)}")

    def _kept(self, kept: int, of: int) -> str:
        """What became of splats that are not all converted one by one."""
        share = f" ({kept / of:.1%})"
        if self.conversion.max_splats is None and self.conversion.max_triangles is None:
            share = ""
        elif self.conversion.budget != "drop":
            return f"merged into {kept:,}{share}"
        return f"{kept:,} of them converted{share}"

    def _records(self) -> tuple[Path | None, Path]:
        """Names of the preview and the configuration, checked with that of the mesh. Where the usual ones are
        those of the same mesh in another format, names with all of the output's own."""
        preview, config = record_names(self.output.with_suffix(""))
        other = (recorded_options(config, "convert") or {}).get("output")
        if isinstance(other, str) and Path(other).name != self.output.name:
            preview, config = record_names(self.output)
        wanted = [self.output, config] if self.no_preview else [self.output, preview, config]
        check_outputs(wanted, self.force, inputs=[self.input])
        return (None if self.no_preview else preview), config

    def _cameras(self) -> list[Camera]:
        if self.data is not None:
            if self.cameras is not None:
                raise UsageError("give --cameras or --data, not both")
            return data_cameras(self.data, "train")
        if self.cameras is not None:
            return load_cameras(self.cameras)
        return cameras_beside(self.input) or []

    def _check_input(self) -> None:
        if identify(self.input) != "splats":
            raise FileFormatError(f"{self.input}: not splats; convert needs a splat file or a model folder")

    def _save_splats(self, suffix: str) -> None:
        """The splats themselves, in the format that everything reads."""
        from meshsplats.formats.splats import save_gaussians

        if suffix != ".ply":
            raise UsageError(f"--as-splats writes .ply, got {self.output.name!r}")
        standard = {f.name: f.default for f in fields(self) if f.name not in _OF_SPLATS}
        idle = [name for name, value in standard.items() if getattr(self, name) != value]
        given = asdict(self.conversion)
        merging, count = self.conversion.budget != "drop", self.conversion.max_splats
        if not merging or count is None:
            idle += [name for name in ("cameras", "data") if getattr(self, name) is not None]
        idle += [name for name, value in given.items() if value is not None and name not in _CHOOSING]
        if idle:
            flags = ", ".join("--" + name.replace("_", "-") for name in idle)
            raise UsageError(f"{flags}: for a mesh, no effect with --as-splats")
        self.conversion.resolved("paper", has_cameras=False)
        preview, config = self._records()
        self._check_input()
        cameras = self._cameras()
        start = time.perf_counter()
        cloud = self.reading.load(self.input)
        kept = choose_splats(
            cloud,
            crop=self.conversion.crop,
            min_opacity=self.conversion.min_opacity,
            max_splats=None if merging else count,
        )
        if merging and count is not None:
            kept = simplify(kept, count, cameras=cameras)
        save_gaussians(kept, self.output)
        seconds = time.perf_counter() - start
        write_json(config, configuration("convert", self))
        if preview:
            draw_preview(kept, preview)
        if self.json:
            result = {
                "splats": str(self.output),
                "preview": str(preview) if preview else None,
                "read": len(cloud),
                "written": len(kept),
                "bytes": self.output.stat().st_size,
                "seconds": round(seconds, 4),
            }
            print(json.dumps(result, indent=1))
            return
        print(f"{len(kept):,} of {len(cloud):,} splats in {seconds:.2f} s")
        print(f"{self.output} ({size_of(self.output)})")
        if preview:
            print(f"preview: {preview}")

    def _next(self, cameras: Sequence[Camera]) -> str:
        """The command that compares the mesh with the splats from where it was made for, or one that shows it
        where only a part of them was converted."""
        folder = self.output.with_suffix("")
        if self.conversion.crop is not None:
            return shlex.join(["meshsplats", "render", str(self.output), "-o", f"{folder}-pictures"])
        words: list[str | Path] = ["meshsplats", "compare", self.input, self.output]
        if self.data is not None:
            words += ["--data", self.data]
        elif cameras:
            words += ["--cameras", self.input if self.cameras is None else self.cameras]
        return shlex.join(map(str, [*words, *self.reading.again(), "-o", f"{folder}-compare"]))


def record_names(name: Path) -> tuple[Path, Path]:
    """Those of the preview and the configuration of the output ``name``, which has no suffix."""
    return name.with_name(f"{name.name}.preview.png"), name.with_name(f"{name.name}.config.json")


def draw_preview(scene: SplatMesh | GaussianCloud, path: Path) -> None:
    from meshsplats.pictures import save_png
    from meshsplats.rendering import render, render_splats

    camera = orbit(scene, 1, azimuth=30, width=800, height=800)[0]  # more of the shape than from the front
    if isinstance(scene, SplatMesh):
        save_png(path, render(scene, camera, samples=2).color)
    else:
        save_png(path, render_splats(scene, camera).color)
