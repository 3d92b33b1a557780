"""Broken, hostile and foreign files give one clear error, at once and in little memory."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from _local import make_link
from _splat_files import Table, random_splats, splat_table, write_ply
from _splats import refused

from meshsplats import FileFormatError, load_gaussians, load_mesh
from meshsplats.formats.sniff import identify

NAMES = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += [f"rot_{i}" for i in range(4)]
FLOATS = "".join(f"property float {name}\n" for name in NAMES)


def header(count="2", encoding="binary_little_endian", properties=FLOATS, before="", after=""):
    text = f"ply\nformat {encoding} 1.0\n{before}element vertex {count}\n{properties}{after}end_header\n"
    return text.encode()


ROWS = np.ones((2, 14), "<f4").tobytes()
ASCII_ROW = b" ".join([b"1"] * 14) + b"\n"
LONG_ROW = ASCII_ROW.replace(b"1", b"1.5")

MALFORMED = {
    "empty": (b"", "the file is empty"),
    "text": (b"Hello, this is a letter.\n" * 20, "not a splat file"),
    "almost ply": (b"plywood and nails\n", "not a splat file"),
    "only the magic": (b"ply\n", "no 'end_header'.*truncated after line 1"),
    "no end of header": (header()[:-12] + ROWS, "no 'end_header'"),
    "endless header": (
        b"ply\nformat ascii 1.0\n" + (b"comment " + b"x" * 1000 + b"\n") * 2000,
        "no 'end_header' line in its first",
    ),
    "header of 2 MB": (
        header(before="comment " + "x" * 2_000_000 + "\n") + ROWS,
        "no 'end_header' line in its first 1048576 bytes",
    ),
    "endless line": (b"ply\n" + b"x" * 3_000_000, "no 'end_header'"),
    "binary after the magic": (b"ply\n" + bytes(range(256)) * 40, "line 2: expected the 'format' line"),
    "no format": (b"ply\nend_header\n", "no 'format' line"),
    "format late": (
        b"ply\nelement vertex 1\nformat ascii 1.0\nend_header\n",
        "line 2: expected the 'format'",
    ),
    "format twice": (b"ply\nformat ascii 1.0\nformat ascii 1.0\nend_header\n", "line 3: a second"),
    "unknown format": (
        header(encoding="binary_middle_endian"),
        "line 2: unknown PLY format 'binary_middle_endian 1.0'",
    ),
    "version 2": (header().replace(b"1.0", b"2.0"), "unknown PLY format 'binary_little_endian 2.0'"),
    "unknown keyword": (header(after="wibble\n"), "line 18: not a PLY header line: 'wibble'"),
    "unknown type": (header(properties="property quad x\n"), "line 4: unknown property type 'quad'"),
    "float list length": (
        header(after="element f 1\nproperty list float int v\n"),
        "must have an integer type",
    ),
    "incomplete property": (header(properties="property float\n"), "line 4: expected 'property TYPE NAME'"),
    "property first": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3: a property before"),
    "property twice": (header(properties=FLOATS + "property float x\n"), "has property 'x' twice"),
    "element twice": (
        header(after="element vertex 2\nproperty float x\n"),
        "element 'vertex' is declared twice",
    ),
    "element without count": (header(after="element face\n"), "expected 'element NAME COUNT'"),
    "negative count": (header(count="-2") + ROWS, "line 3: the count of element 'vertex' .* got '-2'"),
    "fractional count": (header(count="2.0") + ROWS, "got '2.0'"),
    "count with underscore": (header(count="1_0") + ROWS, "got '1_0'"),
    "count of 5000 digits": (header(count="9" * 5000) + ROWS, "whole number"),
    "1e11 splats": (header(count="100000000000") + ROWS, "claims 100,000,000,000 rows of element 'vertex'"),
    "1e11 ASCII splats": (header("100000000000", "ascii") + ASCII_ROW * 2, "claims 100,000,000,000 rows"),
    "1e11 rows of nothing": (header("1e11") + ROWS, "whole number"),
    "1e14 empty rows": (header(count="100000000000000", properties=""), "not splats"),
    "zero splats": (header(count="0"), "no splats, the file declares 0"),
    "truncated": (
        header() + ROWS[:-1],
        "claims 2 rows of element 'vertex', at least 112 bytes, but 111 bytes",
    ),
    "truncated a row": (header() + ROWS[:56], "claims 2 rows"),
    "no data": (header(), "but 0 bytes are left"),
    "count too small": (header("1") + ROWS, "56 bytes follow the last row"),
    "a property too few": (
        header(properties="property float nx\n" + FLOATS) + ROWS + bytes(16),
        "8 bytes follow",
    ),
    "truncated later element": (
        header(after="element e 3\nproperty int a\n") + ROWS + bytes(11),
        "claims 3 rows of element 'e'",
    ),
    "truncated list before": (
        header(before="element face 2\nproperty list uchar int v\n") + b"\x03" + bytes(12) + b"\xff" + ROWS,
        "row 1 of element 'face' at byte [0-9]+ runs past the end",
    ),
    "negative list": (
        header(before="element face 1\nproperty list char int v\n") + b"\xff" + ROWS,
        "row 0 of element 'face'",
    ),
    "huge list": (
        header(before="element face 1\nproperty list uint64 double v\n") + b"\xff" * 8 + ROWS,
        "row 0 of element 'face'",
    ),
    "lists eat the splats": (
        header(before="element face 1\nproperty list uchar uchar v\n") + b"\x28" + ROWS,
        "the file ends after 72 of them",
    ),
    "lists eat what follows": (
        header(before="element f 1\nproperty list uchar uchar v\n", after="element e 9\nproperty int a\n")
        + (b"\x05" + bytes(5) + ROWS + bytes(35)),
        "ends 1 bytes before the end of the elements after 'vertex'",
    ),
    "list in a splat": (
        header(properties=FLOATS + "property list uchar int v\n") + ROWS + bytes(9),
        "list property 'v'",
    ),
    "no vertex element": (
        b"ply\nformat ascii 1.0\nelement point 1\nproperty float x\nend_header\n1\n",
        "no element 'vertex'",
    ),
    "no opacity": (header(properties=FLOATS.replace("opacity", "alpha")) + ROWS, "lacks opacity,"),
    "no scales": (header(properties=FLOATS.replace("scale_", "size_")) + ROWS, "lacks scale_0, scale_1,"),
    "one scale": (
        header(properties=FLOATS.replace("scale_1", "a").replace("scale_2", "b")) + ROWS,
        "lacks scale_1,",
    ),
    "no rotation": (header(properties=FLOATS.replace("rot_2", "r")) + ROWS, "lacks rot_2,"),
    "no colour": (header(properties=FLOATS.replace("f_dc_", "c")) + ROWS, "lacks f_dc_0, f_dc_1, f_dc_2"),
    "no position": (header(properties=FLOATS.replace("float y", "float height")) + ROWS, "lacks y,"),
    "f_rest of no degree": (
        header(properties=FLOATS + "property float f_rest_0\n") + ROWS + bytes(8),
        "found 1 f_rest",
    ),
    "f_rest with a gap": (
        header(properties=FLOATS + "".join(f"property float f_rest_{i}\n" for i in range(1, 10)))
        + ROWS
        + bytes(72),
        "found 9 f_rest properties up to f_rest_9",
    ),
    "ASCII row too short": (
        header("2", "ascii") + LONG_ROW + LONG_ROW[4:],
        "line 20: expected 14 values, got 13",
    ),
    "ASCII row too long": (
        header("2", "ascii") + b"1 " + ASCII_ROW + ASCII_ROW,
        "line 19: expected 14 values, got 15",
    ),
    "ASCII word": (
        header("2", "ascii") + ASCII_ROW + ASCII_ROW.replace(b"1", b"x", 1),
        "line 20: x is not a number: 'x'",
    ),
    "ASCII too few": (header("3", "ascii") + ASCII_ROW * 2 + b" " * 40, "ends after 2 of 3 rows"),
    "ASCII too many": (header("2", "ascii") + ASCII_ROW * 3, "line 21: text after the 2 rows"),
    "ASCII in one line": (header("2", "ascii") + b"1 " * 2_000_000, "line 19 is longer than"),
    "ASCII of bytes": (header("2", "ascii") + bytes(range(256)) * 4, "line"),
    "a mesh": (
        header(
            properties="property float x\nproperty float y\nproperty float z\n",
            after="element face 5\nproperty list uchar int v\n",
        ),
        "not splats but a mesh with 5 faces",
    ),
    "a point cloud": (header(properties="property float x\nproperty uchar red\n"), "a plain point cloud"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_one_clear_error(tmp_path, name):
    data, message = MALFORMED[name]
    path = tmp_path / "splats.ply"
    path.write_bytes(data)
    refused(path, message, 40e6)


def test_line_numbers_after_a_line_end_across_two_blocks(tmp_path):
    row = b"1 " * 13 + b"1"
    # Blocks of 1 MiB are read: the first of them ends between the CR and the LF of a line.
    lines = [row.ljust(31) + b"\r\n", *[row.ljust(30) + b"\r\n"] * 40_000]
    assert len(lines[0]) == 33
    data = header("40002", "ascii") + b"".join(lines) + row.replace(b"1", b"z", 1)
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(FileFormatError, match=f"line {18 + 40_002}: x is not a number: 'z'"):
        load_gaussians(tmp_path / "a.ply")


def test_truncation_anywhere_is_an_error(tmp_path):
    values = random_splats(3, degree=1)
    whole = write_ply(
        tmp_path / "a.ply", [splat_table(values), Table("e", [("uchar", "int", "v")], [[[1, 2]]])]
    ).read_bytes()
    path = tmp_path / "b.ply"
    last = len(whole) - 8  # the list after the splats is not read, only its least size is known
    for size in [*range(0, last - 20, 9), *range(last - 20, last)]:
        path.write_bytes(whole[:size])
        with pytest.raises(FileFormatError):
            load_gaussians(path)


def test_paths(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_gaussians(tmp_path / "nowhere.ply")
    with pytest.raises(FileFormatError, match="a folder without splats"):
        load_gaussians(tmp_path)
    (tmp_path / "point_cloud" / "iteration_seven").mkdir(parents=True)
    (tmp_path / "point_cloud" / "iteration_seven" / "point_cloud.ply").write_bytes(b"ply\n")
    with pytest.raises(FileFormatError, match="a folder without splats"):
        load_gaussians(tmp_path)


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json", "sparse"])
def test_folders_of_photographs_are_told(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(FileFormatError, match=rf"photographs, not splats \({name} is there\).*with data"):
        load_gaussians(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_special_files_are_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    for read in (load_gaussians, load_mesh, identify):  # none of which waits for a writer
        with pytest.raises(FileFormatError, match=r"pipe\.ply: a pipe, not a file: .*give - as the input"):
            read(tmp_path / "pipe.ply")


@pytest.mark.parametrize("address", ["https://example.com/a.ply", "s3://scans/a.glb"])
def test_addresses_are_told_to_be_none_of_files(address):
    for read in (load_gaussians, load_mesh, identify):
        with pytest.raises(FileNotFoundError) as refusal:
            read(Path(address))
        assert refusal.value.filename == address
        assert "an address, not a file: download what it names" in refusal.value.strerror


def test_links_that_lead_nowhere_are_told(tmp_path):
    make_link(tmp_path / "a.ply", tmp_path / "gone.ply")
    for read in (load_mesh, identify):
        with pytest.raises(FileNotFoundError, match=r"a link to .*gone\.ply, which does not exist"):
            read(tmp_path / "a.ply")
