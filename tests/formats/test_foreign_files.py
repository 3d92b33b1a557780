"""Files of other kinds than those that are read: archives, checkpoints, and what people take for splats."""

from __future__ import annotations

import gzip
import io
import os
import pickle
import re
import shlex
import subprocess
import sys
import zipfile
from contextlib import closing
from pathlib import Path

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import random_splats, splat_table, write_ply
from PIL import Image

import meshsplats as ms
from meshsplats import load_gaussians, load_mesh
from meshsplats.cli import main
from meshsplats.errors import FileFormatError
from meshsplats.formats._zipped import Archive, BoundedReader
from meshsplats.formats.gaussians import format_of
from meshsplats.formats.sniff import identify

SPLATS = random_splats(7, degree=1)


def ply_bytes(tmp_path: Path) -> bytes:
    return write_ply(tmp_path / "_source.ply", [splat_table(SPLATS)]).read_bytes()


def zipped(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def same(a: ms.GaussianCloud, b: ms.GaussianCloud) -> None:
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


# ---- Splats in a zip archive


@pytest.mark.parametrize("suffix", [".zip", ".sog"])
def test_names_that_are_no_text_are_an_error(tmp_path, suffix):
    """The archive says that its names are UTF-8, and they are not; found by the fuzzer."""
    path = zipped(tmp_path / f"scan{suffix}", {"\u00e9.ply": ply_bytes(tmp_path)})
    path.write_bytes(path.read_bytes().replace("\u00e9".encode(), b"\xe9\xe9"))
    with pytest.raises(FileFormatError, match="zip"):
        load_gaussians(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("kind", ["ply", "spz", "splat"])
def test_the_only_splats_in_an_archive_are_read(tmp_path, kind, method):
    """As of the file itself, whole and in blocks, whatever folder it is in and whatever lies beside it."""
    data = {"ply": ply_bytes(tmp_path), "spz": encode.spz(SPLATS), "splat": encode.dot_splat(SPLATS)}[kind]
    plain = tmp_path / f"plain.{kind}"
    plain.write_bytes(data)
    path = zipped(
        tmp_path / "scan.zip",
        {
            f"capture/point_cloud/scene.{kind}": data,
            f"__MACOSX/capture/._scene.{kind}": b"\0\5\x16\7",
            "capture/thumb.jpg": b"\xff\xd8\xff",
            "capture/mesh.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
        },
        method,
    )
    cloud = load_gaussians(plain)
    same(load_gaussians(path), cloud)
    blocks = list(ms.stream_gaussians(path, block=3))
    np.testing.assert_array_equal(np.concatenate([block.means for block in blocks]), cloud.means)
    assert identify(path) == "splats"
    assert format_of(path) == kind
    with pytest.raises(FileFormatError, match=f"splats in a zip archive .*scene.{kind}.*, no mesh"):
        load_mesh(path)


def test_any_meta_json_beside_splats_makes_no_sog_file(tmp_path):
    files = {"scan/meta.json": b'{"author": "x"}', "scan/scan.ply": ply_bytes(tmp_path)}
    path = zipped(tmp_path / "scan.zip", files)
    same(load_gaussians(path), load_gaussians(tmp_path / "_source.ply"))
    assert format_of(path) == "ply"


def test_convert_names_the_mesh_after_the_archive(tmp_path):
    zipped(tmp_path / "scan.zip", {"a.ply": ply_bytes(tmp_path)})
    assert (
        main(["convert", str(tmp_path / "scan.zip"), "-o", str(tmp_path / "scan.npz"), "--no-sidecar"]) == 0
    )
    assert len(load_mesh(tmp_path / "scan.npz").faces) > 0


def test_large_splats_are_read_piece_by_piece(tmp_path, monkeypatch):
    """More than what may be read of an archive at once, which is less here."""
    monkeypatch.setattr(BoundedReader, "_limit", (1 << 20) + 4096)
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    rows = np.random.default_rng(0).normal(size=(90_000, len(names))).astype("<f4")
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 90000\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    data = header.encode() + rows.tobytes()
    (tmp_path / "many.ply").write_bytes(data)
    assert len(data) > 4 << 20
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path = zipped(tmp_path / "many.zip", {"many.ply": data}, method)
        same(load_gaussians(path), load_gaussians(tmp_path / "many.ply"))
        with closing(Archive(path)) as archive, archive.open("many.ply") as file:
            assert file.read() == data
            assert file.seek(0, io.SEEK_END) == len(data)
            assert file.read(1) == b""
            assert file.readinto(bytearray(1)) == 0
            file.seek(0)
            buffer = bytearray(len(data))
            count = file.readinto(buffer)
            assert count > 0
            assert buffer[:count] == data[:count]
            assert file.seek(-5, io.SEEK_END) == file.tell() == len(data) - 5
            assert file.read() == data[-5:]


def test_nothing_is_written_and_no_path_is_followed(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    path = zipped(folder / "evil.zip", {"../../out.ply": ply_bytes(tmp_path)})
    before = sorted(os.listdir(tmp_path))
    assert len(load_gaussians(path)) == 7
    assert sorted(os.listdir(tmp_path)) == before
    assert os.listdir(folder) == ["evil.zip"]


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"a/x.ply": "ply", "b/y.ply": "ply"},
            r"2 files of splats in one archive \(a/x\.ply, b/y\.ply\): unpack",
        ),
        ({"a.txt": b"x", "b/c.md": b"y"}, r"without meta\.json is no SOG file.*holds a\.txt, b/c\.md"),
        ({}, r"\(it holds nothing\)"),
        ({f"p{i}.JPG": b"\xff\xd8" for i in range(12)}, "a zip archive with 12 images: unpack it"),
        ({"x.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"}, "PLY|header"),
        ({"x.ply": "cut"}, "x.ply|shorter|bytes"),
        ({"scene.usdz/x.glb": b"glTF"}, "no SOG file"),
        ({"a/scene.sog": b"PK"}, r"a zip archive with 'a/scene\.sog' in it: unpack it, and give that"),
        ({"meta.json": b"{}"}, r"meta\.json has no object 'means'"),
    ],
    ids=["several", "none", "empty", "images", "header", "cut", "glb", "sog", "meta"],
)
def test_other_archives_are_named(tmp_path, files, message):
    ply = ply_bytes(tmp_path)
    contents = {"ply": ply, "cut": ply[:-9]}
    path = zipped(tmp_path / "a.zip", {k: contents[v] if isinstance(v, str) else v for k, v in files.items()})
    with pytest.raises(FileFormatError, match=message):
        load_gaussians(path)


def test_a_bomb_and_other_methods_are_refused(tmp_path, monkeypatch):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 10000000\n"
    names = [*"xyz", "opacity", *(f"f_dc_{i}" for i in range(3))]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    header += b"".join(f"property float {name}\n".encode() for name in names) + b"end_header\n"
    monkeypatch.setattr("meshsplats.formats._validation._BASE_BYTES", 1 << 20)
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("x.ply", "w") as file:
        file.write(header)
        for _ in range(40):
            file.write(bytes(1 << 20))
    with pytest.raises(FileFormatError, match="decompression bomb"):
        load_gaussians(path)
    zipped(tmp_path / "lzma.zip", {"x.ply": ply_bytes(tmp_path)}, zipfile.ZIP_LZMA)
    with pytest.raises(FileFormatError, match="compressed by method 14, not by deflate"):
        load_gaussians(tmp_path / "lzma.zip")
    zipped(tmp_path / "lzma.sog", encode.sog(SPLATS), zipfile.ZIP_LZMA)
    with pytest.raises(FileFormatError, match=r"'meta\.json': it is compressed by method 14"):
        load_gaussians(tmp_path / "lzma.sog")
    zipped(tmp_path / "lzma.pt", {"a/data.pkl": b"splats sh0"}, zipfile.ZIP_LZMA)
    with pytest.raises(FileFormatError, match=r"a checkpoint of PyTorch.*the program that wrote it"):
        load_gaussians(tmp_path / "lzma.pt")
    wrong = bytearray(zipped(tmp_path / "wrong.zip", {"x.ply": ply_bytes(tmp_path)}, 0).read_bytes())
    wrong[len(wrong) // 2] ^= 1
    (tmp_path / "wrong.zip").write_bytes(wrong)
    with pytest.raises(FileFormatError, match="cannot be unpacked: Bad CRC"):
        load_gaussians(tmp_path / "wrong.zip")


# ---- Checkpoints, never unpickled


class Trap:
    def __reduce__(self):
        return os.mkdir, (os.path.join(os.environ["TRAP"], "sprung"),)


def checkpoint(path: Path, content: object) -> Path:
    return zipped(
        path, {f"{path.stem}/data.pkl": pickle.dumps(content, 2), f"{path.stem}/version": b"3\n"}, 0
    )


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "ckpt_29999_rank0.pt",
            {"step": 1, "splats": {"means": 0, "sh0": 1}},
            r"it is gsplat's.*torch\.load\(sys\.argv\[1\].*ckpt",
        ),
        ("ckpt.zip", {"step": 1, "splats": {"means": 0, "sh0": 1}}, "it is gsplat's"),
        (
            "step-000029999.ckpt",
            {"pipeline": {"_model.gauss_params.means": 0}},
            "ns-export gaussian-splat --load-",
        ),
        ("model.pt", {"_model.gauss_params.means": 0}, "ns-export gaussian-splat"),
        ("chkpnt30000.pth", (1, 2), r"point_cloud/iteration_\*/point_cloud\.ply"),
        ("other.pth", {"weights": 1}, "save the splats as .ply with the program that wrote it"),
    ],
)
def test_checkpoints_are_named_and_not_opened(tmp_path, monkeypatch, name, content, message):
    monkeypatch.setenv("TRAP", str(tmp_path))
    path = checkpoint(tmp_path / name, [content, Trap()])
    for read in (load_gaussians, identify, load_mesh, ms.load_cameras, ms.load_dataset):
        with pytest.raises(FileFormatError, match=message):
            read(path)
    (tmp_path / "old.pth").write_bytes(pickle.dumps([content, Trap()], 2))  # before PyTorch 1.6
    with pytest.raises(FileFormatError, match="a checkpoint of PyTorch"):
        load_gaussians(tmp_path / "old.pth")
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([content, Trap()]))
    with pytest.raises(FileFormatError, match="a pickle of Python"):
        load_gaussians(tmp_path / "a.pkl")
    assert not (tmp_path / "sprung").exists()


def test_a_checkpoint_that_cannot_be_unpacked_is_named(tmp_path):
    name, noise = "a/data.pkl", np.random.default_rng(0).bytes(4096)
    path = zipped(tmp_path / "a.pt", {name: bytes(4096) + noise})
    data = bytearray(path.read_bytes())
    start = data.index(name.encode()) + len(name)
    data[start : start + 64] = b"\xff" * 64  # no deflate block begins so
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="a checkpoint of PyTorch"):
        load_gaussians(path)


@pytest.mark.skipif(sys.platform == "win32", reason="quotes of other shells")
@pytest.mark.parametrize("name", ["$(mkdir sprung) `x`.{}", "a'; \"b.{}"])
def test_names_in_commands_to_paste_are_quoted(tmp_path, name):
    path = checkpoint(tmp_path / name.format("pt"), {"splats": {"means": 0, "sh0": 1}})
    with pytest.raises(FileFormatError) as caught:
        load_gaussians(path)
    words = shlex.split(str(caught.value).split("as .ply: ")[1])
    assert words[:2] == ["python", "-c"]
    assert words[3:] == [str(path), name.format("ply")]
    (tmp_path / name.format("lcc2")).write_text("{}")
    with pytest.raises(FileFormatError) as caught:
        load_gaussians(tmp_path / name.format("lcc2"))
    words = shlex.split(str(caught.value).split("convert it first: ")[1])
    assert words[2:] == [name.format("lcc2"), name.format("ply")]


@pytest.mark.slow
def test_the_line_for_gsplats_checkpoints_works(tmp_path):
    torch = pytest.importorskip("torch")
    plain = load_gaussians(write_ply(tmp_path / "_source.ply", [splat_table(SPLATS)]))
    tensors = ms.gaussians_to_tensors(plain, "gsplat", torch=True)
    path = tmp_path / "$(mkdir sprung) 'ckpt'.pt"  # of a stranger
    torch.save({"step": 29999, "splats": dict(tensors)}, path)
    with pytest.raises(FileFormatError) as caught:
        load_gaussians(path)
    command = str(caught.value).split("as .ply: ")[1]
    command = command.replace("python", shlex.quote(sys.executable), 1)
    subprocess.run(command, shell=True, cwd=tmp_path, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert not (tmp_path / "sprung").exists()
    again = load_gaussians(path.with_suffix(".ply"))
    np.testing.assert_allclose(again.means, plain.means)
    np.testing.assert_allclose(again.scales, plain.scales, rtol=1e-5)
    np.testing.assert_allclose(again.sh, plain.sh, rtol=1e-6)


# ---- What people take for splats, meshes, cameras and data sets


def png() -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (4, 4)).save(out, "PNG")
    return out.getvalue()


POINTS = "a point cloud: its points have no size and no opacity"
KINDS = {
    "a.las": (b"LASF" + bytes(300), POINTS),
    "renamed.dat": (b"LASF" + bytes(300), POINTS),
    "a.laz": (b"LASF" + bytes(300), POINTS),
    "a.e57": (b"ASTM-E57" + bytes(100), POINTS),
    "a.pcd": (b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n", POINTS),
    "a.xyz": (b"0.1 0.2 0.3\n0.4 0.5 0.6\n", POINTS),
    "a.pts": (b"2\n0.1 0.2 0.3 10 1 2 3\n", POINTS),
    "a.fbx": (b"Kaydara FBX Binary  \0\x1a\0" + bytes(50), "an FBX scene: open it in Blender"),
    "a.blend": (b"\x28\xb5\x2f\xfd" + bytes(50), r"a file of Blender: export it as \.glb"),
    "a.max": (b"\xd0\xcf\x11\xe0" + bytes(50), "a scene of a modelling program"),
    "a.stl": (bytes(84), "an STL mesh, which is not read: .*'meshsplats surface' makes .glb of splats"),
    "print.dat": (b"MeshSplats, millimetres".ljust(84), "an STL mesh"),
    "a.3mf": (bytes(84), "a mesh for printing, which is not read: .*'meshsplats surface'"),
    "a.dae": (b'<?xml version="1.0"?>\n<COLLADA>', "a COLLADA scene"),
    "a.mp4": (b"\0\0\0\x20ftypisom" + bytes(50), "a video: 'meshsplats train VIDEO"),
    "a.mov": (b"\0\0\0\x14ftypqt  " + bytes(50), "a video"),
    "a.insv": (b"\0\0\0\x20ftypisom" + bytes(50), "a video of a panoramic camera: export it"),
    "photo.png": (png(), "an image; 'meshsplats train'"),
    "photo.HEIC": (b"\0\0\0\x1cftypheic" + bytes(50), "an image"),
    "a.npy": (b"\x93NUMPY\1\0" + bytes(50), "a NumPy array"),
    "a.rar": (b"Rar!\x1a\7\0", "an archive: unpack it first"),
    "a.7z": (b"7z\xbc\xaf\x27\x1c", "an archive: unpack it first"),
    "a.psht": (b"\0\1\2", "a project of Postshot"),
    "images.bin": (bytes(64), "a part of COLMAP's sparse model"),
    "points3D.txt": (b"# 3D point list\n", "a part of COLMAP's sparse model"),
    "a.splatv": (bytes(40), "splats that move"),
    "a.safetensors": (bytes(64), "tensors: read them with safetensors"),
}


@pytest.mark.parametrize("name", list(KINDS))
def test_kinds_of_files_are_named_by_all_who_meet_them(tmp_path, name):
    data, message = KINDS[name]
    path = tmp_path / name
    path.write_bytes(data)
    for read in (load_gaussians, identify, load_mesh, ms.load_cameras):
        with pytest.raises(FileFormatError, match=message):
            read(path)
    if "sparse model" not in message:  # which is a data set, broken here
        with pytest.raises(FileFormatError, match=message):
            ms.load_dataset(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            b"<!DOCTYPE html><html><head><title>SuperSplat Viewer</title>",
            "a page of SuperSplat's viewer: export",
        ),
        (
            b'<!doctype html>\n<meta name="generator" content="meshsplats 0.1.0">',
            "a page of 'meshsplats view'",
        ),
        (b"<html>Sign in</html>", "did the download ask for a login"),
    ],
)
def test_web_pages_are_told_apart(tmp_path, data, message):
    for name in ("scene.html", "scene.ply"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FileFormatError, match=message):
            load_gaussians(tmp_path / name)


def test_a_page_of_ours_is_known(tmp_path):
    write_ply(tmp_path / "a.ply", [splat_table(SPLATS)])
    assert main(["view", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.html")]) == 0
    with pytest.raises(FileFormatError, match="a page of 'meshsplats view'"):
        load_gaussians(tmp_path / "a.html")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["a.JPG", "b.JPG"], r"a folder of images \(a\.JPG is there\), not splats"),
        (["poses_bounds.npy"], "photographs, not splats"),
        (["cameras.txt", "images.txt"], "photographs, not splats"),
        (["._a.ply", ".DS_Store", "Thumbs.db"], "a folder without splats"),
    ],
)
def test_folders_without_splats_are_named(tmp_path, capsys, files, message):
    for name in files:
        (tmp_path / name).write_bytes(b"x")
    for read in (load_gaussians, ms.stream_gaussians):
        with pytest.raises(FileFormatError, match=message):
            read(tmp_path)
    for output in (["out", "--formats", "glb"], ["out.glb"]):  # the second would be one file for several
        assert main(["convert", str(tmp_path), "-o", str(tmp_path / output[0]), *output[1:]]) == 1
        assert re.search(message, capsys.readouterr().err)


def test_a_data_set_given_as_cameras_is_told_so(tmp_path):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(FileFormatError, match=r"a data set \(sparse is there\): read it with load_data"):
        ms.load_cameras(tmp_path)


def test_known_kinds_are_not_mistaken(tmp_path):
    """Files that are read, under names and with beginnings as they come."""
    ply = ply_bytes(tmp_path)
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(ply))
    (tmp_path / "b.pt").write_bytes(ply)  # the content decides where it is known
    same(load_gaussians(tmp_path / "a.ply.gz"), load_gaussians(tmp_path / "b.pt"))
    (tmp_path / "c.xyz").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert identify(tmp_path / "c.xyz") == "mesh"
