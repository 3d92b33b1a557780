"""The table of mesh formats: what follows from it, and what adding one takes."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import types
import warnings
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from _meshes import random_mesh

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats import mesh_formats
from meshsplats.formats.mesh_formats import (
    MESH_FORMATS,
    MeshCodec,
    MeshFormat,
    formats_in_words,
    keeps,
    mesh_suffixes,
    takes,
    written_mesh_suffixes,
)
from meshsplats.formats.outputs import Ending, MeshEnding
from meshsplats.formats.sniff import identify
from meshsplats.operations.batches import sources
from meshsplats.scene.mesh import SplatMesh

ROOT = Path(__file__).resolve().parents[2]
MARK = b"tin\0"

# ---- A format of triangles: a mark, two counts, positions, colours and corners.


def _write(mesh, path, *, lit=False):
    counts = struct.pack("<2i", len(mesh.vertices), len(mesh.faces))
    arrays = (mesh.vertices + mesh.origin.astype(np.float32), mesh.colors, mesh.faces)
    path.write_bytes(MARK + (b"l" if lit else b"-") + counts + b"".join(a.tobytes() for a in arrays))


def _read(path, origin):
    data = path.read_bytes()
    v, f = struct.unpack_from("<2i", data, 5)
    places = np.frombuffer(data, np.float32, 3 * v, 13).reshape(-1, 3)
    colors = np.frombuffer(data, np.float32, 4 * v, 13 + 12 * v).reshape(-1, 4)
    return SplatMesh(places, np.frombuffer(data, np.int32, 3 * f, 13 + 28 * v).reshape(-1, 3), colors)


@pytest.fixture
def tin(monkeypatch, tmp_path):
    """Registers the format, as a module and a line do; a file of it, and the mesh in that."""
    module = types.ModuleType("meshsplats.formats.tin")
    module.CODEC = MeshCodec(lambda content: content.head.startswith(MARK), _read, _write, lambda size: 99)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    line = MeshFormat("tin", (".tin", ".sheet"), "tin", (".tin",), "`.tin`", takes=("lit",))
    monkeypatch.setattr(mesh_formats, "MESH_FORMATS", (*MESH_FORMATS, line))
    path = tmp_path / "a.tin"
    mesh = random_mesh(np.random.default_rng(3))
    mesh = SplatMesh(mesh.vertices, mesh.faces, mesh.colors)
    ms.save_mesh(mesh, path)
    return path, mesh


def test_a_new_format_is_one_line_and_one_module(tin, tmp_path):
    path, mesh = tin
    again = ms.load_mesh(path)
    for name in ("vertices", "faces", "colors"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    assert identify(path) == "mesh"
    ms.save_mesh(mesh, tmp_path / "lit.tin", lit=True)
    assert (tmp_path / "lit.tin").read_bytes()[4:5] == b"l"
    with pytest.raises(ValueError, match=r"the option alpha applies to \.glb only, not to \.tin"):
        ms.save_mesh(mesh, tmp_path / "b.tin", alpha="mask")
    with pytest.raises(ValueError, match=r"lit applies to .*\.usd, \.tin only, not to \.npz"):
        ms.save_mesh(mesh, tmp_path / "b.npz", lit=True)
    (tmp_path / "text.md").write_text("nothing of the kind")
    with pytest.raises(FileFormatError, match=r"expected \.npz, .*, \.tin or \.sheet$"):
        ms.load_mesh(tmp_path / "text.md")
    with pytest.raises(ValueError, match=r"choose a name that ends in \.npz, .*, \.tin$"):
        ms.save_mesh(mesh, tmp_path / "b.sheet")


def test_a_new_format_says_what_it_leaves_out(tin, tmp_path):
    triangles = np.zeros(len(tin[1].faces), np.int32)
    mesh = replace(tin[1], face_splat=triangles, filter_px2=0.3)
    with pytest.warns(DataWarning, match="other programs do not have"):
        ms.save_mesh(mesh, tmp_path / "b.tin")
    colored = ms.convert(ms.GaussianCloud(**_one_splat(harmonics=4)))
    with pytest.warns(DataWarning, match=r"harmonics are left out, \.tin has no place"):
        ms.save_mesh(colored, tmp_path / "c.tin")


def _one_splat(harmonics):
    sh = np.zeros((1, harmonics, 3), np.float32)
    sh[:, 1:] = 0.2
    return {
        "means": np.zeros((1, 3), np.float32),
        "quaternions": np.array([[1, 0, 0, 0]], np.float32),
        "scales": np.full((1, 3), 0.1, np.float32),
        "opacities": np.array([0.9], np.float32),
        "sh": sh,
    }


def test_a_new_format_is_converted_by_the_commands(tin, tmp_path, capsys):
    path, mesh = tin
    assert sources([path.parent]) == [path]
    assert main(["convert", str(path), "-o", str(tmp_path / "b.npz"), "--no-sidecar"]) == 0
    np.testing.assert_array_equal(ms.load_mesh(tmp_path / "b.npz").vertices, mesh.vertices)
    back = ["convert", str(tmp_path / "b.npz"), "--no-sidecar", "--lit", "-o"]
    assert main([*back, str(tmp_path / "c.tin")]) == 0
    assert (tmp_path / "c.tin").read_bytes()[4:5] == b"l"
    assert main(["info", str(path)]) == 0
    assert main(["convert", str(path), "-o", str(tmp_path / "b.foo")]) == 2
    assert "-o must end in .npz, .ply, .glb, .usdc, .usda, .usd, .obj, .tin" in capsys.readouterr().err
    assert formats_in_words().endswith(".obj, .tin")


# ---- What follows from the table


def test_every_line_has_its_module():
    assert len({kind.name for kind in MESH_FORMATS}) == len(MESH_FORMATS)
    for kind in MESH_FORMATS:
        assert isinstance(kind.codec, MeshCodec), kind.name
        assert set(kind.written) <= set(kind.suffixes), kind.name


@pytest.mark.parametrize("suffix", written_mesh_suffixes())
def test_formats_keep_what_the_table_says(tmp_path, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    mesh = ms.convert(ms.GaussianCloud(**_one_splat(harmonics=4)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ms.save_mesh(mesh, tmp_path / f"m{suffix}")
    again = ms.load_mesh(tmp_path / f"m{suffix}")
    assert (again.harmonics is not None) == keeps(f"m{suffix}", "harmonics")
    own = next(kind.own for kind in MESH_FORMATS if suffix in kind.written)
    assert not own or np.array_equal(again.colors, mesh.colors)


def test_names_that_are_no_meshes_take_and_keep_nothing():
    assert takes("a.GLB", "alpha")
    assert not takes("a.gltf", "alpha"), "which is read only"
    assert not keeps("a", "harmonics")


def test_the_options_of_the_commands_list_the_formats():
    """The default first."""
    meshes = ("glb", "npz", "ply", "usdc", "usda", "usd", "obj")
    assert get_args(MeshEnding) == meshes
    assert get_args(Ending) == (*meshes, "compressed.ply", "splat", "spz", "sog", "usdz")


def test_the_table_in_the_documents_is_that_of_the_formats():
    text = (ROOT / "docs/files.md").read_text("utf-8")
    read, written = re.findall(r"(?m)^\| meshes \| ([^|]+?) \| ([^|]+?) \|$", text)[0]
    assert read == ", ".join(f"`{suffix}`" for suffix in mesh_suffixes())
    assert written == "; ".join(kind.written_as for kind in MESH_FORMATS)


def test_the_table_alone_imports_nothing_heavy():
    code = "import sys, meshsplats.formats.mesh_formats; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
