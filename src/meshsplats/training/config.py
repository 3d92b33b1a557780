"""The configuration of a training: that of the fine-tuning, and how the set of fans grows."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

from meshsplats._common.options import Advanced, Fixed, Range, check_names
from meshsplats.finetuning.config import HARMONICS_RATE, LENGTHS, BackgroundMode, FinetuneConfig

MASKED_SHARE = 0.4
"""Fans at the start from masked photographs, as a share of ``max_splats``. Lego, 300 steps at half the size:
30.8 dB, with all of them 30.3."""
USUAL_SPLATS, MOST_SPLATS, PIXELS_PER_SPLAT = 100_000, 200_000, 500
"""Fans by default, at most, and pixels of unmasked photographs for each. Of a room in 109 megapixels 200,000
are better from the third minute on, by 0.3 to 0.7 dB; few photographs, or a subject before nothing, lose."""
_GROWS = "while the set of fans grows; finetune has it"


@dataclass(frozen=True)
class TrainConfig(FinetuneConfig):
    """All options that change the result of ``train``: those of the fine-tuning, with other defaults, and
    those of growth."""

    preset: str = "train"
    steps: int | None = None
    minutes: float | None = 10.0
    rate_steps: int = 1000
    color_rate: float = 0.03
    position_rate: float = 0.12
    position_pixels: float = 0.0
    harmonics_rate: float | None = HARMONICS_RATE
    """Adam's learning rate of the spherical harmonics. It falls as that of colours does. 0: they stay 0."""
    l2_weight: float = 10.0
    opacity: Annotated[Literal["blended", "cutoff"], Fixed(_GROWS)] = "blended"
    prune_epochs: Annotated[float, Fixed(_GROWS)] = 0.0
    prune_opacity: Annotated[float, Fixed(_GROWS)] = FinetuneConfig.prune_opacity
    point_share: Annotated[float, Fixed("for photographs, which have no values at pixel centres")] = (
        FinetuneConfig.point_share
    )
    blending: Annotated[
        Literal["mesh", "display", "linear"], Fixed("while training: fine-tune the result with another")
    ] = "mesh"
    order: Literal["mesh", "fragment", "splat"] = "mesh"
    """Order in which triangles are blended at the end of the run, and in the mesh. mesh, fragment: exact at
    every sample, as ray tracers draw. splat: whole fans by their centres, for programs that sort those;
    faster."""
    exposure: bool | None = None
    opacity_decay: float = 0.003
    dropout: float | None = None
    epsilon: float = 1e-8
    """Adam's epsilon for colours, added to the denominator. It is large, about 1/100 of the gradient of a
    wrong pixel, so that vertices that views hardly reach, at their borders, take small steps."""
    exposure_rate: float = 0.01
    max_splats: Annotated[int | None, Range(1, 10**7)] = None
    """Largest number of fans. Default: 100,000; of large sets of unmasked photographs up to 200,000, one for
    every 500 pixels, but not with ``as_splats``."""
    start_splats: Annotated[int | None, Range(1, 10**7)] = None
    """About the number of fans at the start, at most max_splats, which is the default. For masked
    photographs it is 40 % of it: growth puts the others where they are needed."""
    sh_degree: Annotated[int, Range(0, 3)] = 2
    """Degree of the spherical harmonics by which the colour of a fan depends on the view. 0: it does not."""
    sides: Annotated[int, Range(3, 16)] = 6
    """Triangles of a fan."""
    shape_decay: Annotated[float, Range(0, 1), Advanced] = 0.5
    """Share of its distance to a flat ellipse that each vertex loses in a step. It falls as the colour
    learning rate does. Six corners that move freely show each photograph what it alone has; held-out ones
    lose. 0: they move freely."""
    growth_events: Annotated[int, Range(0, 1000), Advanced] = 6
    """Number of densification steps, in which fans are split and pruned. 0: none."""
    growth_end: Annotated[float, Range(0, 1), Advanced] = 0.5
    """Share of the run after which densification ends (3DGS: densify_until_iter)."""
    quarter_share: Annotated[float, Range(0, 1), Advanced] = 0.1
    """Share of the run, from its start, with images at 1/4 of the resolution (coarse to fine)."""
    half_share: Annotated[float, Range(0, 1), Advanced] = 0.6
    """Share of the run until which images have 1/2 of the resolution; afterwards, all of it."""
    background: BackgroundMode = "mixed"
    """Background of the images. random: a new colour in every step, which masked photographs show around the
    subject, and others where nothing covers it. mixed: random in every fourth step, otherwise that of the
    data set."""

    def first_splats(self, masked: bool) -> int:
        """About the number of fans at the start, from ``masked`` photographs or others."""
        default = round(MASKED_SHARE * self.most_splats) if masked else self.most_splats
        return min(self.start_splats or max(default, 1), self.most_splats)

    @property
    def most_splats(self) -> int:
        """Largest number of fans: ``max_splats``, or the usual one where ``for_pixels`` was not asked."""
        return USUAL_SPLATS if self.max_splats is None else self.max_splats

    def for_pixels(self, count: int) -> TrainConfig:
        """The configuration with a ``max_splats`` for training views of so many pixels without masks."""
        if self.max_splats is not None:
            return self
        return replace(self, max_splats=min(max(count // PIXELS_PER_SPLAT, USUAL_SPLATS), MOST_SPLATS))


def train_config(**changes: Any) -> TrainConfig:
    """The default configuration of ``train`` with ``changes``; a length that is given takes the place of its
    own.

    Raises ValueError for values out of range, TypeError for a name that does not exist.
    """
    return with_train_changes(TrainConfig(), **changes)


def with_train_changes(config: TrainConfig, **changes: Any) -> TrainConfig:
    """``config`` with ``changes``, as in ``train_config``."""
    check_names("training", changes, [f.name for f in fields(TrainConfig) if f.name != "preset"])
    if any(changes.get(name) is not None for name in LENGTHS):
        changes = {**dict.fromkeys(LENGTHS), **changes}
    return replace(config, **changes)
