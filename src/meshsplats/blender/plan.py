"""The work ahead of Blender and where it is, in words, with estimates of the time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from meshsplats._common.words import duration
from meshsplats.blender.options import SceneOptions

if TYPE_CHECKING:
    from meshsplats.blender.launch import Progress

PHASES = {
    "colours": (2.0, 20.0, 0.25),
    "surface": (2.5, 7.0, 0.45),
    "building the scene": (0.5, 1.0, 1.0),
    "light": (2.0, 3.0, 0.2),
}
"""What comes before the first lit image: processor seconds, those for each million triangles, and the share
of both that a fast preview takes. The first two are worked on at the same time."""


def in_words(ahead: dict[str, Any], options: SceneOptions, images: int) -> str:
    """The plan ``ahead``, as ``draw`` announces it, of so many ``images``."""
    text = f"{ahead['triangles']:,} triangles, up to {ahead['layers']:,} layers behind each other"
    if not images:
        return text
    samples = ahead["samples"]
    text += f" ({ahead['mean_layers']:.0f} on average), {samples} sample{'s'[: samples > 1]} per pixel"
    text += ", denoised" if options.denoise else ""
    seconds = estimated_seconds(ahead, options)
    return text + ("" if seconds is None else f"; about {duration(seconds)} on {_processors(options)}")


def _processors(options: SceneOptions) -> str:
    from meshsplats._core.library import processors

    count = options.threads or processors()
    return f"{count} thread{'s'[: count > 1]}"


def estimated_seconds(ahead: dict[str, Any], options: SceneOptions) -> float | None:
    """Estimated time with Cycles, from the plan of ``draw``; None for EEVEE. Fitted to processor times of
    Blender 4.2 and 4.5 (docs/blender.md): a ray that meets m layers costs 1.1 m + 0.0083 m^2 microseconds,
    as each layer is searched for among those around it, 0.14 m more for each term of view-dependent
    colours, and lit one more for the ground. Before a lit image come the stand-in, colours and
    baked light."""
    if options.engine != "cycles":
        return None
    from meshsplats._core.library import processors

    lit = options.light is not None
    layer = 1.1e-6 + (0 if lit else 0.14e-6 * ahead.get("harmonics", 0))
    ray = layer * ahead["mean_layers"] + 8.3e-9 * ahead["mean_square_layers"] + (1e-6 if lit else 0)
    denoising = (2e-6 if options.fast else 20e-6) if options.denoise else 0.0
    pixel = ray * ahead["samples"] + denoising
    busy = pixel * ahead["pixels"] + 1e-6 * ahead["triangles"]
    return (busy + sum(phase_seconds(ahead, options).values())) / (options.threads or processors())


def phase_seconds(ahead: dict[str, Any], options: SceneOptions) -> dict[str, float]:
    """Estimated processor seconds of each phase before the first image."""
    if options.light is None:
        return {}
    millions = 1e-6 * ahead["triangles"]
    return {
        name: (fixed + each * millions) * (share if options.fast else 1)
        for name, (fixed, each, share) in PHASES.items()
    }


class Schedule:
    """Says how much time is left, from the estimates and from how long what is done has taken."""

    def __init__(
        self, ahead: dict[str, Any], options: SceneOptions, clock: Callable[[], float] = time.monotonic
    ) -> None:
        from meshsplats._core.library import processors

        self._clock = clock
        self._start = self._began = clock()
        self._at = -1
        self._images_from: float | None = None
        self._phases = phase_seconds(ahead, options)
        self._threads = options.threads or processors()
        whole = estimated_seconds(ahead, options)
        # Images in EEVEE are not estimated.
        self._images = 0.0 if whole is None else whole * self._threads - sum(self._phases.values())

    def with_time(self, at: Progress) -> Progress:
        """``at``, with the time that is left of all."""
        now = self._clock()
        if at.phase in self._phases:
            here = list(self._phases).index(at.phase)
            if here < self._at:  # again, for a coarser level of a chain
                return at
            if here > self._at:
                self._at, self._began = here, now
            seconds = list(self._phases.values())
            done = sum(seconds[:here])
            pace = (self._began - self._start) / done if done else 1 / self._threads
            left = pace * (sum(seconds[here:]) + self._images) - (now - self._began)
            return replace(at, left=duration(max(left, 0.0)))
        if at.phase or at.images < 2:
            return at
        if self._images_from is None:
            self._images_from = now
        done = at.done + at.share
        if not at.done:
            return at
        return replace(at, left=duration((now - self._images_from) / done * (at.images - done)))


def where(at: Progress) -> str:
    """``at`` in words."""
    which = f"image {min(at.done + 1, at.images)} of {at.images}" if at.images > 1 else ""
    left = f"{at.left} left" if at.left else ""
    return ", ".join(filter(None, [which if not at.phase else "", at.stage, left]))


class Lines:
    """Says where the work is: each phase as it begins, and else every ``every`` seconds."""

    def __init__(self, say: Callable[[str], object], every: float = 10.0) -> None:
        self._say, self._every = say, every
        self._next, self._phase = time.monotonic() + every, ""

    def __call__(self, at: Progress) -> None:
        if at.stage and (time.monotonic() >= self._next or (at.phase and at.phase != self._phase)):
            self._phase = at.phase
            self._next = time.monotonic() + self._every
            self._say(f"Blender: {where(at)}")
