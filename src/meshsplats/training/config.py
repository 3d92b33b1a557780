"""The configuration of a training: that of the fine-tuning, and how the set of fans grows."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from meshsplats._options import Range, check_names, check_ranges
from meshsplats.finetuning.config import LENGTHS, BackgroundMode, FinetuneConfig


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
    l2_weight: float = 10.0
    prune_epochs: float = 0.0
    opacity_decay: float = 0.003
    epsilon: float = 1e-8
    """Adam's epsilon for colours, added to the denominator. It is about a hundredth of the gradient of a
    pixel that has an error: what views hardly reach, at their borders, does not take whole steps."""
    exposure_rate: float = 0.01
    max_splats: int = 100_000
    """Largest number of fans."""
    start_splats: int = 40_000
    """About the number of fans at the start, at most max_splats."""
    sides: int = 6
    """Triangles of a fan, 3 to 16."""
    shape_decay: float = 0.5
    """Share of its distance to a flat ellipse that each vertex loses in a step. It falls as the colour
    learning rate does. Six corners that move freely show each photograph what it alone has; held-out ones
    lose. 0: they move freely."""
    growth_events: int = 6
    """Number of times that fans are halved and dropped. 0: their set stays as it is."""
    growth_end: float = 0.5
    """Share of the run at the last of these times."""
    quarter_share: float = 0.1
    """First share of the run, in which images have a quarter of the photographs' sides."""
    half_share: float = 0.6
    """Share of the run until which they have half of them; then they have all."""
    background: BackgroundMode = "mixed"
    """Background of the images. random: a new colour in every step, which masked photographs show around the
    subject, and others where nothing covers it. mixed: random in every fourth step, otherwise that of the
    data set."""

    def __post_init__(self) -> None:
        for name, only in FIXED.items():
            if getattr(self, name) != only:
                raise ValueError(f"{name} must be {only!r} while the set of fans grows; finetune has it")
        if self.blending == "linear":
            raise ValueError("blending 'linear' is not for training: fine-tune the result with it")
        super().__post_init__()
        check_ranges(self, _RANGES)


_RANGES: list[Range] = [
    ("max_splats", 1, 10**7, True),
    ("start_splats", 1, 10**7, True),
    ("sides", 3, 16, True),
    ("shape_decay", 0, 1, False),
    ("growth_events", 0, 1000, True),
    ("growth_end", 0, 1, False),
    ("quarter_share", 0, 1, False),
    ("half_share", 0, 1, False),
]

FIXED: dict[str, Any] = {
    "opacity": "blended",
    "prune_epochs": 0.0,
    **{name: getattr(FinetuneConfig, name) for name in ("prune_opacity", "point_share")},
}
"""Options of fine-tuning that change its set of triangles, those that belong to them, and one for rendered
images."""


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
