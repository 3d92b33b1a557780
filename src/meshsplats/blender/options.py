"""Options of a Blender scene: the engine, light, ground, mirror and glass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from meshsplats._common.options import Advanced, Range, check_options
from meshsplats.scene.camera import Camera

Engine = Literal["cycles", "eevee"]
Ground = Literal["plane", "catcher", "none"]

MAX_LAYERS = 1024
"""Blender's largest limit on transparent bounces: rays through more layers turn black in Cycles."""


@dataclass(frozen=True)
class LightOptions:
    """Light and surroundings of lit images. Lengths follow the subject's size."""

    sun: tuple[float, float] = (-50.0, 45.0)
    """Direction of the sun: azimuth (0 behind the viewer of the front, 90 on that viewer's right) and
    elevation, degrees."""
    sun_strength: Annotated[float, Range(0, 1e6)] = 2.5
    """Irradiance of a surface that faces the sun, W/m^2; at pi, a white one has radiance 1. 0: no sun."""
    sun_size: Annotated[float, Range(0, 180), Advanced] = 2.0
    """Degrees that the sun's disc spans: the larger, the softer shadows are."""
    sun_color: Annotated[tuple[float, float, float], "RGB", Advanced] = (1.0, 1.0, 1.0)
    """Colour of sunlight: linear R G B, 0 to 1; ``sun_strength`` is multiplied by it."""
    fill: Annotated[float, Range(0, 1e6), Advanced] = 0.0
    """Irradiance of a second, soft sun that stands low on the other side, W/m^2. 0: there is none."""
    sky: Annotated[float, Range(0, 1e6)] = 0.35
    """Radiance of the even sky; not used with ``hdri``."""
    sky_color: Annotated[tuple[float, float, float], "RGB", Advanced] = (1.0, 1.0, 1.0)
    """Colour of that sky: linear R G B, 0 to 1; ``sky`` is multiplied by it."""
    hdri: Path | None = None
    """Environment image (.hdr or .exr, equirectangular) that lights the scene and is mirrored in it. There is
    no sun beside it, unless ``lights`` or an option of the sun is given."""
    hdri_strength: Annotated[float, Range(0, 1e6), Advanced] = 1.0
    """Factor on the environment image."""
    hdri_rotation: Annotated[float, Range(-1e6, 1e6), Advanced] = 0.0
    """Degrees that the environment is rotated about the up direction."""
    ground: Ground = "plane"
    """Ground under the subject: a grey plane that fades into the background; a catcher, visible only where
    shadows fall (Cycles), for images with an alpha channel and no background; or none."""
    exposure: Annotated[float, Range(-20, 20)] = 0.35
    """Brightness added for display, in stops: with 0.35, a white plate that lies or faces the
    viewer looks white. Values of an .exr and the background do not change."""
    mirror: bool = False
    """A mirror behind the subject."""
    glass: bool = False
    """A glass ball beside the subject."""
    roughness: Annotated[float, Range(0, 1), Advanced] = 1.0
    """Roughness of the splats' surface; visible with ``specular``."""
    specular: Annotated[float, Range(0, 1), Advanced] = 0.0
    """Highlights of the splats' surface; 0.5 is plastic. Splats have highlights of their own baked
    in."""
    bounces: Annotated[int, Range(0, 64), Advanced] = 4
    """Most scattering events of a light path; layers that it passes through do not count."""

    @property
    def fill_direction(self) -> tuple[float, float]:
        """Direction of the second sun, as ``sun``."""
        return (-self.sun[0], 20.0)

    def check(self) -> None:
        """Raises ValueError for a value out of range, FileNotFoundError for a missing environment image."""
        check_options(self)
        azimuth, elevation = self.sun
        if not (np.isfinite(azimuth) and -90 <= elevation <= 90):
            raise ValueError(f"sun must be an azimuth and an elevation of -90 to 90 degrees, got {self.sun}")
        for name in ("sun_color", "sky_color"):
            if not all(0 <= value <= 1 for value in getattr(self, name)):
                raise ValueError(f"{name} must be linear RGB in [0, 1], got {getattr(self, name)}")
        if self.hdri is not None:
            check_environment(self.hdri)


LIGHTS = {
    "sun": LightOptions(),
    "noon": LightOptions(
        sun=(-30.0, 70.0),
        sun_strength=2.9,
        sun_size=0.6,
        sun_color=(1.0, 0.96, 0.9),
        sky=0.45,
        sky_color=(0.8, 0.9, 1.0),
    ),
    "overcast": LightOptions(sun_strength=0.0, sky=0.9),
    "studio": LightOptions(sun=(-45.0, 48.0), sun_strength=1.7, sun_size=35.0, fill=0.6, sky=0.32),
}
"""Lights by name: an afternoon's sun; the sun high in a clear sky; clouds, no shadows with edges; a large
lamp on the left, a weaker one on the right."""


@dataclass(frozen=True)
class Effort:
    """How much is done for light before the first lit image."""

    steps: int = 72
    """Of the fit of colours to linear light."""
    fit_views: int = 24
    """Views around the scene that this fit sees."""
    views: int = 40
    """Depth images around the scene: of them the surface is made that stands in for the splats, and they
    tell on which side of it a splat is."""
    resolution: int = 96
    """Voxels along the longest side of that surface."""
    samples: int = 12
    """Samples at each of the three corners of a point at which light is gathered."""


CAREFUL = Effort()
FAST = Effort(steps=12, fit_views=4, views=12, resolution=48, samples=4)
"""For previews: see docs/blender.md for what it costs and loses."""
FAST_SPLATS, FAST_SAMPLES = 30_000, 4
"""What the command's previews have by default."""


@dataclass(frozen=True)
class SceneOptions:
    """How Blender renders the mesh."""

    light: LightOptions | None = None
    """None: unlit colours, the image of ``meshsplats.render``. Otherwise lit by these as they are: for an
    environment image alone, give ``sun_strength`` 0."""
    engine: Engine = "cycles"
    """cycles: exact order and ray-traced light. eevee: fast; triangles are sorted for each camera."""
    samples: Annotated[int, Range(1, 65536)] = 1
    """Unlit: side of the grid of samples in each pixel, as in ``render``. Lit: samples per pixel."""
    background: Annotated[tuple[float, float, float] | None, "RGB"] = (1.0, 1.0, 1.0)
    """Display RGB behind everything; None: transparent, as with a catcher. An environment image replaces
    it."""
    denoise: bool = False
    """Cycles, lit: remove noise with OpenImageDenoise."""
    threads: Annotated[int | None, Range(1, math.inf)] = None
    """At most this many; default: all processors."""
    fast: bool = False
    """Lit: a rougher surface, colours and light, for a preview."""
    within: tuple[Camera, ...] | None = None
    """Lit: views of a place from within, for light on it; none of an object. None: they are looked for."""

    @property
    def effort(self) -> Effort:
        return FAST if self.fast else CAREFUL

    def check(self) -> None:
        """Raises ValueError for values out of range and choices that contradict each other."""
        check_options(self)
        if self.light is None and self.samples > 16:
            raise ValueError(f"samples of unlit images is the side of the grid, 1 to 16, got {self.samples}")
        if self.background is not None and not all(0 <= v <= 1 for v in self.background):
            raise ValueError(f"background must be RGB in [0, 1], got {self.background}")
        if self.denoise and (self.light is None or self.engine != "cycles"):
            raise ValueError("denoise is for lit images in Cycles: others have no noise, or another kind")
        if self.fast and self.light is None:
            raise ValueError("fast is for lit images: unlit ones need no preparation")
        if self.light is not None:
            self.light.check()
            if self.engine == "eevee" and self.light.ground == "catcher":
                raise ValueError("a shadow catcher works in Cycles only; choose ground 'plane' or 'none'")


def check_environment(path: Path) -> None:
    """Raises ValueError unless ``path`` begins as a Radiance (.hdr) or OpenEXR file does; OSError if
    unreadable."""
    with open(path, "rb") as file:
        start = file.read(10)
    if not (start.startswith((b"#?RADIANCE", b"#?RGBE")) or start[:4] == b"\x76\x2f\x31\x01"):
        raise ValueError(
            f"{path}: an environment image is a Radiance .hdr or an OpenEXR file; this is neither"
        )
