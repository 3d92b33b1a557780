"""Options as their fields declare them; docs/options.md."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import pytest
from _local import script

from meshsplats._common.options import (
    Advanced,
    Fixed,
    Range,
    With,
    changed,
    check_options,
    docstrings,
    reachable,
    settings,
)
from meshsplats.blender.options import LightOptions, SceneOptions
from meshsplats.conversion.cleaning_rules import CleaningRules
from meshsplats.conversion.options import ConversionOptions
from meshsplats.errors import OptionValueError
from meshsplats.finetuning import FinetuneConfig, RunOptions
from meshsplats.tiles.building import TileOptions
from meshsplats.training.config import TrainConfig

ROOT = Path(__file__).parents[2]
DOCUMENTED = [
    *(ConversionOptions, FinetuneConfig, TrainConfig),
    *(RunOptions, TileOptions, CleaningRules, LightOptions, SceneOptions),
]


@dataclass(frozen=True)
class Baking:
    heat: Annotated[float, Range(50, 250)] = 180.0
    """Temperature of the oven,
    degrees Celsius."""
    minutes: Annotated[int | None, Range(1, 1000), Advanced] = None
    mode: Literal["fan", "grill", "steam"] = "fan"
    loaves: Annotated[int, Range(1, math.inf)] = 1
    glaze: bool = False
    coats: Annotated[int, Range(1, 5), With("glaze")] = 1
    """Layers of egg."""
    water: Annotated[float, Range(0, 2), With(mode="steam")] = 0.5

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True)
class Toasting(Baking):
    mode: Annotated[Literal["fan", "grill", "steam"], Fixed("for toast: bake the rest")] = "grill"
    heat: float = 220.0
    minutes: Annotated[int | None, Range(1, 10)] = None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heat": 300}, "heat must be a number from 50 to 250, got 300"),
        ({"heat": float("nan")}, "heat must be a number from 50 to 250, got nan"),
        ({"heat": True}, "heat must be a number from 50 to 250, got True"),
        ({"heat": None}, "heat must be a number from 50 to 250, got None"),
        ({"heat": "hot"}, "heat must be a number from 50 to 250, got 'hot'"),
        ({"minutes": 1.5}, "minutes must be a whole number from 1 to 1000, got 1.5"),
        ({"loaves": float("inf")}, "loaves must be a whole number of at least 1, got inf"),
        ({"mode": "boil"}, "mode must be one of fan, grill, steam, got 'boil'"),
        ({"glaze": 1}, "glaze must be True or False, got 1"),
        ({"coats": 2}, "coats has no effect without glaze"),
        ({"water": 1}, "water has no effect without mode 'steam', got mode 'fan'"),
    ],
)
def test_values_are_checked_by_what_the_field_declares(changes, message):
    with pytest.raises(ValueError, match=re.escape(message) + "$"):
        Baking(**changes)


def test_limits_are_written_as_people_write_them():
    assert str(Range(1, 2**31 - 1)) == "from 1 to 2147483647"
    assert str(Range(1e-5, 1e9)) == "from 1e-05 to 1e+09"
    assert str(Range(10**7 + 1, math.inf)) == "of at least 10000001"


def test_errors_name_the_option_for_programs_that_show_it_in_their_own_way():
    for changes, name in (({"heat": 300}, "heat"), ({"glaze": 1}, "glaze"), ({"coats": 2}, "coats")):
        with pytest.raises(OptionValueError) as caught:
            Baking(**changes)
        assert caught.value.spelled("--{}".format).startswith(f"--{name} ")


def test_values_that_a_field_allows():
    Baking(heat=50, minutes=None, coats=1, water=0.5)
    Baking(minutes=20, glaze=True, coats=5)
    Baking(mode="steam", water=0)


def test_a_field_that_is_declared_again_keeps_its_range_or_has_another():
    with pytest.raises(ValueError, match="minutes must be a whole number from 1 to 10, got 20"):
        Toasting(minutes=20)
    assert settings(Toasting)["minutes"].advanced
    with pytest.raises(ValueError, match="heat must be a number from 50 to 250"):
        Toasting(heat=900)
    assert settings(Toasting)["heat"].default == 220
    assert settings(Toasting)["heat"].help == "Temperature of the oven, degrees Celsius."


def test_a_fixed_option_and_those_that_need_another_value_of_it_cannot_be_changed():
    with pytest.raises(ValueError, match="mode must be 'grill' for toast: bake the rest"):
        Toasting(mode="steam")
    assert set(reachable(Toasting)) == {"heat", "minutes", "loaves", "glaze", "coats"}
    assert set(reachable(Baking)) == {field.name for field in fields(Baking)}


def test_what_few_people_set_is_marked():
    assert [name for name, setting in settings(Baking).items() if setting.advanced] == ["minutes"]


def test_the_help_is_the_docstring_and_what_the_option_needs():
    assert settings(Baking)["coats"].text == "Layers of egg. Only with ``glaze``."
    assert docstrings(Baking)["heat"] == "Temperature of the oven, degrees Celsius."


@pytest.mark.parametrize("kind", DOCUMENTED, ids=lambda kind: kind.__name__)
def test_every_option_has_help(kind):
    assert [name for name, setting in settings(kind).items() if not setting.help] == []


@pytest.mark.parametrize("kind", DOCUMENTED, ids=lambda kind: kind.__name__)
def test_every_number_has_a_range(kind):
    numbers = [s for s in settings(kind).values() if {int, float} & set(s.kinds)]
    assert [setting.name for setting in numbers if setting.mark(Range) is None] == []


@pytest.mark.parametrize("kind", [FinetuneConfig, TrainConfig], ids=lambda kind: kind.__name__)
def test_values_beyond_every_range_are_refused(kind):
    for name in reachable(kind):
        limits = settings(kind)[name].mark(Range)
        for value in () if limits is None else (limits.low - 1, limits.high * 2):
            with pytest.raises(ValueError, match=f"{name} must be a"):
                replace(kind(), **{name: value})


def test_the_page_of_options_is_that_of_the_source():
    pytest.importorskip("tyro")
    module = script("tools/options_page.py")
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), "run tools/options_page.py"


def test_every_option_without_a_flag_is_on_the_page():
    """As ``sh_degree`` of surfaces, which is another than that of the training."""
    pytest.importorskip("tyro")
    module = script("tools/options_page.py")
    text = module.page()
    for command in module.COMMANDS:
        kind = module._command(command)
        for name, option in module.options_of(kind).items():
            if not option.has_flag:
                help_text = module._setting(kind, option.path).help
                assert f"| `{name}` |" in text, command
                assert module._plain(help_text) in text, (command, name)


def test_the_page_names_defaults_in_words():
    """Who types ``--set dropout=None`` is refused."""
    pytest.importorskip("tyro")
    rows = [row for row in script("tools/options_page.py").page().splitlines() if row.startswith("|")]
    assert [row for row in rows if re.search(r"\bNone\b|Dataset\.", row)] == []


def test_options_that_differ_from_their_defaults_are_changed():
    assert changed(Baking()) == []
    assert changed(Baking(heat=200, glaze=True, loaves=1)) == ["heat", "glaze"]
    assert changed(Toasting()) == []
