"""Compressed splat files that are broken, absurd or meant to harm: one clear error, in little memory."""

from __future__ import annotations

import gzip
import json
import os
import struct
import zipfile

import _splat_encoders as encode
import numpy as np
import pytest
from _local import make_link
from _splat_files import random_splats
from _splats import refused

from meshsplats import FileFormatError, load_gaussians

VALUES = random_splats(9, degree=1)
SPZ = encode.spz(VALUES)
SOG = encode.sog(VALUES)
PLY = encode.compressed_ply(VALUES)
ACCESSORS = encode.splat_accessors(VALUES)
ROTATION = "KHR_gaussian_splatting:ROTATION"


def spz_body(version=3, count=9, degree=1, bits=12, flags=0, rest=b""):
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + rest)


def spz4(
    version=4,
    count=9,
    degree=0,
    streams=5,
    table=32,
    sizes=(81, 9, 27, 27, 36),
    packed=(4,) * 5,
    rest=bytes(20),
):
    data = struct.pack("<4sIIBBBBI12x", b"NGSP", version, count, degree, 12, 0, streams, table)
    return data + b"".join(struct.pack("<QQ", p, s) for p, s in zip(packed, sizes, strict=True)) + rest


def meta(**changes):
    """The SOG folder with entries of its meta.json replaced; a value of None removes one."""
    parsed = json.loads(SOG["meta.json"])
    for key, value in changes.items():
        owner, _, inner = key.partition("__")
        where, name = (parsed[owner], inner) if inner else (parsed, owner)
        where[name] = value
        if value is None:
            del where[name]
    return SOG | {"meta.json": json.dumps(parsed).encode()}


def streamed(**index):
    """A streamed SOG folder of one part with entries of its index replaced."""
    return encode.streamed_sog({"a": VALUES}, [{0: ("a", 0, 9)}, {0: ("a", 0, 9)}], **index)


def tree(file=0, offset=0, count=9):
    return {"lods": {"0": {"file": file, "offset": offset, "count": count}}}


def bomb_image():
    """An image of 4000 x 4000 equal pixels in a few kilobytes."""
    return encode.image(np.zeros((4000, 4000, 4), np.uint8), "PNG")


def attributes(**changes):
    names = {
        key if key == "POSITION" else "KHR_gaussian_splatting:" + key: value for key, value in changes.items()
    }
    return {k: v for k, v in (ACCESSORS | names).items() if v is not None}


# What takes long to make is made by its test, not by everyone who imports this module.
FILES = {
    # SPZ, versions 1 to 3
    "gzip of text.spz": (gzip.compress(b"Hello" * 100), "a gzip file, but not SPZ"),
    "cut gzip.spz": (SPZ[:-30], "truncated"),
    "cut after the magic.spz": (gzip.compress(b"NGSP\3\0\0\0"), "truncated SPZ header of 8 bytes"),
    "flipped bits.spz": (SPZ[:60] + bytes(20) + SPZ[80:], "gzip stream is broken|truncated|longer"),
    "version 0.spz": (spz_body(0), "SPZ version 0 in a container of version 1 to 3"),
    "version 4 in gzip.spz": (spz_body(4), "SPZ version 4 in a container"),
    "degree 9.spz": (spz_body(degree=9), "degree 9"),
    "200 fractional bits.spz": (spz_body(bits=200), "200 fractional bits"),
    "no splats.spz": (spz_body(count=0), "no splats"),
    "4 billion splats.spz": (spz_body(count=2**32 - 1), "its 4,294,967,295 splats would take"),
    "a million splats.spz": (spz_body(count=1_000_000), "1,000,000 splats take .* the stream gave 0"),
    "bomb.spz": (
        lambda: spz_body(count=10**7, degree=0, rest=bytes(20_000_000)),
        "decompression bomb",
    ),
    "bomb behind one splat.spz": (
        lambda: spz_body(count=1, rest=bytes(40_000_000)),
        "longer than its header says",
    ),
    "bytes behind.spz": (gzip.compress(gzip.decompress(SPZ) + b"more"), "4 bytes follow the 9 splats"),
    "unknown axes.spz": (
        encode.spz(VALUES, flags=2, extensions=struct.pack("<III", 0xADBE0003, 4, 99)),
        "unknown SPZ coordinate system 99",
    ),
    # SPZ, version 4
    "cut.spz": (spz4()[:20], "truncated SPZ header of 20 bytes"),
    "version 5.spz": (spz4(version=5), "SPZ version 5 in a container of version 4"),
    "streams missing.spz": (spz4(streams=3), "a table of 3 streams|an SPZ table of 3 streams"),
    "table beyond the file.spz": (spz4(table=5000), "at byte 5,000"),
    "table in the header.spz": (spz4(table=0), "at byte 0"),
    "wrong size.spz": (spz4(sizes=(82, 9, 27, 27, 36)), "the stream of positions has 4 bytes for 82; 81 are"),
    "huge stream.spz": (spz4(packed=(2**63, 4, 4, 4, 4)), "are left in the file"),
    "4 billion splats, 4.spz": (spz4(count=2**32 - 1), "its 4,294,967,295 splats would take"),
    # compressed .ply
    "no chunks.ply": (PLY.replace(b"element chunk", b"element chump"), "without the element 'chunk'"),
    "too few chunks.ply": (
        PLY.replace(b"element chunk 1", b"element chunk 0"),
        "9 splats need 1 chunks of 256",
    ),
    "no range.ply": (PLY.replace(b"float max_y", b"float mix_y"), "need the property 'max_y' of type float"),
    "wrong type.ply": (PLY.replace(b"uint packed_scale", b"int packed_scale"), "'packed_scale' of type uint"),
    "harmonics missing.ply": (PLY.replace(b"element sh 9", b"element sh 8"), "8 rows of element 'sh' for 9"),
    "8 harmonics.ply": (PLY.replace(b"property uchar f_rest_8\n", b""), "'sh' has 8 properties"),
    "ASCII.ply": (PLY.replace(b"binary_little_endian", b"ascii"), "must be binary"),
    "cut.ply": (PLY[:-1], "claims 9 rows of element 'sh'"),
    "no splats.ply": (
        encode.compressed_ply(VALUES)
        .replace(b"chunk 1", b"chunk 0")
        .replace(b"vertex 9", b"vertex 0")
        .replace(b"sh 9", b"sh 0"),
        "no splats|bytes follow",
    ),
    # .splat
    "cut.splat": (encode.dot_splat(VALUES)[:-1], "not records of 32 bytes"),
    "text.splat": (
        b"This is a letter, of 32 letters.\n"[:32] * 40,
        "not records of 32 bytes of splats",
    ),
    "tree of spark.spz": (
        spz_body(version=2, count=1, degree=0, flags=128, rest=bytes(19 + 6)),
        "6 bytes follow the 1 splats; those of Spark's level-of-detail tree",
    ),
    "not zipped.spz": (
        gzip.decompress(spz_body(version=2, rest=bytes(40))),
        "SPZ of version 2 that is not gzipped",
    ),
    "zeros.splat": (bytes(3200), "positive scales"),
    # SOG archives
    "no meta.sog": (encode.bundle({"a.webp": b""}), "without meta.json is no SOG file"),
    "cut.sog": (encode.bundle(SOG)[:-100], "zip"),
    "broken entry.sog": (
        encode.bundle(SOG, compression=zipfile.ZIP_DEFLATED).replace(b"PK\1\2", b"PK\1\3", 1),
        "zip",
    ),
    "long meta.sog": (
        lambda: encode.bundle({"meta.json": b" " * 50_000_000}, "", zipfile.ZIP_DEFLATED),
        "unpacks to over",
    ),
    "image bomb.sog": (
        lambda: encode.bundle(SOG | {"quats.webp": bytes(40_000_000)}, "", zipfile.ZIP_DEFLATED),
        "'quats.webp' unpacks to over",
    ),
    "missing file.sog": (
        encode.bundle({k: v for k, v in SOG.items() if k != "sh0.webp"}),
        "'sh0.webp' .* not in",
    ),
    "up and out.sog": (
        encode.bundle(meta(quats={"files": ["../quats.webp"]}) | {"../quats.webp": SOG["quats.webp"]}),
        "no plain file name; refused",
    ),
    # glTF
    "no rotation.glb": (encode.gltf(attributes(ROTATION=None)), f"need the attribute {ROTATION}"),
    "one short.glb": (
        encode.gltf(attributes(ROTATION=np.ones((8, 4)))),
        r"must have shape \(9, 4\), got \(8, 4\)",
    ),
    "three numbers.glb": (
        encode.gltf(attributes(ROTATION=np.ones((9, 3)))),
        r"must have shape \(9, 4\), got \(9, 3\)",
    ),
    "half a degree.glb": (encode.gltf(attributes(SH_DEGREE_1_COEF_1=None)), "SH_DEGREE_1_COEF_1"),
    "all flat.glb": (encode.gltf(attributes(ROTATION=np.zeros((9, 4)))), "no usable splats"),
    "a mesh.glb": (
        encode.gltf({"POSITION": np.zeros((3, 3))}).replace(b"gaussian_splatting", b"gaussian_SPLATTING"),
        "gl",
    ),
    "cut.glb": (encode.gltf(ACCESSORS)[:-50], "truncated"),
    "spz of junk.glb": (encode.gltf(spz_data=b"junk" * 20), "gzip stream is broken"),
    "deep.gltf": (b'{"asset": ' + b"[" * 100_000, "JSON"),
    # anything else
    "numbers.json": (b"[1, 2, 3]", "not a splat file"),
    "other.json": (b'{"hello": "world"}', "neither SOG nor glTF"),
}

DEEP = b'{"children":[' * 70 + b"]}" * 70
FOLDERS = {
    "not JSON": (SOG | {"meta.json": b'{"means": '}, "not a JSON file"),
    "an array": (
        SOG | {"meta.json": b'{"x": [], "means": []}'.replace(b"{", b" {", 1)},
        "give a number of splats|needs",
    ),
    "deep": (SOG | {"meta.json": b'{"means": ' + b"[" * 200_000}, "not a JSON file"),
    "version 3": (meta(version=3), "SOG version 3"),
    "no count": (meta(count=None), "number of splats .* got None"),
    "count of text": (meta(count="9"), "number of splats"),
    "count of truth": (meta(count=True), "number of splats .* got True"),
    "negative count": (meta(count=-1), "number of splats"),
    "no splats": (meta(count=0), "no splats"),
    "a billion splats": (meta(count=10**9), "number of splats up to 268,435,456"),
    "200 million splats": (meta(count=200_000_000), "its 200,000,000 splats would take"),
    "more splats than pixels": (meta(count=1000), "too few for 1,000 splats"),
    "no scales": (meta(scales=None), "no object 'scales'"),
    "means of text": (meta(means="hello"), "no object 'means'"),
    "one file of means": (meta(means__files=["means_l.webp"]), r"must name 2 file\(s\) of 'means'"),
    "short codebook": (meta(sh0__codebook=[0.0] * 255), "sh0.codebook in meta.json must be 256 numbers"),
    "codebook of text": (meta(sh0__codebook=["0"] * 256), "must be 256 numbers"),
    "huge numbers": (meta(means__maxs=[10**400, 0, 0]), "means.maxs in meta.json must be 3 numbers"),
    "NaN": (meta(means__mins=[float("nan"), 0, 0]), "means.mins in meta.json must be 3 numbers"),
    "bands do not fit": (meta(shN__bands=2), "does not fit 2 bands"),
    "bands of list": (meta(shN__bands=[1]), "does not fit"),
    "palette too long": (meta(shN__count=65), "a palette of 65 harmonics in an image of 64"),
    "missing": (meta(quats={"files": ["other.webp"]}), "'other.webp' that it names is missing"),
    "absolute path": (meta(quats={"files": ["/etc/passwd"]}), "no plain file name; refused"),
    "parent folder": (meta(quats={"files": ["../secret.webp"]}), "no plain file name; refused"),
    "windows path": (meta(quats={"files": ["C:\\secret.webp"]}), "no plain file name; refused"),
    "dots": (meta(quats={"files": [".."]}), "no plain file name; refused"),
    "not an image": (SOG | {"quats.webp": b"hello"}, "the image of quats cannot be read"),
    "half an image": (SOG | {"quats.webp": SOG["quats.webp"][:40]}, "the image of quats cannot be read"),
    "large image": (lambda: SOG | {"quats.webp": bomb_image()}, "4000 x 4000 pixels, expected at most"),
    "large palette": (
        lambda: SOG | {"shN_centroids.webp": encode.image(np.zeros((9000, 1920, 3), np.uint8), "PNG")},
        "9000",
    ),
}

STREAMED = {
    "not JSON": (streamed() | {"lod-meta.json": b'{"lodLevels": '}, "not a JSON file"),
    "deep": (streamed() | {"lod-meta.json": b'{"lodLevels": ' + b"[" * 200_000}, "not a JSON file"),
    "deep tree": (
        streamed() | {"lod-meta.json": b'{"lodLevels":1,"filenames":["a/meta.json"],"tree":%s}' % DEEP},
        "neither 'lods' nor 'children'",
    ),
    "version 2": (streamed(version=2), "streamed SOG of version 2"),
    "no parts": (streamed(filenames=[]), "its tree names part 0, but there are 0"),
    "parts of text": (streamed(filenames="a"), "'filenames' must be a list"),
    "no tree": (streamed(tree=None), "neither 'lods' nor 'children'"),
    "empty tree": (streamed(tree={"children": []}), "its tree has none"),
    "no level": (streamed(tree={"lods": {}}), "neither 'lods' nor 'children'"),
    "level of text": (streamed(tree={"lods": {"a": 0}}), "levels must be numbers, got a"),
    "level of list": (streamed(tree={"lods": {"0": [0, 0, 9]}}), "a level must be an object"),
    "negative offset": (streamed(tree=tree(offset=-1)), "'offset' of a level must be a whole number, got -1"),
    "count of truth": (
        streamed(tree=tree(count=True)),
        "'count' of a level must be a whole number, got True",
    ),
    "huge count": (streamed(tree=tree(count=10**30)), "'count' of a level must be a whole number"),
    "beyond its part": (streamed(tree=tree(offset=1)), "splats 1 to 10 are requested, but it has 9"),
    "missing part": (streamed(filenames=["b/meta.json"]), "the part 'b/meta.json' that it names is missing"),
    "missing environment": (streamed(environment="env/meta.json"), "the part 'env/meta.json' that"),
    "parent folder": (streamed(filenames=["../secret/meta.json"]), "no path below its folder; refused"),
    "dots within": (streamed(filenames=["a/../../secret/meta.json"]), "no path below its folder; refused"),
    "absolute path": (streamed(filenames=["/etc/meta.json"]), "no path below its folder; refused"),
    "windows path": (streamed(environment="C:\\meta.json"), "no path below its folder; refused"),
    "environment of number": (streamed(environment=3), "no path below its folder; refused"),
    "a part that is the index": (streamed(filenames=["lod-meta.json"]), "SOG version 1; known are 2"),
    "two kinds": (
        encode.streamed_sog({"a": VALUES, "b": VALUES}, [{0: ("a", 0, 9)}, {0: ("b", 0, 9)}])
        | {"b/meta.json": meta(model="2dgs")["meta.json"]},
        "of several kinds of splats: 2dgs, 3dgs",
    ),
}


def check(path, message):
    refused(path, message, 90e6)


@pytest.mark.parametrize("name", FILES)
def test_files(tmp_path, name):
    data, message = FILES[name]
    path = tmp_path / f"a.{name.rsplit('.')[-1]}"
    path.write_bytes(data() if callable(data) else data)
    check(path, message)


@pytest.mark.parametrize("name", FOLDERS)
def test_sog_folders(tmp_path, name):
    files, message = FOLDERS[name]
    (tmp_path / "secret.webp").write_bytes(SOG["quats.webp"])
    (tmp_path / "scene").mkdir()
    for file_name, data in (files() if callable(files) else files).items():
        (tmp_path / "scene" / file_name).write_bytes(data)
    check(tmp_path / "scene", message)


def test_parts_of_sog_may_be_links(tmp_path):
    """As the caches of Hugging Face and of data versioning keep all files."""
    (tmp_path / "blobs").mkdir()
    (tmp_path / "scene").mkdir()
    for name, data in SOG.items():
        (tmp_path / "blobs" / name).write_bytes(data)
        make_link(tmp_path / "scene" / name, tmp_path / "blobs" / name)
    assert len(load_gaussians(tmp_path / "scene")) == 9


def test_large_parts_of_sog_are_refused_unread(tmp_path):
    """A file with holes takes no room in an archive."""
    for name, data in SOG.items():
        (tmp_path / name).write_bytes(data)
    os.truncate(tmp_path / "quats.webp", (1 << 30) + 1)
    check(tmp_path, "'quats.webp' has over 1,073,741,824 bytes; refused")


@pytest.mark.parametrize("name", STREAMED)
def test_streamed_sog(tmp_path, name):
    files, message = STREAMED[name]
    for file_name, data in (files | {"../secret/meta.json": SOG["meta.json"]}).items():
        path = tmp_path / "scene" / file_name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    check(tmp_path / "scene", message)


@pytest.mark.slow
def test_parts_that_each_unpack_far_do_not_do_so_together(tmp_path):
    """50 parts of a few kilobytes, each of which may have 260,000 equal splats."""
    side, count = 512, 50
    values = random_splats(9, degree=0)
    part = {name: encode.image(np.zeros((side, side, 4), np.uint8), "PNG") for name in encode.sog(values)}
    part["quats.webp"] = encode.image(np.full((side, side, 4), (128, 128, 128, 252), np.uint8), "PNG")
    described = json.loads(encode.sog(values)["meta.json"]) | {"count": side * side}
    part["meta.json"] = json.dumps(described).encode()
    names = [f"p{k}" for k in range(count)]
    for name in names:
        (tmp_path / name).mkdir()
        for file_name, data in part.items():
            (tmp_path / name / file_name).write_bytes(data)
    index = {
        "lodLevels": 1,
        "filenames": [f"{name}/meta.json" for name in names],
        "tree": {"children": [tree(file=k, count=side * side) for k in range(count)]},
    }
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    assert len(load_gaussians(tmp_path / "p0")) == side * side
    refused(tmp_path / "lod-meta.json", "the splats of 'p[0-9]+/meta.json' would take the data beyond", 600e6)


@pytest.mark.slow
def test_many_names_of_one_part_do_not_multiply_its_splats(tmp_path):
    index = {"tree": {"children": [tree()] * 100_000}}
    for file_name, data in streamed(**index).items():
        path = tmp_path / file_name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
    assert len(load_gaussians(tmp_path)) == 9


def test_frames_that_unpack_to_more(tmp_path):
    zstandard = pytest.importorskip("zstandard", reason="install meshsplats[formats]")
    compress = zstandard.ZstdCompressor().compress
    for size, message in ((100_000_000, "does not unpack to 81 bytes"), (80, "does not unpack to 81 bytes")):
        packed = [compress(bytes(n)) for n in (size, 9, 27, 27, 36)]
        data = spz4(packed=tuple(map(len, packed)), rest=b"".join(packed))
        (tmp_path / "a.spz").write_bytes(data)
        check(tmp_path / "a.spz", message)
    (tmp_path / "a.spz").write_bytes(spz4())
    check(tmp_path / "a.spz", "the stream of positions is broken")
    (tmp_path / "a.spz").write_bytes(encode.spz4(VALUES, compress) + b"more")
    check(tmp_path / "a.spz", "4 bytes follow the last SPZ stream")


def test_truncation_anywhere_is_an_error(tmp_path):
    for name, data in (
        ("a.spz", SPZ),
        ("a.sog", encode.bundle(SOG)),
        ("a.ply", PLY),
        ("a.glb", encode.gltf(ACCESSORS)),
    ):
        for size in range(0, len(data), max(1, len(data) // 60)):
            (tmp_path / name).write_bytes(data[:size])
            with pytest.raises(FileFormatError):
                load_gaussians(tmp_path / name)
