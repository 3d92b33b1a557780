"""JSON from strangers: its numbers and the names in it."""

from __future__ import annotations

import json
import math

import pytest
from _local import linux_names

from meshsplats._common.json_files import can_be_named, parse_json
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.level_tables import load_table, table_in_words

LEVEL = {"file": "a.npz", "splats": 1, "triangles": 8, "bytes": 9, "screen_size": 800, "views": 3}
LEVEL |= {"psnr": 30, "seconds": 1.5}


@pytest.mark.parametrize("digits", [310, 5000])
def test_numbers_that_no_float_can_hold_are_infinite(digits):
    text = b"[%s, -%s, 12, 1e3]" % (b"9" * digits, b"9" * digits)
    assert parse_json(text, 1 << 20, "a.json") == [math.inf, -math.inf, 12, 1000]
    assert isinstance(parse_json(b"9" * 308, 1 << 20, "a.json"), int)


def test_tables_of_levels_with_absurd_numbers(tmp_path):
    path = tmp_path / "levels.json"
    table = {"splats": 1, "look": "area", "samples": 1, "levels": [LEVEL | {"psnr": 10**400}]}
    path.write_text(json.dumps(table))
    assert " inf " in table_in_words(load_table(path))[1]
    path.write_text(json.dumps(table | {"levels": [LEVEL | {"bytes": 10**400}]}))
    with pytest.raises(FileFormatError, match="not the table of levels of detail"):
        load_table(path)


@linux_names
def test_names_that_files_can_have(tmp_path):
    for name in ("a", "a/b c.png", "\u00e9" * 100, "..", "."):
        assert can_be_named(tmp_path / name)
    for name in ("a\0", "\ud800", "a" * 300):
        assert not can_be_named(tmp_path / name)
