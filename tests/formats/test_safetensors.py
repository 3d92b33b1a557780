"""Safetensors files: round trips, the library by others as reader and writer, and broken files."""

from __future__ import annotations

import json

import numpy as np
import pytest

from meshsplats.errors import FileFormatError
from meshsplats.formats.safetensors import load_safetensors, save_safetensors

TYPES = ["f8", "f4", "f2", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "?"]


def arrays() -> dict[str, np.ndarray]:
    """Of every type, of no, one and more directions, empty ones among them."""
    random = np.random.default_rng(0)
    found = {kind: random.integers(0, 2, (2, 3)).astype(kind) for kind in TYPES}
    return found | {
        "number": np.array(1 / 3),
        "none": np.zeros((0, 3), np.float32),
        "turned": random.random((4, 5)).T,
        "big end": random.random(3).astype(">f4"),
    }


def agree(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> bool:
    return found.keys() == expected.keys() and all(
        np.array_equal(found[name], array) and found[name].dtype == array.dtype.newbyteorder("=")
        for name, array in expected.items()
    )


def written(path, header: object, data: bytes = b"") -> None:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def test_what_is_saved_comes_back(tmp_path):
    path = tmp_path / "a.safetensors"
    save_safetensors(path, arrays(), {"about": "grün"})
    found, texts = load_safetensors(path)
    assert agree(found, arrays())
    assert texts == {"about": "grün"}
    assert load_safetensors(path, only_texts=True) == ({}, texts)
    assert int.from_bytes(path.read_bytes()[:8], "little") % 8 == 0  # arrays are aligned
    assert all(array.flags.writeable for array in found.values())
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]
    save_safetensors(path, {}, {})
    assert load_safetensors(path) == ({}, {})


def test_the_library_reads_and_writes_the_same(tmp_path):
    numpy = pytest.importorskip("safetensors.numpy", reason="the library by others")
    from safetensors import safe_open

    ours, theirs = tmp_path / "ours.safetensors", tmp_path / "theirs.safetensors"
    save_safetensors(ours, arrays(), {"about": "grün"})
    assert agree(numpy.load_file(ours), arrays())
    with safe_open(ours, framework="numpy") as file:
        assert file.metadata() == {"about": "grün"}
    plain = {name: np.ascontiguousarray(a.astype(a.dtype.newbyteorder("="))) for name, a in arrays().items()}
    plain["number"] = arrays()["number"]
    numpy.save_file(plain, theirs, metadata={"a": "b"})
    assert agree(load_safetensors(theirs)[0], arrays())
    assert load_safetensors(theirs)[1] == {"a": "b"}


def test_bfloat16_comes_as_float32(tmp_path):
    header = {"x": {"dtype": "BF16", "shape": [3], "data_offsets": [0, 6]}}
    written(tmp_path / "b.safetensors", header, bytes.fromhex("803f00c04140"))
    found = load_safetensors(tmp_path / "b.safetensors")[0]["x"]
    assert (found.dtype, found.tolist()) == (np.float32, [1, -2, 3.015625])


def entry(**changes: object) -> dict:
    return {"x": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]} | changes}


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (b"{", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"[]", "no JSON object"),
        ({"__metadata__": {"a": 1}}, "must hold texts"),
        ({"x": 3}, "needs a shape"),
        (entry(shape=[-2]), "needs a shape"),
        (entry(shape=[True, 2]), "needs a shape"),
        (entry(shape=[1] * 33), "needs a shape"),
        (entry(data_offsets=[0]), "needs a shape"),
        (entry(data_offsets=[8, 0]), "in bytes 8 to 0 of 8"),
        (entry(data_offsets=[0, 16], shape=[4]), "in bytes 0 to 16 of 8"),
        (entry(shape=[2**40, 2**40]), "of shape"),
        (entry(shape=[0, 2**61, 2**61], data_offsets=[0, 0]) | {"y": entry()["x"]}, "has the shape"),
        (entry(dtype="F8_E4M3"), "unknown type F8_E4M3"),
        (entry(dtype=["F32"]), "unknown type"),
        (entry() | {"y": entry()["x"]}, "fill 16 of 8 bytes"),
        (entry(shape=[1], data_offsets=[0, 4]), "fill 4 of 8 bytes"),
    ],
)
def test_broken_headers_are_refused(tmp_path, header, message):
    path = tmp_path / "x.safetensors"
    written(path, header, bytes(8))
    with pytest.raises(FileFormatError, match=message):
        load_safetensors(path)


def test_a_file_cut_short_is_refused(tmp_path):
    path = tmp_path / "x.safetensors"
    save_safetensors(path, arrays(), {})
    whole = path.read_bytes()
    for cut in (0, 7, 8, 100, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileFormatError, match="not a safetensors file"):
            load_safetensors(path)
    for length in (1 << 60, len(whole) - 7):
        path.write_bytes(length.to_bytes(8, "little") + whole[8:])
        with pytest.raises(FileFormatError, match="do not hold its header"):
            load_safetensors(path)


def test_types_that_the_format_lacks_are_refused_before_anything_is_written(tmp_path):
    for array in (np.array([1 + 2j]), np.array(["text"]), np.array([None])):
        with pytest.raises(TypeError, match="cannot hold an array 'x' of type"):
            save_safetensors(tmp_path / "x.safetensors", {"x": array}, {})
    assert list(tmp_path.iterdir()) == []
