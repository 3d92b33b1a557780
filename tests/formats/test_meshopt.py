"""The codec of compressed .glb files: what goes in comes out, here and in the decoders of its makers."""

from __future__ import annotations

import json
import os
import subprocess

import numpy as np
import pytest

from meshsplats.formats.gltf.meshopt import (
    block_of,
    decoded_attributes,
    decoded_triangles,
    encoded_attributes,
    encoded_triangles,
)

FAN = np.array([(0, i, i % 8 + 1) for i in range(1, 9)])
FANS = np.concatenate([FAN + 9 * k for k in range(50)])


def elements(kind, n, stride):
    rng = np.random.default_rng(n + stride)
    if kind == "slow":
        return np.cumsum(rng.integers(-2, 3, (n, stride)), axis=0).astype(np.uint8)
    if kind == "wide":  # too wide for two bits, some for four
        return np.cumsum(rng.integers(-7, 9, (n, stride)), axis=0).astype(np.uint8)
    values = rng.integers(0, 256, (n, stride)).astype(np.uint8)
    return np.repeat(values[: n // 9 + 1], 9, axis=0)[:n] if kind == "fans" else values


def faces(kind):
    rng = np.random.default_rng(1)
    return {
        "fans": FANS,
        "one": np.array([[0, 1, 2]]),
        "long fan": np.array([(0, i, i + 1) for i in range(1, 2000)]),
        "soup": np.arange(30).reshape(-1, 3),
        "backwards": np.array([[2, 1, 0], [5, 4, 3], [0, 3, 5]]),
        "old first": np.array([[0, 1, 2], [2, 3, 4], [4, 5, 0]]),
        "mixed": FANS[rng.permutation(len(FANS))],
        "random": rng.integers(0, 40, (300, 3)),
        "far": rng.permutation(300).reshape(-1, 3) * 70_000,
        "largest": np.array([[2**31 - 1, 0, 2**31 - 2]]),
    }[kind]


KINDS = ["fans", "one", "long fan", "soup", "backwards", "old first", "mixed", "random", "far", "largest"]
SHAPES = [
    (1, 4),
    (16, 4),
    (17, 8),
    (255, 12),
    (256, 16),
    (257, 36),
    (300, 252),
    (40, 256),
    (3000, 8),
    (20_000, 4),
]


def turned(triangles):
    """Each from its least corner on, which a file may turn."""
    first = triangles.argmin(axis=1)
    return np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)


@pytest.mark.parametrize("kind", ["slow", "wide", "fans", "noise"])
@pytest.mark.parametrize(("n", "stride"), SHAPES)
def test_attributes_come_back(kind, n, stride):
    values = elements(kind, n, stride)
    np.testing.assert_array_equal(decoded_attributes(encoded_attributes(values), n, stride), values)


@pytest.mark.parametrize("kind", KINDS)
def test_triangles_come_back(kind):
    wanted = faces(kind)
    got = decoded_triangles(encoded_triangles(wanted), wanted.size).reshape(-1, 3)
    np.testing.assert_array_equal(turned(got), turned(wanted))


def test_what_is_compressed_is_small():
    """Fans: a byte for each triangle. The colours of fans: two bits for a byte that is that of the vertex
    before, and whole bytes for one in nine."""
    assert len(encoded_triangles(FANS)) == 1 + len(FANS) + 16
    values = elements("fans", 2304, 4)
    assert len(encoded_attributes(values)) < values.nbytes / 2
    still = np.zeros((4096, 4), np.uint8)
    blocks = len(still) // block_of(4)
    assert len(encoded_attributes(still)) == 1 + blocks * 4 * (block_of(4) // 64) + 32


def test_by_hand():
    """17 elements of four bytes, of which the first one counts up, and then jumps."""
    values = np.zeros((17, 4), np.uint8)
    values[:, 0] = [*range(16), 100]
    # Differences 0, 1, 1, ... are 0, 2, 2, ... without a sign, in two bits; 85 is 170, in the second group,
    # where it is 3 in two bits and follows behind.
    packed = [0b00101010, 0b10101010, 0b10101010, 0b10101010]
    byte = [0b0101, *packed, 0b11000000, 0, 0, 0, 170]
    wanted = bytes([0xA0, *byte, 0, 0, 0, *([0] * 28), 0, 0, 0, 0])
    assert encoded_attributes(values) == wanted
    assert encoded_triangles(FAN[:3]) == bytes([0xE1, 0xF0, 0x00, 0x00, *([0] * 16)])


@pytest.mark.parametrize(
    ("decode", "data", "size"),
    [
        (lambda data, n: decoded_attributes(data, n, 8), encoded_attributes(elements("wide", 300, 8)), 300),
        (decoded_triangles, encoded_triangles(faces("mixed")), 1200),
    ],
)
def test_broken_data_are_refused(decode, data, size):
    rng = np.random.default_rng(0)
    for length in range(0, len(data), 7):
        with pytest.raises((ValueError, IndexError)):
            decode(data[:length], size)
    for count in (size + 64 * 3, 3 * 10**12):
        with pytest.raises((ValueError, IndexError)):
            decode(data, count)
    for _ in range(100):  # values may change, nothing else may happen
        spoilt = bytearray(data)
        spoilt[rng.integers(len(data))] = rng.integers(256)
        try:
            decode(bytes(spoilt), size)
        except (ValueError, IndexError):
            continue


SCRIPT = """
import fs from "fs";
import {MeshoptDecoder} from "meshoptimizer";
await MeshoptDecoder.ready;
for (const [mode, count, size, name] of JSON.parse(fs.readFileSync("list.json"))) {
  const target = new Uint8Array(count * size);
  MeshoptDecoder.decodeGltfBuffer(target, count, size, new Uint8Array(fs.readFileSync(name)), mode, "NONE");
  fs.writeFileSync(name + ".out", target);
}
"""


def test_the_decoder_of_the_makers(tmp_path, node_package):
    folder = node_package("meshoptimizer")
    os.symlink(folder / "node_modules", tmp_path / "node_modules")
    listed, wanted = [], []
    for n, stride in SHAPES:
        for kind in ("slow", "wide", "fans", "noise"):
            values = elements(kind, n, stride)
            listed.append(["ATTRIBUTES", n, stride, f"{len(listed)}.bin"])
            (tmp_path / listed[-1][3]).write_bytes(encoded_attributes(values))
            wanted.append(values)
    for kind in KINDS:
        triangles = faces(kind)
        listed.append(["TRIANGLES", triangles.size, 4, f"{len(listed)}.bin"])
        (tmp_path / listed[-1][3]).write_bytes(encoded_triangles(triangles))
        wanted.append(triangles)
    (tmp_path / "list.json").write_text(json.dumps(listed))
    (tmp_path / "run.mjs").write_text(SCRIPT)
    subprocess.run(["node", "run.mjs"], cwd=tmp_path, check=True, capture_output=True, timeout=60)
    for (mode, *_, name), values in zip(listed, wanted, strict=True):
        found = (tmp_path / f"{name}.out").read_bytes()
        if mode == "ATTRIBUTES":
            assert found == values.tobytes()
        else:
            got = np.frombuffer(found, "<u4").reshape(-1, 3).astype(np.int64)
            np.testing.assert_array_equal(turned(got), turned(values))
