"""What a fine-tuning does: its configuration, the presets, and what can be told wrong before any work."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

from meshsplats._options import Range, check_choices, check_flags, check_names, check_ranges

Unit = Literal["splat", "scene"]
Backdrop = Literal["mixed", "random", "white", "black"]
BACKDROPS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
LENGTHS = ("epochs", "steps", "minutes")

FEWEST_VIEWS, MOST_VIEWS = 200, 1000
"""Pictures of splats to learn from: in a short run, and in the longest."""


@dataclass(frozen=True)
class FinetuneConfig:
    """Every choice that changes the result. The defaults are those of the preset 'default'.

    The loss of a step, one picture, is ``(1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM) + l2_weight * L2``
    with L1 and L2 the means of the differences' sizes and squares, and SSIM in the convention of 3DGS.
    """

    preset: str = "default"
    """The preset that these values began from; a name for the record."""
    epochs: float | None = None
    """Length: so many times all training views. Of the three lengths exactly one is given."""
    steps: int | None = 1000
    """Length: so many steps, one view each."""
    minutes: float | None = None
    """Length: so much time, with what came before (reading, converting, drawing the targets). The one length
    whose result depends on the machine's speed."""
    color_rate: float = 0.02
    """Adam's rate of red, green, blue and opacity, which lie in [0, 1]: about how far one step moves them."""
    position_rate: float = 0.02
    """Adam's rate of the positions, in ``position_unit``; 0: they stay."""
    position_unit: Unit = "splat"
    """splat: the size of the splat that a vertex belongs to. scene: scene units, as the paper has it."""
    soft_edges: bool = True
    """Opacities that are 0 at the mesh's open edges, as on the rims of fans, stay 0. An edge that shows has
    no gradient that would move it back, and opacities, which cannot fall below 0, would drift up there."""
    final_share: float = 0.1
    """Both rates fall exponentially over the whole length, to this share of what they were."""
    rate_steps: int = 250
    """Runs of more steps than these move positions less in each, at ``sqrt(rate_steps / steps)`` of the rate,
    and both rates fall that much further: what a short run needs to arrive is noise in a long one. 0: rates
    do not depend on the length."""
    color_step_decay: float = 1.0
    """The colour rate is also multiplied by this after every step."""
    beta1: float = 0.5
    """Adam's memory of the gradient. Short: the next views look at other vertices, or from elsewhere."""
    beta2: float = 0.9
    """Adam's memory of the gradient's square. Short, for a vertex is seen tens of times, not thousands."""
    epsilon: float = 1e-15
    """Adam's smallest divisor."""
    ssim_weight: float = 0.4
    """Share of SSIM, 0 to 1."""
    l2_weight: float = 50.0
    """Weight of the mean square difference, added to the others."""
    background: Backdrop = "mixed"
    """Behind pictures that have alpha; random: another colour in every step, so that what should be empty
    becomes so; mixed: that in every fourth step, and in the others the data set's own background, on which
    pictures are shown and compared. Photographs without alpha are drawn on the latter."""
    exposure: bool = False
    """Photographs: fit a gain and an offset a channel for each training picture, so that changes of light
    between them are not painted into the mesh. Their means stay 1 and 0."""
    exposure_rate: float = 0.002
    """Adam's rate of gains and offsets."""
    prune_epochs: float = 5.0
    """The mesh is pruned, as the next two options say, each time so many epochs have passed; 0: never."""
    prune_opacity: float = 1 / 255
    """Pruning drops triangles all of whose corners have less opacity than this, and vertices that are then
    part of no triangle."""
    prune_importance: float = 0.0
    """Pruning also drops splats of which all training views together show less than so many pixels, because
    they are too faint or hidden by others; those that lie outside every view stay. 0: none."""
    relocate_share: float = 0.0
    """At most this share of the splats is moved at a time: those that show next to nothing take over halves
    of those that are needed most; 0: none, and none on a base mesh. For long runs: what was halved has to
    settle again."""
    relocate_epochs: float = 1.0
    """They are moved each time so many epochs have passed, in the first half of the run."""
    blending: Literal["mesh", "display", "linear"] = "mesh"
    """Space in which the triangles are blended: as the mesh says; display values; or linear light, for
    exports that will be lit or blended by engines that work in linear light."""
    samples: int | None = None
    """Side of the grid of samples in each pixel. None: 2, for images that are means over each pixel's area,
    photographs among them; 1 for those of a splat viewer (``Dataset.look``)."""
    point_share: float = 0.4
    """Images of splats that are means over each pixel's area: at first, for this share of the run, the mesh
    learns from their values at the pixels' centres, at one sample a pixel. That is quicker, and shows detail
    finer than a pixel as it is. 0: from means alone."""
    seed: int = 0
    """Of the views' order and the random backgrounds. The same seed gives the same result to the last bit,
    with any number of threads, unless the length is given in minutes."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES, optional=(*LENGTHS, "samples"))
        check_choices(self, _CHOICES)
        check_flags(self, ("exposure", "soft_edges"))
        given = [name for name in LENGTHS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(LENGTHS)}, got {' and '.join(given) or 'none of them'}")

    def total_steps(self, views: int) -> int | None:
        """Number of steps with so many training views; None where time is the limit."""
        if self.minutes is not None:
            return None
        return int(self.steps) if self.steps is not None else max(1, round((self.epochs or 0) * views))

    def prune_interval(self, views: int) -> int:
        """Number of steps from one pruning to the next; 0: never."""
        return max(1, round(self.prune_epochs * views)) if self.prune_epochs else 0

    def relocate_interval(self, views: int) -> int:
        """Number of steps from one relocation to the next; 0: never."""
        return max(1, round(self.relocate_epochs * views)) if self.relocate_share else 0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


_CHOICES = {
    "position_unit": get_args(Unit),
    "background": get_args(Backdrop),
    "blending": ("mesh", "display", "linear"),
}

_RANGES: list[Range] = [
    ("epochs", 0, 1e6, False),
    ("steps", 0, 10**9, True),
    ("minutes", 0, 1e5, False),
    ("color_rate", 1e-9, 1, False),
    ("position_rate", 0, 10, False),
    ("final_share", 1e-6, 1, False),
    ("rate_steps", 0, 10**9, True),
    ("color_step_decay", 0.5, 1, False),
    ("beta1", 0, 0.99999, False),
    ("beta2", 0, 0.9999999, False),
    ("epsilon", 1e-30, 1, False),
    ("ssim_weight", 0, 1, False),
    ("l2_weight", 0, 1000, False),
    ("exposure_rate", 1e-9, 1, False),
    ("prune_epochs", 0, 1e6, False),
    ("prune_opacity", 0, 1, False),
    ("prune_importance", 0, 1e6, False),
    ("relocate_share", 0, 0.5, False),
    ("relocate_epochs", 1e-3, 1e6, False),
    ("samples", 1, 16, True),
    ("point_share", 0, 1, False),
    ("seed", 0, 2**63 - 1, True),
]

_PAPER = FinetuneConfig(
    preset="paper",
    epochs=15,
    steps=None,
    color_rate=5e-3,
    position_rate=math.exp(-3) * 5e-3,
    position_unit="scene",
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
    prune_epochs=10,
    epsilon=1e-8,
    prune_opacity=math.exp(-4),
    prune_importance=0.0,
)

PRESETS: Mapping[str, FinetuneConfig] = {
    "default": FinetuneConfig(),
    "paper": _PAPER,
    "published": replace(_PAPER, preset="published", color_rate=1e-2, position_rate=1e-6, prune_opacity=1e-4),
}
"""default: measured to be the best at equal time. paper: the values in the text of arXiv 2502.07754, whose
colour rate is left open there and taken from its code. published: those of its code, with SSIM and background
as they were meant. ``docs/finetuning.md`` has the table."""


def make_config(preset: str = "default", **changes: Any) -> FinetuneConfig:
    """The configuration of ``preset`` with ``changes``; a length that is given takes the place of the
    preset's.

    Raises ValueError for an unknown preset and for values out of range, TypeError for a name that does not
    exist.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    known = [f.name for f in fields(FinetuneConfig) if f.name != "preset"]
    check_names("fine-tuning", changes, known)
    if any(changes.get(name) is not None for name in LENGTHS):
        changes = {name: None for name in LENGTHS} | changes
    return replace(PRESETS[preset], **changes)


def worthwhile_views(config: FinetuneConfig) -> int:
    """Number of pictures of splats for so long a run: few are drawn sooner and seen more often, but a long
    run learns them by heart."""
    wanted = 60 * config.minutes if config.minutes is not None else (config.steps or 0) / 2
    return round(min(max(wanted, FEWEST_VIEWS), MOST_VIEWS))


def rates(config: FinetuneConfig, step: int, fraction: float) -> tuple[float, float]:
    """Rates of colours and of positions for step number ``step`` (from 0), ``fraction`` (0 to 1) of the way.

    The number of all steps is taken to be ``step / fraction``, which suits runs of a stated time, too.
    """
    slowed = 1.0
    if config.rate_steps and step > config.rate_steps * fraction:
        slowed = math.sqrt(config.rate_steps * fraction / step)
    decay = (config.final_share * slowed) ** min(max(fraction, 0.0), 1.0)
    color = config.color_rate * decay * config.color_step_decay**step
    return max(color, 1e-12), config.position_rate * decay * slowed
