"""The configuration of a fine-tuning, validated up front, its presets, and its learning rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

if TYPE_CHECKING:
    from typing_extensions import Unpack

from meshsplats._common.choices import Look
from meshsplats._common.options import Advanced, Range, With, check_names, check_options

Unit = Literal["splat", "scene"]
BackgroundMode = Literal["mixed", "random", "white", "black"]
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
LENGTHS = ("epochs", "steps", "minutes")
LEAST_MINUTES = 1e-4
"""Shortest length of a run in minutes."""
CUTTING = (
    *("opacity", "cutoff", "anneal_share", "expected_share", "settle_share"),
    *("hidden_hits", "opaque_share", "soft_share", "soft_phase"),
)
"""Options of meshes that a depth buffer draws."""

HARMONICS_RATE = 0.02
"""``harmonics_rate`` for images of splats."""

_POSITION_EPSILON = 1e-15
"""Adam's epsilon for positions in units of the splat."""

FEWEST_VIEWS, MOST_VIEWS = 200, 1000
"""Number of training images rendered from splats: for a short run, and for the longest."""

LONG_MINUTES, LONG_STEPS = 10.0, 2000
"""Least length of a long run."""
AREA_ZOOMS = (1,) * 5 + (2,)
"""Zooms of the training views in the look 'area' (``splat_dataset``). Windows of larger images add detail for
large images: in two minutes, playbot gains 0.4 dB at 800 and 1600 pixels and loses 0.1 at 400; the guitar
gains 0.8 to 1.5 and 0.3 to 1.1. Never a multiple of four entries (reason: ``ZOOMS``)."""


@dataclass(frozen=True)
class FinetuneConfig:
    """All options that change the result. The defaults are those of the preset 'default'; None stands for the
    one that the text of an option names.

    Each step compares one rendered image with its target. The loss is ``(1 - ssim_weight) * L1 + ssim_weight
    * (1 - SSIM) + l2_weight * L2``, where L1 and L2 are the mean absolute and mean squared difference, and
    SSIM follows the convention of 3DGS.
    """

    preset: str = "default"
    """Name of the preset that these values started from, for the record."""
    epochs: Annotated[float | None, Range(0, 1e6)] = None
    """Length in epochs: passes over all training views. Exactly one of epochs, steps and minutes is given."""
    steps: Annotated[int | None, Range(0, 10**9)] = 1000
    """Length in steps, of one view each."""
    minutes: Annotated[float | None, Range(LEAST_MINUTES, 1e5)] = None
    """Length in minutes, including what came before (reading, finding cameras, converting, rendering the
    targets). The only length whose result depends on the machine's speed."""
    color_rate: Annotated[float, Range(1e-9, 1), Advanced] = 0.02
    """Adam's learning rate of red, green, blue and opacity, in [0, 1]: about how much one step changes
    them."""
    position_rate: Annotated[float, Range(0, 10), Advanced] = 0.02
    """Adam's learning rate of the vertex positions, in ``position_unit``. 0: positions are fixed."""
    harmonics_rate: Annotated[float | None, Range(0, 1), Advanced] = None
    """Adam's learning rate of the spherical harmonics of splats, where the mesh has them. It falls as that of
    colours does. 0: they stay. Default: 0.02 for images of splats, 0.005 for photographs, which are few: what
    they alone show, held-out ones do not."""
    position_unit: Annotated[Unit, Advanced] = "splat"
    """Unit of ``position_rate``. splat: the size of the splat that a vertex belongs to. scene: scene units,
    as in the paper."""
    position_pixels: Annotated[float, Range(0, 1e6), With(opacity="blended"), Advanced] = 2.0
    """Upper limit of that unit, in pixels of the training images that see the splat: at the edges of larger
    splats, what a step learns is as fine as pixels. 0: no limit. For opacity 'blended' only, as visible
    edges carry more information."""
    soft_edges: Annotated[bool, Advanced] = True
    """Keep opacities of 0 on the boundary of the mesh, such as the rims of fans, at 0. Visible edges get no
    gradient that would move them back, and opacities, which are clamped at 0, would drift upwards there."""
    final_share: Annotated[float, Range(1e-6, 1), Advanced] = 0.1
    """Exponential learning-rate decay: both rates fall to this fraction of their initial value over the run
    (3DGS: position_lr_final / position_lr_init)."""
    rate_steps: Annotated[int, Range(0, 10**9), Advanced] = 250
    """In runs of more steps than this, multiply the learning rate of positions, and the final fraction of
    both, by ``sqrt(rate_steps / steps)``: the step size that a short run needs is noise in a long one. 0:
    learning rates do not depend on the number of steps."""
    color_step_decay: Annotated[float, Range(0.5, 1), Advanced] = 1.0
    """Additional decay of the colour learning rate: its factor per step, whatever the length of the run."""
    beta1: Annotated[float, Range(0, 0.99999), Advanced] = 0.5
    """Adam's decay rate of the first moment. Low: successive views show other vertices, or other sides."""
    beta2: Annotated[float, Range(0, 0.9999999), Advanced] = 0.9
    """Adam's decay rate of the second moment. Low: a vertex is seen tens of times, not thousands."""
    epsilon: Annotated[float, Range(1e-30, 1), Advanced] = 1e-15
    """Adam's epsilon, added to the denominator. With ``position_unit`` 'splat', positions have 1e-15: their
    gradients depend on the unit of the scene."""
    ssim_weight: Annotated[float, Range(0, 1), Advanced] = 0.4
    """Weight of SSIM against L1 in the loss."""
    l2_weight: Annotated[float, Range(0, 1000), Advanced] = 10.0
    """Weight of the mean squared difference (L2) in the loss."""
    background: BackgroundMode = "mixed"
    """Background of images with alpha. random: a new colour in every step, so that empty regions become
    transparent. mixed: random in every fourth step, otherwise the background of the data set, on which images
    are shown and evaluated. Photographs without alpha always use the background of the data set."""
    opacity_decay: Annotated[float, Range(0, 0.5), With(opacity="blended"), Advanced] = 0.0
    """Share of its opacity that a vertex loses in each step whose view reaches it. It falls as the colour
    learning rate does. Opacities stay high only where the views keep them there: what floats in front of
    surfaces fades, and what is hidden behind others gets gradients. For opacity 'blended'."""
    exposure: Annotated[bool | None, With(opacity="blended")] = False
    """For photographs: fit a gain and an offset per colour channel to each training image, so that
    differences in exposure are not baked into the mesh. Their means over all images stay 1 and 0."""
    exposure_rate: Annotated[float, Range(1e-9, 1), With("exposure"), Advanced] = 0.002
    """Adam's learning rate of these gains and offsets."""
    prune_epochs: Annotated[float, Range(0, 1e6), Advanced] = 5.0
    """Epochs between two prunings of the mesh. 0: no pruning."""
    prune_opacity: Annotated[float, Range(0, 1), Advanced] = 1 / 255
    """Prune triangles whose corners all have less opacity than this, and the vertices that no triangle then
    uses."""
    blending: Literal["mesh", "display", "linear"] = "mesh"
    """Colour space in which triangles are blended. mesh: that of the mesh. display: display values. linear:
    linear light, for exports to engines that light or blend in linear light."""
    order: Literal["mesh", "fragment", "splat", "file"] = "mesh"
    """Order in which triangles are blended. mesh: that of the mesh. fragment: exact at every sample, as ray
    tracers draw. splat: whole splats by their centres, for programs that sort those; faster. file: as a .glb
    lists them, for web viewers and engines that sort nothing."""
    samples: Annotated[int | None, Range(1, 16)] = None
    """Samples along each side of a pixel. Default: 2 for images that are means over each pixel's area, also
    photographs; 1 for those of a splat viewer (``look`` splats)."""
    opacity: Literal["blended", "cutoff"] = "blended"
    """blended: translucent triangles. cutoff: opaque ones, for game engines."""
    cutoff: Annotated[float, Range(0, 1), With(opacity="cutoff")] = 0.2
    """Least opacity that is drawn."""
    anneal_share: Annotated[float, Range(0, 1), With(opacity="cutoff"), Advanced] = 0.5
    """Opacities turn from blended to cut over this initial fraction of the run."""
    expected_share: Annotated[float, Range(0, 1), With(opacity="cutoff"), Advanced] = 0.5
    """Share of the loss, from the end of the annealing on, that is l2_weight times the expected square error
    of images in which each fragment is opaque with its opacity as probability. It makes layers agree with the
    target one by one, not only in their mean."""
    settle_share: Annotated[float | None, Range(0, 1), With(opacity="cutoff"), Advanced] = None
    """Before this last fraction of the run, triangles that the training views do not show are removed.
    Default: 0.15, or 0.5 with opaque_share, whose triangles change their shapes then."""
    hidden_hits: Annotated[int, Range(0, 10**9), With(opacity="cutoff"), Advanced] = 1
    """Remove triangles that are visible at fewer samples than this, counted over 64 training views with 2 x 2
    samples a pixel. 0: none."""
    opaque_share: Annotated[float, Range(0, 1), With(opacity="cutoff")] = 1.0
    """Largest number of opaque triangles, as a fraction of the number at the start. Splats become polygons of
    fewer corners, down to one triangle; the least visible ones go. 1: all stay."""
    soft_share: Annotated[float, Range(0, 1), With(opacity="cutoff")] = 0.0
    """Faint splats that opaque triangles cannot replace stay blended, with up to this fraction of the number
    of triangles at the start. 0: none."""
    soft_phase: Annotated[float, Range(0.01, 0.99), With("soft_share"), Advanced] = 0.3
    """With soft_share: last fraction of the run, in which the blended triangles are optimised together with
    the cut ones. The shares above are then fractions of the phase before."""
    point_share: Annotated[float, Range(0, 1), Advanced] = 0.4
    """For rendered images that are means over each pixel's area: for this initial fraction of the run, train
    on the values at the pixel centres, at one sample per pixel. This is faster and shows detail finer than a
    pixel without averaging. 0: train on means only."""
    one_sample_share: Annotated[float | None, Range(0, 1), Advanced] = None
    """For photographs: for this initial fraction of the run, draw one sample per pixel, which takes half the
    time. Default: 0.85, or 0 for photographs with alpha, whose sharp outlines before a plain background lose
    by it, and for opacity 'cutoff'."""
    by_splat_share: Annotated[float | None, Range(0, 1), With(opacity="blended"), Advanced] = None
    """For this initial fraction of the run, splats are blended whole, by their centres, which takes two
    thirds of the time of exact order; then they are in the order of the result. Default: 0.6 for photographs,
    0 for images of splats, where exact order is better in the same time. No difference with order 'splat'
    or 'file', and for meshes that do not know their splats."""
    dropout: Annotated[float | None, Range(0, 0.5), With(opacity="blended"), Advanced] = 0.0
    """Share of the splats that each step leaves out, at random, once each view was seen forty times; none
    until it was seen ten times. The others are more opaque by as much. Few photographs are overfitted
    otherwise. Default of ``train``: 0.15 for up to thirty photographs, less for more, and 0 from sixty on."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of the order of the views, of random backgrounds and of what is left out. The same seed gives the
    same bits, with any number of threads, unless the length is given in minutes."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if getattr(value, "ndim", None) == 0:  # a number of NumPy
                object.__setattr__(self, name, value.item())
        check_options(self, types=(int, float))  # what JSON can hold
        if self.opacity == "cutoff":
            self._check_cutoff()
        given = [name for name in LENGTHS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(LENGTHS)}, got {' and '.join(given) or 'none of them'}")

    def _check_cutoff(self) -> None:
        """ValueError for options that have no meaning, or were never tried, without blending."""
        if self.blending == "linear":
            raise ValueError("blending 'linear' is for opacity 'blended': opaque triangles are not blended")
        if self.order in ("splat", "file"):
            raise ValueError(
                f"order {self.order!r} is for opacity 'blended': opaque triangles have a depth buffer"
            )
        if self.expected_share and not self.l2_weight:
            raise ValueError("expected_share is a share of l2_weight, which is 0: set l2_weight, or it to 0")
        if self.opaque_share < 1 and self.anneal_share + self.settling > 1:
            raise ValueError(
                f"with opaque_share, the annealing must end before the mesh settles, but anneal_share"
                f" {self.anneal_share:g} and settle_share {self.settling:g} add up to more than 1: lower one"
            )

    @property
    def cuts(self) -> bool:
        """Whether the triangles become opaque ones."""
        return self.opacity == "cutoff"

    @property
    def settling(self) -> float:
        """``settle_share``, or its default."""
        if self.settle_share is not None:
            return self.settle_share
        return 0.15 if self.opaque_share == 1 else 0.5

    @property
    def behind_splats(self) -> tuple[float, float, float]:
        """The background of images of splats."""
        return BACKGROUNDS["black" if self.background == "black" else "white"]

    def total_steps(self, views: int) -> int | None:
        """Number of steps with this number of training views; None if the length is given in minutes."""
        if self.minutes is not None:
            return None
        return int(self.steps) if self.steps is not None else max(1, round((self.epochs or 0) * views))

    def prune_interval(self, views: int) -> int:
        """Number of steps between two prunings; 0: never."""
        return max(1, round(self.prune_epochs * views)) if self.prune_epochs else 0

    def to_dict(self) -> dict[str, Any]:
        """All fields, for JSON."""
        return asdict(self)


_PAPER = FinetuneConfig(
    preset="paper",
    epochs=15,
    steps=None,
    color_rate=5e-3,
    position_rate=math.exp(-3) * 5e-3,
    harmonics_rate=HARMONICS_RATE,
    position_unit="scene",
    position_pixels=0.0,
    soft_edges=False,
    final_share=1.0,
    rate_steps=0,
    color_step_decay=0.999,
    beta1=0.9,
    beta2=0.999,
    ssim_weight=0.4,
    l2_weight=0.0,
    background="white",
    samples=1,
    point_share=0.0,
    one_sample_share=0.0,
    by_splat_share=0.0,
    prune_epochs=10,
    epsilon=1e-8,
    prune_opacity=math.exp(-4),
)

PRESETS: Mapping[str, FinetuneConfig] = {
    "default": FinetuneConfig(),
    "paper": _PAPER,
}
"""default: the best in our measurements at equal time. paper: the values in the text of arXiv 2502.07754,
with the colour learning rate of its code, since the text gives none. ``docs/options.md`` has the table."""


class FinetuneChanges(TypedDict, total=False):
    """The fields of ``FinetuneConfig`` as keywords, for type checkers and editors."""

    epochs: float | None
    steps: int | None
    minutes: float | None
    color_rate: float
    position_rate: float
    harmonics_rate: float | None
    position_unit: Unit
    position_pixels: float
    soft_edges: bool
    final_share: float
    rate_steps: int
    color_step_decay: float
    beta1: float
    beta2: float
    epsilon: float
    ssim_weight: float
    l2_weight: float
    background: BackgroundMode
    opacity_decay: float
    exposure: bool | None
    exposure_rate: float
    prune_epochs: float
    prune_opacity: float
    blending: Literal["mesh", "display", "linear"]
    order: Literal["mesh", "fragment", "splat", "file"]
    samples: int | None
    opacity: Literal["blended", "cutoff"]
    cutoff: float
    anneal_share: float
    expected_share: float
    settle_share: float | None
    hidden_hits: int
    opaque_share: float
    soft_share: float
    soft_phase: float
    point_share: float
    one_sample_share: float | None
    by_splat_share: float | None
    dropout: float | None
    seed: int


def make_config(preset: str = "default", **changes: Unpack[FinetuneChanges]) -> FinetuneConfig:
    """The configuration of ``preset`` with ``changes``; a length that is given takes the place of the
    preset's.

    Raises ValueError for an unknown preset and for values out of range, TypeError for a name that does not
    exist.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    return with_changes(PRESETS[preset], **changes)


def with_changes(config: FinetuneConfig, **changes: Unpack[FinetuneChanges]) -> FinetuneConfig:
    """``config`` with ``changes``; a length that is given takes the place of its own. Errors are those of
    ``make_config``."""
    known = [f.name for f in fields(FinetuneConfig) if f.name != "preset"]
    check_names("fine-tuning", changes, known)
    if any(changes.get(name) is not None for name in LENGTHS):
        whole: FinetuneChanges = {"epochs": None, "steps": None, "minutes": None}
        whole.update(changes)
        return replace(config, **whole)
    return replace(config, **changes)


def worthwhile_views(config: FinetuneConfig) -> int:
    """Number of training images to render from splats for a run of this length.

    Few images are rendered sooner and seen more often, but a long run overfits them.
    """
    wanted = 60 * config.minutes if config.minutes is not None else (config.steps or 0) / 2
    return round(min(max(wanted, FEWEST_VIEWS), MOST_VIEWS))


def is_long(config: FinetuneConfig, views: int) -> bool:
    """Whether a run with this number of training views is long enough for a mesh of more triangles. Of the
    preset 'default', with blended triangles."""
    if config.preset != "default" or config.opacity != "blended":
        return False
    if config.minutes is not None:
        return config.minutes >= LONG_MINUTES
    return (config.total_steps(views) or 0) >= LONG_STEPS


def worthwhile_zooms(config: FinetuneConfig, look: Look, filtered: bool = False) -> tuple[int, ...]:
    """Zooms of the training images to render from splats in this look (``splat_dataset``).

    In the look 'area' ``AREA_ZOOMS``, for blended triangles and the preset 'default'. In the look 'splats'
    several for a mesh with a filter (``filtered``): without one, it can match a viewer's images of one size
    only.
    """
    from meshsplats.datasets.splat_targets import ZOOMS

    if look == "splats":
        return ZOOMS["splats"] if filtered else (1,)
    return AREA_ZOOMS if config.preset == "default" and config.opacity == "blended" else (1,)


def epsilons(config: FinetuneConfig) -> tuple[float, float]:
    """Adam's epsilon for colours, and for positions."""
    return config.epsilon, config.epsilon if config.position_unit == "scene" else _POSITION_EPSILON


def learning_rates(config: FinetuneConfig, step: float, fraction: float) -> tuple[float, float]:
    """Learning rates of colours and of positions in step ``step`` (from 0).

    ``fraction`` (0 to 1) of the run is over. The total number of steps is estimated as ``step / fraction``,
    which also holds for runs whose length is given in minutes.
    """
    slowdown = 1.0
    if config.rate_steps and step > config.rate_steps * fraction:
        slowdown = math.sqrt(config.rate_steps * fraction / step)
    decay = (config.final_share * slowdown) ** min(max(fraction, 0.0), 1.0)
    color = config.color_rate * decay * config.color_step_decay**step
    return max(color, 1e-12), config.position_rate * decay * slowdown
