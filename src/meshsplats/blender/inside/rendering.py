"""Blender's render settings, and rendering to image files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.blender.inside import notes, versions, written
from meshsplats.blender.inside.host import bpy

_FEW = 16
"""Layers that every ray passes in denoised images. On playbot at 240 x 135 pixels, 16 samples: 4.8 instead of
6.6 s, and 26.6 instead of 26.8 dB."""

_FEWER = 8
"""And those of previews."""


def exact_settings(scene: Any, engine: str, *, linear: bool = False) -> None:
    """Settings that render colours unchanged: no dither, one sample at each pixel's centre, no view
    transform. Colours that are ``linear`` light are encoded for display (sRGB)."""
    with told(scene):
        _exact(scene, engine, linear)


def _exact(scene: Any, engine: str, linear: bool) -> None:
    _choose(scene.display_settings, "display_device", "sRGB", "display")
    _common(scene, engine, "Standard" if linear else "Raw")
    scene.render.dither_intensity = 0
    scene.view_settings.use_curve_mapping = False
    versions.set_if_there(scene.view_settings, use_white_balance=False)
    cycles = scene.cycles
    cycles.film_exposure = 1.0
    cycles.samples = 1
    cycles.pixel_filter_type = "GAUSSIAN"
    # The first sample lies at the pixel's centre; a filter this narrow keeps it there.
    cycles.filter_width = 0.01
    cycles.max_bounces = 0
    cycles.use_denoising = False
    _layers(scene, 1024)
    scene.eevee.taa_render_samples = 1
    scene.render.filter_size = 0.0


def lit_settings(
    scene: Any,
    engine: str,
    *,
    samples: int = 16,
    limit: int = 1024,
    bounces: int = 4,
    denoise: bool = False,
    raytracing: bool | None = None,
    exposure: float = 0.0,
) -> None:
    """Settings for linear light, shown with the view transform Standard (sRGB). Limits on bounces are raised
    where they are lower. What splats do not need stays the artist's: caustics, dither, the display.

    Args:
        samples: per pixel; four times as many to ``denoise`` in a Blender that cannot.
        limit: most layers that a ray may pass.
        bounces: how often light is scattered.
        raytracing: whether EEVEE traces rays for mirrors and glass; None: as it does.
        exposure: in stops.
    """
    with told(scene):
        if denoise and not versions.can_denoise():
            samples, denoise = 4 * samples, False
        _common(scene, engine, "Standard")
        scene.view_settings.exposure = exposure
        cycles = scene.cycles
        cycles.samples = samples
        cycles.use_adaptive_sampling = False
        # The mean over a pixel, as in ``render``: wider filters blur the detail of splats.
        cycles.pixel_filter_type = "BOX"
        cycles.filter_width = 1.0
        wanted = {"max_bounces": max(bounces, 8), "diffuse_bounces": bounces}
        wanted |= {"glossy_bounces": max(bounces, 4), "transmission_bounces": max(bounces, 8)}
        for name, least in wanted.items():
            setattr(cycles, name, max(getattr(cycles, name), least))
        cycles.use_denoising = denoise
        versions.set_if_there(cycles, denoising_input_passes="RGB_ALBEDO_NORMAL", denoising_quality="HIGH")
        # The light tree skips lights behind a triangle, though its smoothed normal may face them.
        cycles.use_light_tree = False
        # Denoised, rays that have lost most of their light may end at random, which halves the time.
        _layers(scene, limit, least=_FEW if denoise else limit)
        scene.eevee.taa_render_samples = samples
        scene.render.filter_size = 1.5
        versions.set_if_there(scene.eevee, use_shadows=True)
        if raytracing is not None:
            versions.set_if_there(scene.eevee, use_raytracing=raytracing)


def preview_settings(scene: Any) -> None:
    """After ``lit_settings``, for previews: denoises by the image alone, in a fifth of the time and as well,
    as the light on splats was denoised when it was baked; more rays may end early."""
    versions.set_if_there(scene.cycles, denoising_input_passes="RGB", denoising_quality="FAST")
    scene.cycles.min_transparent_bounces = min(scene.cycles.min_transparent_bounces, _FEWER)


def layers_alone(scene: Any, limit: int) -> None:
    """Lets rays pass ``limit`` layers, in a file whose other settings are the artist's."""
    if scene.cycles.transparent_max_bounces < limit:
        with told(scene):
            scene.cycles.transparent_max_bounces = limit


def new_file(scene: Any) -> None:
    """Before ``exact_settings`` or ``lit_settings`` of a file that no artist has: what these leave alone.
    Images are then the same everywhere, and take no longer than they need.

    Raises:
        TypeError: the colour management of this Blender (OCIO) has no such display or view.
    """
    scene.display_settings.display_device = "sRGB"
    for view in ("Raw", "Standard"):
        scene.view_settings.view_transform = view
    scene.render.dither_intensity = 0
    cycles = scene.cycles
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False


_TOLD = {
    **{"engine": "render.engine", "view": "view_settings.view_transform", "look": "view_settings.look"},
    **{"exposure": "view_settings.exposure", "gamma": "view_settings.gamma"},
    **{"curves": "view_settings.use_curve_mapping", "white balance": "view_settings.use_white_balance"},
    **{"display": "display_settings.display_device", "dither": "render.dither_intensity"},
    **{"Cycles samples": "cycles.samples", "adaptive sampling": "cycles.use_adaptive_sampling"},
    **{"EEVEE samples": "eevee.taa_render_samples", "film exposure": "cycles.film_exposure"},
    **{"denoising": "cycles.use_denoising", "denoising passes": "cycles.denoising_input_passes"},
    **{"denoising quality": "cycles.denoising_quality", "light tree": "cycles.use_light_tree"},
    **{"bounces": "cycles.max_bounces", "diffuse bounces": "cycles.diffuse_bounces"},
    **{"glossy bounces": "cycles.glossy_bounces", "transmission bounces": "cycles.transmission_bounces"},
    "transparent bounces": "cycles.transparent_max_bounces",
    "least transparent bounces": "cycles.min_transparent_bounces",
    **{"pixel filter": "cycles.pixel_filter_type", "filter width": "cycles.filter_width"},
    **{"EEVEE filter": "render.filter_size", "EEVEE shadows": "eevee.use_shadows"},
    "EEVEE ray tracing": "eevee.use_raytracing",
}
"""All settings that functions here change in an artist's file, by what notes call them."""
_open: list[dict[str, Any]] = []
"""Values of the settings when each of the nested ``told`` began."""


@contextmanager
def told(scene: Any) -> Iterator[None]:
    """A note says which settings were changed meanwhile; of nested ones, the outermost does."""
    _open.append(_settings(scene))
    try:
        yield
    finally:
        before = _open.pop()
    if _open:
        return
    after = _settings(scene)
    changes = [f"{name} {value} to {after[name]}" for name, value in before.items() if value != after[name]]
    if changes:
        notes.add(f"render settings changed: {', '.join(changes)}")


def _settings(scene: Any) -> dict[str, Any]:
    """Values of ``_TOLD``, without those that this version of Blender lacks."""
    found = {}
    for name, path in _TOLD.items():
        owner, setting = path.split(".")
        value = getattr(getattr(scene, owner), setting, None)
        if value is not None:
            found[name] = ("off", "on")[value] if isinstance(value, bool) else value
            if isinstance(value, float):
                found[name] = f"{value:.3g}"
    return found


def _layers(scene: Any, limit: int, least: int | None = None) -> None:
    # A ray that passes more layers than the limit turns black. Beyond the minimum, it may end at random.
    scene.cycles.transparent_max_bounces = max(scene.cycles.transparent_max_bounces, limit)
    scene.cycles.min_transparent_bounces = limit if least is None else min(least, limit)


def _common(scene: Any, engine: str, view: str) -> None:
    # Sets up both engines, so that the user can switch.
    scene.render.engine = versions.engine_name(engine)
    _choose(scene.view_settings, "view_transform", view, "view transform")
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0
    scene.view_settings.gamma = 1


def _choose(owner: Any, name: str, value: str, what: str) -> None:
    """Sets the property ``name`` of ``owner``. Where the colour management (OCIO) is a studio's own, it may
    lack the ``value``: then a note says so, and it stays as it is."""
    try:
        setattr(owner, name, value)
    except TypeError:
        stays = f"{getattr(owner, name)} stays: colours may differ"
        notes.add(f"the colour management of this Blender has no {what} {value}, so that {stays}")


def render_to(scene: Any, path: Path, factor: int = 1, *, scratch: Path | None = None) -> None:
    """Renders to ``path``, .png (8 bits) or .exr (32 bits).

    Args:
        factor: blocks of ``factor`` x ``factor`` pixels are averaged into one.
        scratch: folder for the larger image meanwhile; by default that of ``path``.
    """
    transparent = scene.render.film_transparent
    settings = scene.render.image_settings
    settings.color_mode = "RGBA" if transparent else "RGB"
    if factor == 1:
        _format(settings, path.suffix)
        _render(scene, path)
        return
    large = (scratch or path.parent) / f"{path.stem}.large.exr"
    try:
        _format(settings, ".exr")
        _render(scene, large)
        small = _mean(read_pixels(large), factor)
    finally:
        if large.exists():
            large.unlink()
    _format(settings, path.suffix)
    _save(small, path, scene)


def _format(settings: Any, suffix: str) -> None:
    if suffix == ".exr":
        settings.file_format = "OPEN_EXR"
        settings.color_depth = "32"
        settings.exr_codec = "ZIP"
    else:
        settings.file_format = "PNG"
        settings.color_depth = "8"
        settings.compression = 50


def _render(scene: Any, path: Path) -> None:
    scene.render.use_file_extension = False
    scene.render.use_overwrite = True
    scene.render.filepath = os.fspath(path)
    bpy.ops.render.render(write_still=True)
    written.check_image(path, scene.render.resolution_x * scene.render.resolution_y)


def read_pixels(path: Path) -> np.ndarray:
    """(h, w, 4) float32 values of an EXR file as stored, rows from top to bottom."""
    image = bpy.data.images.load(os.fspath(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1]


def _mean(pixels: np.ndarray, factor: int) -> np.ndarray:
    height, width = pixels.shape[0] // factor, pixels.shape[1] // factor
    return (
        pixels.reshape(height, factor, width, factor, 4)
        .mean(axis=(1, 3), dtype=np.float64)
        .astype(np.float32)
    )


def _save(pixels: np.ndarray, path: Path, scene: Any) -> None:
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("mean", width, height, alpha=True, float_buffer=True)
    try:
        # The colour space of Blender's render results, so that the view transform applies to it as to them.
        image.colorspace_settings.name = "Linear Rec.709"
        image.alpha_mode = "PREMUL"
        image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1]).ravel())
        image.save_render(os.fspath(path), scene=scene)
    finally:
        bpy.data.images.remove(image)
    written.check_image(path, width * height)
