"""What a run has time for: by hand, and its record."""

from __future__ import annotations

import pytest

from meshsplats import FileFormatError, make_config, splat_dataset
from meshsplats._core import library
from meshsplats.conversion import ConversionOptions
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning.pace import (
    BRIEF_RATES,
    FEWEST_SPLATS,
    RECORD,
    Pace,
    StartRecord,
    is_brief,
    measure_pace,
    most_splats,
    of_brief_run,
    worthwhile_steps,
)

PACE = Pace(target=0.1, step=1e-6, merging=1e-5)
"""A million splats take 1.1 s a step, and 10 s to merge."""


def test_steps_of_a_pace():
    assert PACE.steps(10**6, 110) == pytest.approx(100)
    assert PACE.steps(10**6, 0.5) == 1


def test_splats_for_which_there_is_time():
    assert PACE.splats(10**6, 100, 110) == 10**6
    # 100 s less 10 s for merging and 10 s for targets: 0.8 s a step.
    assert PACE.splats(10**6, 100, 100) == 800_000
    # Merging to more than nine tenths is not worth it.
    assert PACE.splats(10**6, 100, 109.5) == 895_000
    assert PACE.splats(10**6, 100, 110 - 1e-6) == 899_999
    assert Pace(0.1, 1e-6, 1e-7).splats(10**6, 100, 109) == 10**6
    assert PACE.splats(10**6, 100, 10) == FEWEST_SPLATS
    assert PACE.splats(1000, 100, 0) == 1000


def test_steps_of_opaque_runs():
    assert worthwhile_steps(make_config(minutes=1, opacity="cutoff")) == 150
    assert worthwhile_steps(make_config(minutes=20, opacity="cutoff")) == 600


def test_memory_limits_splats():
    assert most_splats(None) is None
    assert most_splats(4 * 10**9) == 10**6
    assert most_splats(1) == FEWEST_SPLATS


def test_brief_runs():
    """Dense clouds need 150 steps for each splat a pixel; other runs are brief only by the clock."""
    assert is_brief(320_000, 160_000, 299, timed=False)
    assert not is_brief(320_000, 160_000, 300, timed=False)
    assert is_brief(10_000, 160_000, 99, timed=True)
    assert not is_brief(10_000, 160_000, 100, timed=True)
    assert not is_brief(10_000, 160_000, 5, timed=False)


def test_rates_of_brief_runs():
    config = make_config(minutes=1)
    assert of_brief_run(config, 500, ()).position_rate == BRIEF_RATES["position_rate"] < config.position_rate
    assert of_brief_run(config, 10, ()).color_rate == pytest.approx(BRIEF_RATES["color_rate"] / 10)
    own = of_brief_run(make_config(minutes=1, color_rate=0.5), 10, {"color_rate"})
    assert (own.color_rate, own.minutes) == (0.5, 1)


def test_a_pace_is_measured():
    cloud = make_scene(300)
    data = splat_dataset(cloud, train=2, test=1, width=32)
    for config in make_config(minutes=1), make_config(minutes=1, opacity="cutoff"):
        pace = measure_pace(cloud, data, config, ConversionOptions(), threads=1)
        assert pace.target > 0
        assert pace.step > 0
        assert pace.merging > 0


def test_measuring_leaves_other_processors_alone(monkeypatch):
    cloud = make_scene(300)
    data = splat_dataset(cloud, train=2, test=1, width=32, threads=1)
    monkeypatch.setattr(library, "_quota", lambda: pytest.fail("all processors are asked for"))
    for config in make_config(minutes=1), make_config(minutes=1, order="file"):
        measure_pace(cloud, data, config, ConversionOptions(), threads=1)


@pytest.mark.parametrize("record", [StartRecord(), StartRecord(2000, 7), StartRecord(brief_steps=12)])
def test_the_record_of_a_start(tmp_path, record):
    record.save(tmp_path)
    assert StartRecord.load(tmp_path) == record


def test_runs_without_a_record_began_whole(tmp_path):
    assert StartRecord.load(tmp_path) == StartRecord()


@pytest.mark.parametrize(
    "text",
    ['{"max_splats": -3}', '{"images": 2.5}', '{"brief_steps": true}', "[1, 2, 3]", "{", '{"images": 0}'],
)
def test_a_broken_record_is_refused(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(FileFormatError, match=r"start\.json"):
        StartRecord.load(tmp_path)
