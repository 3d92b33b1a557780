"""``meshsplats render``: pictures of splats or of a mesh."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from meshsplats.camera import Camera
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cli import UsageError
from meshsplats.cli.common import (
    DrawOptions,
    Output,
    PartOptions,
    SplatOptions,
    ViewOptions,
    check_outputs,
    chosen_background,
    configuration,
    load_scene,
    parse_color,
    plural,
    record_beside,
    recorded_options,
    size_of,
    track,
    view_names,
    write_json,
)
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import SplatMesh


@dataclass(frozen=True)
class _Files:
    """Where everything goes."""

    pictures: list[Path]
    depths: list[Path]
    turntable: Path | None
    cameras: Path
    config: Path

    @property
    def every(self) -> list[Path]:
        turntable = [self.turntable] if self.turntable else []
        return [*self.pictures, *self.depths, *turntable, self.cameras, self.config]


@dataclass(frozen=True)
class Render:
    """Draws splats or a mesh: one picture (-o picture.png) or a folder of pictures with a turntable.

    Splats (.ply, or the folder of a trained model) are converted to a mesh first, with default settings;
    --as-splats draws them as 3D Gaussian Splatting does.
    """

    input: tyro.conf.Positional[Path]
    """Splats, a model folder, or a mesh."""
    output: Output
    """A .png for one view, or a folder. Without other options: the front view, or an orbit of 60 views."""
    as_splats: bool = False
    """Draw the splats themselves, not the mesh made of them."""
    views: ViewOptions = field(default_factory=ViewOptions)
    draw: DrawOptions = field(default_factory=DrawOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    part: PartOptions = field(default_factory=PartOptions)
    transparent: bool = False
    """No background: pictures with an alpha channel."""
    depth: Literal["none", "png", "npy"] = "none"
    """Depth pictures of a mesh too: 16-bit PNG (the scale is in config.json, depth_unit) or float arrays. 0:
    nothing."""
    animation: Literal["webp", "gif", "png", "none"] = "webp"
    """Kind of the turntable that an orbit ends with; png is an animated PNG."""
    fps: float = 15.0
    """Pictures a second of the turntable."""
    json: bool = False
    """Print the result as JSON."""
    force: bool = False
    """Overwrite existing outputs."""

    def run(self) -> None:
        single = self.output.suffix.lower() == ".png"
        self._check(single)
        start = time.perf_counter()
        scene = self.part.of(load_scene(self.input, self.reading))
        self._check_scene(scene)
        photographs = self.views.photographs()
        count = 1 if single else 60
        cameras = self.views.make(scene, self.input, count=count, side=800, photographs=photographs)
        if single and len(cameras) > 1:
            raise UsageError(f"{plural(len(cameras), 'view')} do not fit one .png: give -o a folder")
        files = self._files(single, len(cameras))
        check_outputs(files.every, self.force, None if single else self.output)
        if isinstance(scene, GaussianCloud) and not self.as_splats:
            from meshsplats.conversion import convert

            scene = convert(scene)
        record = configuration("render", self)
        unit = None
        if self.depth == "png" and isinstance(scene, SplatMesh):
            record["depth_unit"] = unit = _depth_unit(scene, cameras)
        behind = (0.0, 0.0, 0.0)
        if not self.transparent:
            what = "splats" if isinstance(scene, GaussianCloud) else "mesh"
            background = chosen_background(
                self.draw.background, photographs, {what: scene}, self.input, self.draw.threads, whole=False
            )
            behind, record["background"] = background.color, background.to_dict()
        if not single:
            _remove_older(self.output, files.every)
        self._draw(scene, cameras, files, unit, behind)
        if files.turntable:
            from meshsplats.images.reading import load_image
            from meshsplats.images.writing import save_animation

            save_animation(files.turntable, map(load_image, files.pictures), fps=self.fps)
        save_cameras(cameras, files.cameras)
        write_json(files.config, record)
        seconds = time.perf_counter() - start
        if self.json:
            result = {
                "pictures": files.pictures,
                "depth": files.depths,
                "turntable": files.turntable,
                "cameras": files.cameras,
                "seconds": round(seconds, 3),
            }
            print(json.dumps(result, default=str, indent=1))
            return
        size = f"{cameras[0].width} x {cameras[0].height}"
        where = f"{self.output} ({size_of(self.output)})" if single else f"{self.output}/"
        print(f"{plural(len(cameras), 'picture')} of {size} in {seconds:.1f} s: {where}")
        if files.turntable:
            print(f"turntable: {files.turntable} ({size_of(files.turntable)})")

    def _files(self, single: bool, count: int) -> _Files:
        out = self.output
        if single:
            depths = [out.with_suffix(f".depth.{self.depth}")] if self.depth != "none" else []
            return _Files([out], depths, None, record_beside(out, "cameras"), record_beside(out, "config"))
        pictures = [out / name for name in view_names(count)]
        depths = (
            [out / name for name in view_names(count, "depth", f".{self.depth}")]
            if self.depth != "none"
            else []
        )
        turns = self.views.moving and self.animation != "none" and count > 1
        turntable = out / f"turntable.{self.animation}" if turns else None
        return _Files(pictures, depths, turntable, out / "cameras.json", out / "config.json")

    def _check(self, single: bool) -> None:
        self.views.check()
        if self.draw.background is not None:
            parse_color(self.draw.background)
        if not single and self.output.suffix:
            raise UsageError(
                f"-o must end in .png for one picture, or name a folder, got {self.output.name!r}"
            )
        if self.transparent and self.draw.background is not None:
            raise UsageError("--transparent and --background exclude each other")
        if self.transparent and self.animation == "gif":
            raise UsageError("GIF has no translucency: use --animation webp, png or none with --transparent")
        if self.as_splats and self.depth != "none":
            raise UsageError("--depth is that of a mesh: leave out --as-splats")
        if self.as_splats and self.draw.max_layers is not None:
            raise UsageError("--max-layers counts triangles: it has no effect with --as-splats")

    def _check_scene(self, scene: GaussianCloud | SplatMesh) -> None:
        if isinstance(scene, SplatMesh) and self.as_splats:
            raise ValueError(f"{self.input} is a mesh: --as-splats needs a splat file")
        if self.draw.sh_degree is not None and not self.as_splats:
            raise UsageError("--sh-degree is for splats: a mesh has one colour a vertex; add --as-splats")

    def _draw(
        self,
        scene: GaussianCloud | SplatMesh,
        cameras: Sequence[Camera],
        files: _Files,
        unit: float | None,
        background: tuple[float, ...],
    ) -> None:
        from meshsplats.colors import linear_to_srgb, srgb_to_linear
        from meshsplats.images.writing import save_array, save_depth_png, save_image, straight_rgba
        from meshsplats.rendering import render, render_splats
        from meshsplats.rendering.samples import needed_samples

        # A mesh made for blending in linear light is drawn so and encoded for display after.
        linear = isinstance(scene, SplatMesh) and scene.blending == "linear"
        if linear:
            background = tuple(srgb_to_linear(np.array(background)).tolist())
        samples = self.draw.samples
        if samples is None:
            samples = 1 if isinstance(scene, GaussianCloud) else needed_samples(scene, cameras)
        options: dict[str, Any] = {
            "background": background,
            "samples": samples,
            "threads": self.draw.threads,
        }
        layers, degree = self.draw.max_layers, self.draw.sh_degree
        for i, camera in enumerate(track(cameras, "rendering", len(cameras))):
            if isinstance(scene, GaussianCloud):
                drawn = render_splats(scene, camera, sh_degree=degree, **options)
            else:
                drawn = render(scene, camera, max_layers=layers, depth=bool(files.depths), **options)
            if not files.pictures[i].parent.exists():
                files.pictures[i].parent.mkdir()  # not before something is there to be written
            picture = straight_rgba(drawn.color, drawn.alpha) if self.transparent else drawn.color
            if linear:
                picture[..., :3] = linear_to_srgb(picture[..., :3])
            save_image(files.pictures[i], picture)
            if drawn.depth is None:
                continue
            mean = drawn.mean_depth(empty=0)
            if unit is None:
                save_array(files.depths[i], mean)
            else:
                save_depth_png(files.depths[i], mean, unit)


def _depth_unit(scene: GaussianCloud | SplatMesh, cameras: Sequence[Camera]) -> float:
    """Scene units that one step of a 16-bit depth picture stands for: the farthest vertex of all views
    fits."""
    assert isinstance(scene, SplatMesh)
    corners = scene.vertices if len(scene.vertices) else np.zeros((1, 3), np.float32)
    farthest = max(
        float((corners @ c.world_to_camera[2, :3] + c.world_to_camera[2, 3]).max()) for c in cameras
    )
    return max(farthest, 1e-6) / 65535


def _remove_older(folder: Path, kept: Sequence[Path]) -> None:
    """The pictures of an earlier run in ``folder``, as its records tell, apart from ``kept``."""
    if recorded_options(folder / "config.json", "render") is None:
        return
    try:
        count = len(load_cameras(folder / "cameras.json"))
    except (OSError, ValueError):
        return
    names = [f"turntable.{kind}" for kind in ("webp", "gif", "png")]
    for prefix, suffix in (("view", ".png"), ("depth", ".png"), ("depth", ".npy")):
        names += view_names(count, prefix, suffix)
    for name in names:
        if folder / name not in kept:
            (folder / name).unlink(missing_ok=True)
