"""The table of splat formats: what follows from it, and what adding one takes."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import types
import warnings
import zipfile
from functools import partial
from pathlib import Path

import _splat_encoders as encode
import numpy as np
import pytest
from _splat_files import random_splats
from _splats import few_splats

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.errors import FileFormatError
from meshsplats.formats import _zipped, splat_formats
from meshsplats.formats.content import Content
from meshsplats.formats.gaussians import format_of
from meshsplats.formats.reading import FormatReader
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import FORMATS, SplatFormat, listed, splat_suffixes, zipped_suffixes
from meshsplats.formats.splat_paths import subject_name
from meshsplats.formats.splats._cloud_builder import SplatReader
from meshsplats.operations.batches import sources

ROOT = Path(__file__).resolve().parents[2]
POINTS = np.random.default_rng(5).normal(size=(300, 3))

# ---- A format of balls: a mark, and three float64 for each.


def _fill(points, origin, rows):
    rows.means[:] = points - origin
    rows.quaternions[:] = [1, 0, 0, 0]
    rows.scales[:] = 0.01
    rows.opacities[:] = 0.5
    rows.sh[:] = 0.25


def _open(content, file, reading):
    points = np.frombuffer(file.read(), np.float64, offset=8).reshape(-1, 3)
    parts = np.array_split(points, 3)

    def chunks(origin):
        return ((len(part), partial(_fill, part, origin)) for part in parts)

    return SplatReader(len(points), 1, "3dgs", content.path, chunks, lambda: points, float32=False)


@pytest.fixture
def balls(monkeypatch, tmp_path):
    """Registers the format, as a module and a line do; a file of it."""
    module = types.ModuleType("meshsplats.formats.balls")
    module.READER = FormatReader(lambda content: content.head.startswith(b"balls\n\0\0"), _open)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    line = SplatFormat(
        "balls",
        (".balls", ".packed.balls"),
        "balls",
        "balls",
        "all",
        zipped=(".balls",),
        folder_file="index.balls",
        y_up=True,
    )
    monkeypatch.setattr(splat_formats, "FORMATS", (*FORMATS, line))
    path = tmp_path / "a.balls"
    path.write_bytes(b"balls\n\0\0" + POINTS.tobytes())
    return path


def test_a_new_format_is_one_line_and_one_module(balls, tmp_path):
    cloud = ms.load_gaussians(balls)
    np.testing.assert_array_equal(cloud.means, (POINTS * [1, -1, -1]).astype(np.float32))
    np.testing.assert_array_equal(ms.load_gaussians(balls, axes="y-down").means, POINTS.astype(np.float32))
    assert format_of(balls) == "balls"
    assert identify(balls) == "splats"
    blocks = list(ms.stream_gaussians(balls, block=100))
    assert len(blocks) == 3
    np.testing.assert_array_equal(np.concatenate([block.means for block in blocks]), cloud.means)
    with pytest.raises(ValueError, match=r"time is for float \.ply files, this is balls"):
        ms.load_gaussians(balls, time=1.0)
    with pytest.raises(FileFormatError, match="not a mesh file of a known format"):
        ms.load_mesh(balls)


def test_a_new_format_is_found_in_folders_and_archives(balls, tmp_path):
    folder = tmp_path / "many"
    folder.mkdir()
    (folder / "b.packed.balls").write_bytes(balls.read_bytes())
    assert sources([folder]) == [folder / "b.packed.balls"]
    assert subject_name(folder / "b.packed.balls") == "b"
    assert sum(map(len, ms.stream_gaussians(folder))) == 300
    indexed = tmp_path / "indexed"
    indexed.mkdir()
    (indexed / "index.balls").write_bytes(balls.read_bytes())
    assert len(ms.load_gaussians(indexed)) == 300
    assert subject_name(indexed / "index.balls") == "indexed"
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as archive:
        archive.writestr("inner/a.balls", balls.read_bytes())
    assert len(ms.load_gaussians(tmp_path / "z.zip")) == 300
    assert [len(block) for block in ms.stream_gaussians(tmp_path / "z.zip", block=100)] == [100] * 3
    (tmp_path / "text.txt").write_text("nothing of the kind")
    with pytest.raises(FileFormatError, match=r"expected .*\.balls"):
        ms.load_gaussians(tmp_path / "text.txt")
    with zipfile.ZipFile(tmp_path / "empty.zip", "w") as archive:
        archive.writestr("a.md", "nothing")
    with pytest.raises(FileFormatError, match=r"no \.ply, \.splat, \.spz or \.balls is in it"):
        ms.load_gaussians(tmp_path / "empty.zip")


def test_a_new_format_is_converted_and_streamed_by_the_commands(balls, tmp_path):
    for flags in ([], ["--stream"]):
        out = tmp_path / f"out{len(flags)}.ply"
        assert main(["convert", str(balls), "-o", str(out), "--no-sidecar", *flags]) == 0
    whole, streamed = ms.load_mesh(tmp_path / "out0.ply"), ms.load_mesh(tmp_path / "out1.ply")
    assert len(whole.faces) > 0
    np.testing.assert_array_equal(whole.vertices, streamed.vertices)
    assert main(["info", str(balls)]) == 0


# ---- What follows from the table


def test_every_line_has_its_module():
    assert len({kind.name for kind in FORMATS}) == len(FORMATS)
    for kind in FORMATS:
        assert isinstance(kind.reader, FormatReader), kind.name


def test_the_first_format_that_matches_is_the_only_one(tmp_path):
    """But for compressed .ply and what the order of the table decides: names in JSON."""
    values = random_splats(9, degree=1)
    files = {
        "ksplat": encode.ksplat(values),
        "splat": encode.dot_splat(values),
        "spz": encode.spz(values),
        "sog": encode.bundle(encode.sog(values)),
        "gltf": encode.gltf(encode.splat_accessors(values)),
        "compressed.ply": encode.compressed_ply(values),
    }
    for name, data in files.items():
        path = tmp_path / "file"
        path.write_bytes(data)
        with Content(path) as content:
            assert [kind.name for kind in FORMATS if kind.reader.matches(content)] == [name]


def table(path: str, first: str) -> dict[str, str]:
    """The first two columns of a table in a document, of the rows from ``first`` on."""
    rows = re.findall(r"(?m)^\| ([^|]+?) \| ([^|]+?) \|", (ROOT / path).read_text(encoding="utf-8"))
    start = next(i for i, row in enumerate(rows) if row[0] == first)
    return dict(rows[start:])


def test_the_table_in_the_readme_is_that_of_the_formats():
    read = "; ".join(
        [kind.description for kind in FORMATS]
        + [f"the only {listed(tuple(f'`{s}`' for s in zipped_suffixes()))} in a zip archive", "model folders"]
    )
    assert table("docs/files.md", "splats")["splats"] == read


def test_the_table_in_the_documents_says_what_is_written():
    rows = re.findall(r"(?m)^\| splats \| .* \| ([^|]+?) \|$", (ROOT / "docs/files.md").read_text("utf-8"))
    assert rows == ["; ".join(kind.written_as for kind in FORMATS if kind.written)]


@pytest.mark.slow
def test_every_written_format_has_its_writer_and_is_read_back(tmp_path):
    cloud = few_splats()
    for kind in FORMATS:
        assert bool(kind.writer_module) == bool(kind.written) == bool(kind.written_as), kind.name
        for suffix in kind.written:
            if kind.name == "usd":
                pytest.importorskip("pxr")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of harmonics that .splat leaves out
                ms.save_gaussians(cloud, tmp_path / f"a{suffix}")
            assert format_of(tmp_path / f"a{suffix}") == kind.name
            assert len(ms.load_gaussians(tmp_path / f"a{suffix}")) == len(cloud)


def test_the_documents_say_what_is_in_memory():
    rows = table(
        "docs/tiles.md", "`.ply` (binary, ASCII, gzipped), compressed `.ply`, `.splat`, `.ksplat`, LCC"
    )
    told = {name.strip(): text for names, text in rows.items() for name in names.split(", ")}
    shown = {"ply": "gzipped)", "compressed.ply": "compressed `.ply`", "splat": "`.splat`", "gltf": "glTF"}
    shown |= {"spz": "SPZ", "sog": "SOG", "streamed sog": "streamed SOG", "usd": "USD"}
    shown |= {"ksplat": "`.ksplat`", "lcc": "LCC", "3d tiles": "3D Tiles"}
    assert {kind.name: told[shown[kind.name]] for kind in FORMATS} == {k.name: k.in_memory for k in FORMATS}


def test_the_documents_list_the_files_that_are_read_of_a_folder():
    text = " ".join((ROOT / "docs/pipelines.md").read_text(encoding="utf-8").split())
    assert f"only its own files ({', '.join(f'`{s}`' for s in splat_suffixes())}, and meshes)" in text


def test_the_table_alone_imports_nothing_heavy():
    """Blender's extension reads it when Blender starts."""
    code = "import sys, meshsplats.formats.splat_formats; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr


# ---- Zip archives


@pytest.mark.parametrize("kind", ["sog", "zip", "npz"])
@pytest.mark.parametrize(
    "ask", [ms.load_gaussians, identify, format_of, lambda p: list(ms.stream_gaussians(p))]
)
def test_the_directory_of_an_archive_is_read_once(tmp_path, monkeypatch, kind, ask):
    values = random_splats(9, degree=1)
    path = tmp_path / f"a.{kind}"
    if kind == "sog":
        path.write_bytes(encode.bundle(encode.sog(values)))
    elif kind == "zip":
        path.write_bytes(encode.bundle({"a.spz": encode.spz(values), "b.md": b"-"}))
    else:
        np.savez(path, a=np.zeros(3))
    read = []
    parse = zipfile.ZipFile._RealGetContents
    monkeypatch.setattr(zipfile.ZipFile, "_RealGetContents", lambda self: (read.append(1), parse(self)))
    try:
        ask(path)
    except FileFormatError:
        assert kind == "npz"
    passes = 2 if ask not in (ms.load_gaussians, identify, format_of) and kind != "npz" else 1
    assert len(read) == passes, "a stream looks for an origin before it reads"


def test_stored_images_are_read_piece_by_piece(tmp_path, monkeypatch):
    """More than what may be read of an archive at once, which is less here."""
    monkeypatch.setattr(_zipped.BoundedReader, "_limit", 5000)
    monkeypatch.setattr(_zipped, "_PIECE", 4096)
    files = encode.sog(random_splats(4000, degree=1))
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    assert max(map(len, files.values())) > 5000
    assert len(ms.load_gaussians(path)) == 4000


def test_a_cut_archive_is_refused(tmp_path):
    path = tmp_path / "a.sog"
    path.write_bytes(b"PK\3\4" + struct.pack("<26x"))
    with pytest.raises(FileFormatError, match="a broken zip archive"):
        ms.load_gaussians(path)
