"""When a training does what: the size of its images, and how many fans there may be."""

from __future__ import annotations

from meshsplats.training.config import TrainConfig


def image_factor(config: TrainConfig, fraction: float) -> float:
    """Size of the images relative to the photographs, after ``fraction`` of the run."""
    if fraction < config.quarter_share:
        return 0.25
    return 0.5 if fraction < config.half_share else 1.0


def events_passed(config: TrainConfig, fraction: float) -> int:
    """Number of growth events up to ``fraction`` of the run. They are evenly spread over its first
    ``growth_end``, and the last lies at that end."""
    if not config.growth_events or not config.growth_end:
        return 0
    # Rounding must not move an event from one step to the next.
    return min(int(config.growth_events * fraction / config.growth_end + 1e-9), config.growth_events)


def budget(config: TrainConfig, event: int, first: int) -> int:
    """Largest number of fans after growth event ``event`` (from 1) of a run that began with ``first``: each
    event multiplies it by the same factor, up to ``most_splats``."""
    share = event / config.growth_events
    return min(round(first * (config.most_splats / first) ** share), config.most_splats)
