"""What is done for an artist in passing, for the operator that runs to report."""

from __future__ import annotations

_notes: list[str] = []


def add(text: str) -> None:
    """One line, without a full stop. Told once, in scripts that call no operator not at all."""
    if text not in _notes:
        _notes.append(text)


def take() -> list[str]:
    """The notes since the last call, which are then told."""
    found = _notes.copy()
    _notes.clear()
    return found
