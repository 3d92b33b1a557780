"""Checks that dataclasses of options share: ranges, choices, names."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping

Range = tuple[str, float, float, bool]
"""Name of an option, its least and greatest value, and whether it must be a whole number."""


def check_ranges(
    options: object,
    ranges: Iterable[Range],
    *,
    types: tuple[type, ...] = (int, float),
    optional: Collection[str] | None = None,
) -> None:
    """Checks the numbers among ``options``.

    Args:
        options: an object with one attribute for each name in ``ranges``.
        ranges: the limits, both included.
        types: accepted types; bool is never a number.
        optional: names whose value may be None; None: all of them.

    Raises:
        ValueError: a value that is no number, out of range, or not whole where it must be.
    """
    for name, low, high, whole in ranges:
        value = getattr(options, name)
        if value is None and (optional is None or name in optional):
            continue
        number = isinstance(value, types) and not isinstance(value, bool)
        if not number or not low <= value <= high or (whole and int(value) != value):
            what = "a whole number" if whole else "a number"
            raise ValueError(f"{name} must be {what} from {low:g} to {high:g}, got {value!r}")


def check_choices(options: object, choices: Mapping[str, Collection[str]]) -> None:
    """ValueError unless each option that ``choices`` names has one of the values listed there."""
    for name, known in choices.items():
        value = getattr(options, name)
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


def check_flags(options: object, names: Iterable[str]) -> None:
    """ValueError unless the options ``names`` are True or False."""
    for name in names:
        value = getattr(options, name)
        if not isinstance(value, bool):
            raise ValueError(f"{name} must be True or False, got {value!r}")


def did_you_mean(name: str, known: Collection[str]) -> str:
    """A question for messages with the closest of the ``known`` names to ``name``; empty if none is close."""
    close = difflib.get_close_matches(name, known, 1)
    return f"did you mean {close[0]!r}?" if close else ""


def check_names(owner: str, given: Iterable[str], known: Collection[str]) -> None:
    """TypeError for the first of the ``given`` names that is not ``known``, with the closest one that is.

    Args:
        owner: name of the owner of the options, for the message.
    """
    for name in given:
        if name not in known:
            hint = did_you_mean(name, known) or f"options: {', '.join(known)}"
            raise TypeError(f"{owner} has no option {name!r}; {hint}")
