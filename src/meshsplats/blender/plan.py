"""The work ahead of Blender, in words, with an estimate of the time."""

from __future__ import annotations

from typing import Any

from meshsplats.blender.options import SceneOptions


def in_words(ahead: dict[str, Any], options: SceneOptions, images: int) -> str:
    """The plan ``ahead``, as ``draw`` announces it, of so many ``images``."""
    text = f"{ahead['triangles']:,} triangles, up to {ahead['layers']:,} layers behind each other"
    if not images:
        return text
    samples = ahead["samples"]
    text += f" ({ahead['mean_layers']:.0f} on average), {samples} sample{'s'[: samples > 1]} per pixel"
    text += ", denoised" if options.denoise else ""
    seconds = estimated_seconds(ahead, options)
    return text + ("" if seconds is None else f"; about {_duration(seconds)} on {_processors(options)}")


def _processors(options: SceneOptions) -> str:
    from meshsplats._core.library import processors

    count = options.threads or processors()
    return f"{count} thread{'s'[: count > 1]}"


def _duration(seconds: float) -> str:
    """In words, no more exact than an estimate."""
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def estimated_seconds(ahead: dict[str, Any], options: SceneOptions) -> float | None:
    """Estimated time with Cycles, from the plan of ``draw``; None for EEVEE. Fitted to processor times of
    Blender 4.2 and 4.5 (docs/blender.md): a ray that meets m layers costs 1.1 m + 0.0083 m^2 microseconds,
    as each layer is searched for among those around it, and lit one more for the ground. Before a lit image
    come the stand-in, colours and baked light."""
    if options.engine != "cycles":
        return None
    from meshsplats._core.library import processors

    lit = options.light is not None
    ray = 1.1e-6 * ahead["mean_layers"] + 8.3e-9 * ahead["mean_square_layers"] + (1e-6 if lit else 0)
    pixel = ray * ahead["samples"] + (20e-6 if options.denoise else 0)
    busy = pixel * ahead["pixels"] + 1e-6 * ahead["triangles"]
    if lit:
        busy += 8 + 35e-6 * ahead["triangles"]
    return busy / (options.threads or processors())
