"""Values of options, from the text of --set and from configuration files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from meshsplats._common.option_values import converted, from_text, relative_to, resolve, short

KINDS = [
    ("3", int | None, 3),
    ("0.5", float | None, 0.5),
    ("3", float, 3.0),
    ("true", bool | None, True),
    ("grey", Literal["grey", "red"] | None, "grey"),
    ("4", Literal[3, 4], 4),
    ("auto", int | Literal["auto"] | None, "auto"),
    ("8", int | Literal["auto"] | None, 8),
    ("1,2,3", tuple[float, float, float], (1.0, 2.0, 3.0)),
    ("a,b", tuple[str, ...], ("a", "b")),
]


@pytest.mark.parametrize(("text", "kind", "value"), KINDS)
def test_a_text_becomes_the_value_that_a_file_would_have(text, kind, value):
    found = converted(from_text(text, kind), kind, Path())
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("value", "kind", "message"),
    [
        ("x", int, "a whole number"),
        (True, int, "a whole number"),
        (1 << 64, int, "a whole number"),
        ("x", Literal["a", "b"], "one of a, b"),
        ([1, 2], tuple[float, float, float], "a list of 3 values"),
        (["a"], tuple[float, ...], "a list, each a number"),
        (3, int | None, None),
        ("a\0b", str, "text"),
    ],
)
def test_a_value_of_the_wrong_kind_says_what_it_must_be(value, kind, message):
    if message is None:
        assert converted(value, kind, Path()) == value
        return
    with pytest.raises(TypeError, match=message):
        converted(value, kind, Path())


def test_paths_in_a_file_are_seen_from_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path("runs")
    folder.mkdir()
    for path in (Path("scene.ply"), Path("runs/mesh.glb"), Path("other/../scene.ply")):
        there = relative_to(path, folder)
        assert resolve(there, folder).resolve() == path.resolve()
        assert not Path(there).is_absolute()
    assert relative_to(tmp_path / "a.ply", folder) == str(tmp_path / "a.ply")


def test_values_are_short_in_messages():
    assert short("x" * 100).endswith("...")
    assert len(short("x" * 100)) == 60
    assert (short({}), short([1, 2]), short(1 << 70)) == ("a table", "a list of 2", "more than 64 bits")
