"""What long work shows where stderr is no terminal: phases, and from time to time how far they are."""

from __future__ import annotations

import pytest

from meshsplats._common import words
from meshsplats._common.words import Phase, duration
from meshsplats.cli import progress
from meshsplats.cli.progress import progress_display


class Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    for module in (words, progress):
        monkeypatch.setattr(module, "time", found)
    return found


@pytest.mark.parametrize(
    ("seconds", "words"), [(0, "5 s"), (88, "90 s"), (91, "2 min"), (5369, "89 min"), (7200, "2.0 h")]
)
def test_durations(seconds, words):
    assert duration(seconds) == words


def test_the_time_left_of_a_phase_is_that_of_its_share(clock):
    phase = Phase()
    assert phase.begins("images")
    assert not phase.begins("images")
    clock.now += 2
    assert phase.left(0.1) == ""  # too soon
    clock.now += 28
    assert phase.left(0) == ""
    assert phase.left(0.5) == "30 s left"
    assert phase.begins("fit")
    assert phase.left(0.25) == ""


def test_lines_tell_how_far_a_long_phase_is(clock, capsys):
    with progress_display() as show:
        show.phase("images")
        for step in range(1, 10):
            clock.now += 5
            show.phase("images", step / 10)
        show.phase("fit", 0.0)
        clock.now += 4
        show.phase("fit", 0.5)  # the line before is not old
    assert capsys.readouterr().err.splitlines() == [
        "meshsplats: images",
        "meshsplats: images: 40%, 30 s left",
        "meshsplats: images: 80%, 10 s left",
        "meshsplats: fit",
    ]
