"""Runs of ``build_tiles`` that were ended early: what goes on, what is refused, and what nothing destroys."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from _cities import digest

import meshsplats as ms
from meshsplats._files import atomic
from meshsplats.cli import main
from meshsplats.conversion import ConversionOptions
from meshsplats.demo_scene.city import city_blocks
from meshsplats.errors import EarlierRunError, FileFormatError, OverwritingError
from meshsplats.tiles import building, start
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.tileset import Node, on_globe, write_tilesets

OPTIONS = TileOptions(max_triangles=800, alpha="mask")
COUNT = 600


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    path = tmp_path_factory.mktemp("city") / "city.ply"
    ms.save_gaussian_blocks(city_blocks(COUNT, degree=0), path, COUNT)
    return path


@pytest.fixture(scope="module")
def tileset(splats, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles") / "tileset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "BUCKET", 200)
        build_tiles(ms.stream_gaussians(splats), folder, OPTIONS)
    return folder


@pytest.fixture(autouse=True)
def small_buckets(monkeypatch):
    monkeypatch.setattr(building, "BUCKET", 200)


def ended(*_arguments, **_options):
    raise KeyboardInterrupt


def end_after(step, splats, out, **more):
    """A run that is ended right after the journal has noted that ``step``."""
    add = Journal.add

    def noted(journal, name, **facts):
        add(journal, name, **facts)
        if name == step:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "add", noted)
        with pytest.raises(KeyboardInterrupt):
            build_tiles(ms.stream_gaussians(splats), out, OPTIONS, **more)


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("end", ["finished", "rename", "handing over", "cleaning up"])
def test_a_finished_tileset_outlives_an_end_at_any_moment(splats, tileset, tmp_path, end, older):
    out = tmp_path / "tiles"
    source = ms.stream_gaussians(splats)
    if older:
        build_tiles(source, out, TileOptions(max_triangles=1600, alpha="blend"))
        (out / "index.html").write_text("mine")
    if end == "finished":
        end_after("finished", splats, out, replace_old=older)
    else:
        renames, rename = [], os.rename

        def renamed(*paths):
            if renames:
                raise KeyboardInterrupt
            renames.append(paths)
            rename(*paths)

        with pytest.MonkeyPatch.context() as patch:
            if end == "cleaning up":
                patch.setattr(building.shutil, "rmtree", ended)
            elif end == "rename":
                patch.setattr(atomic.os, "rename", renamed if older else ended)
            else:
                over = iter([lambda *_: None, ended] if older else [ended])
                patch.setattr(atomic, "_hand_over", lambda *paths: next(over)(*paths))
            with pytest.raises(KeyboardInterrupt):
                build_tiles(source, out, OPTIONS, replace_old=older)
    with pytest.raises(EarlierRunError, match=r"tiles\.partial is left from an earlier run: resume"):
        build_tiles(source, out, OPTIONS)
    summary = build_tiles(source, out, OPTIONS, resume=True)
    assert (summary.splats, summary.alpha.alpha) == (COUNT, "mask")
    found = digest(out)
    assert (found.pop("index.html", None) is not None) is older
    assert found == digest(tileset)
    assert [path.name for path in tmp_path.iterdir()] == ["tiles"]


def test_a_finished_tileset_that_was_taken_away_is_not_made_of_nothing(splats, tmp_path):
    out = tmp_path / "tiles"
    end_after("finished", splats, out)
    shutil.rmtree(tmp_path / "tiles.partial" / "tileset")
    with pytest.raises(EarlierRunError, match="which is gone: begin again with replace_old"):
        build_tiles(ms.stream_gaussians(splats), out, OPTIONS, resume=True)
    assert not out.exists()


def test_the_advice_to_resume_is_for_what_was_ended_not_for_what_is_refused(splats, tmp_path, capsys):
    out = tmp_path / "tiles"
    end_after("survey", splats, out)
    words = ["tiles", str(splats), "-o", str(out), "--max-triangles", "800", "--alpha", "mask"]
    assert main(words) == 3
    error = capsys.readouterr().err
    assert "--resume continues it, --force starts again" in error
    assert "finished work is kept" not in error
    assert main([*words, "--resume"]) == 0


def test_a_run_that_was_ended_before_its_first_step_is_none(splats, tileset, tmp_path):
    for part in ("done", "splats"):
        (tmp_path / "tiles.partial" / "work" / part).mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"nothing to resume .*: leave out resume to start"):
        build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS, resume=True)
    (tmp_path / "tiles.partial" / "work").mkdir(parents=True)
    build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS)
    assert digest(tmp_path / "tiles") == digest(tileset)


@pytest.mark.parametrize("calls", range(4))
def test_a_folder_that_is_half_removed_is_known(splats, tmp_path, calls):
    out, rmtree = tmp_path / "tiles", shutil.rmtree
    end_after("above", splats, out)
    left = iter([rmtree] * calls)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building.shutil, "rmtree", lambda *a, **o: next(left, ended)(*a, **o))
        with pytest.raises(KeyboardInterrupt):
            build_tiles(ms.stream_gaussians(splats), out, OPTIONS, replace_old=True)
    build_tiles(ms.stream_gaussians(splats), out, OPTIONS, replace_old=True)


# ---- What a run has lost


@pytest.mark.parametrize("lose", [Path.unlink, lambda path: os.truncate(path, 0)], ids=["gone", "empty"])
def test_tiles_that_are_gone_are_missed(splats, tmp_path, lose):
    end_after("above", splats, tmp_path / "tiles")
    tiles = sorted((tmp_path / "tiles.partial" / "tileset").glob("*.glb"))
    lose(tiles[0])
    with pytest.raises(FileFormatError, match=rf"{tiles[0].name} is missing or empty, though .* begin"):
        build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS, resume=True)


@pytest.mark.parametrize(("step", "files"), [("sorted", "splats/*.splats"), ("cell", "done/*.merged")])
@pytest.mark.parametrize("bytes_less", [3, 80])
def test_splats_that_are_lost_are_missed(splats, tmp_path, step, files, bytes_less):
    end_after(step, splats, tmp_path / "tiles")
    work = tmp_path / "tiles.partial" / "work"
    path = max(work.glob(files), key=lambda path: path.stat().st_size)
    os.truncate(path, path.stat().st_size - bytes_less)
    with pytest.raises(FileFormatError, match=rf"{path.name}: it has .* bytes, but .* were written: begin"):
        build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS, resume=True)


def test_leaves_have_the_splats_of_the_survey(splats, tmp_path):
    end_after("above", splats, tmp_path / "tiles")
    for path in (tmp_path / "tiles.partial" / "work" / "done").glob("cell-*.json"):
        nodes = json.loads(path.read_text())
        for node in nodes:
            node["splats"] -= not node["children"]
        path.write_text(json.dumps(nodes))
    with pytest.raises(FileFormatError, match="of 600 splats are left, though the journal has all"):
        build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS, resume=True)


# ---- What a run is about


def test_another_version_does_not_go_on(splats, tmp_path, monkeypatch):
    end_after("survey", splats, tmp_path / "tiles")
    monkeypatch.setattr(start, "__version__", "7.0.0")
    with pytest.raises(ValueError, match=rf"begun by MeshSplats {ms.__version__}, this is 7\.0\.0: tiles"):
        build_tiles(ms.stream_gaussians(splats), tmp_path / "tiles", OPTIONS, resume=True)


@pytest.mark.parametrize(
    ("changes", "reading", "message"),
    [
        ({"max_triangles": 1600}, {}, "other options: ``max_triangles`` 800, not 1600; ``resume`` with"),
        ({"conversion": ConversionOptions(look="splats")}, {}, "``look`` not given, not splats;"),
        ({"up": (0.0, 0.0, 1.0), "lit": True}, {}, "``up`` 0 -1 0, not 0 0 1, ``lit`` False, not True;"),
        ({"place": "local"}, {}, "other options: place world, not local;"),
        ({}, {"axes": "y-up"}, "other reading: ``axes`` auto, not y-up;"),
        ({}, {"origin": (1, 2, 0.5)}, "other origin: 0 0 0, not 1 2 0.5;"),
    ],
)
def test_what_differs_is_named(splats, tmp_path, changes, reading, message):
    out = tmp_path / "tiles"
    end_after("survey", splats, out)
    options = TileOptions(**{"max_triangles": 800, "alpha": "mask"} | changes)
    with pytest.raises(ms.FileFormatError, match="was started with other") as caught:
        build_tiles(ms.stream_gaussians(splats, **reading), out, options, resume=True)
    assert message in caught.value.spelled("``{}``".format)


def test_which_file_differs_is_named(splats, tmp_path):
    one, other = tmp_path / "one.ply", tmp_path / "other.ply"
    for path in (one, other):
        shutil.copy(splats, path)
    end_after("survey", one, tmp_path / "tiles")

    def refused(*files):
        with pytest.raises(ValueError, match="started with other files") as caught:
            build_tiles(ms.stream_gaussians(files), tmp_path / "tiles", OPTIONS, resume=True)
        return str(caught.value)

    assert f"files: {one}, not {other};" in refused(other)
    assert "files: 1 file, not 2;" in refused(one, other)
    os.utime(one, (0, 0))
    assert f"files: {one} has changed;" in refused(one)


def test_files_beside_the_one_that_is_named_count(splats, tmp_path):
    ms.save_gaussians(ms.load_gaussians(splats), tmp_path / "city.sog")
    with zipfile.ZipFile(tmp_path / "city.sog") as archive:
        archive.extractall(tmp_path / "city")
    scene = tmp_path / "city" / "meta.json"
    end_after("survey", scene, tmp_path / "city" / "tiles")
    (tmp_path / "city" / "notes.txt").write_text("of no matter")
    end_after("sorted", scene, tmp_path / "city" / "tiles", resume=True)
    os.utime(tmp_path / "city" / "sh0.webp", (0, 0))
    with pytest.raises(ValueError, match=r"meta\.json has changed, or a file beside it;"):
        build_tiles(ms.stream_gaussians(scene), tmp_path / "city" / "tiles", OPTIONS, resume=True)


def test_files_are_named_by_documents_of_any_depth(tmp_path):
    inner = tmp_path / "0_0" / "meta.json"
    inner.parent.mkdir()
    inner.write_text(json.dumps({"means": {"files": ["means_l.webp"]}}))
    (tmp_path / "0_0" / "means_l.webp").write_text("image")
    outer = tmp_path / "lod-meta.json"
    outer.write_text(json.dumps({"filenames": ["0_0/meta.json", "missing.json", "\0", "x" * 2000]}))
    assert start._named_by(outer) == {inner, inner.parent / "means_l.webp"}
    (tmp_path / "scene.lcc").write_text("{}")
    (tmp_path / "data.bin").write_text("splats")
    assert start._named_by(tmp_path / "scene.lcc") == {tmp_path / "data.bin"}
    (tmp_path / "a.json").write_text("no document")
    assert start._named_by(tmp_path / "a.json") == set()


def test_a_file_is_taken_once(splats, tmp_path):
    with pytest.raises(ValueError, match=r"city\.ply is given twice: .*; give it once"):
        build_tiles(ms.stream_gaussians([splats, splats]), tmp_path / "tiles", OPTIONS)
    link = tmp_path / "link.ply"
    try:
        link.symlink_to(splats)
    except OSError:
        pytest.skip("no symbolic links here")
    with pytest.raises(ValueError, match=r"city\.ply and .*link\.ply are one file"):
        build_tiles(ms.stream_gaussians([splats, link]), tmp_path / "tiles", OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["link.ply"]


def test_the_splats_of_a_tileset_are_not_replaced_by_tiles_of_them(splats, tmp_path):
    folder = tmp_path / "city"
    build_tiles(ms.stream_gaussians(splats), folder, TileOptions(as_splats=True))
    before = digest(folder)
    for named in (folder, tmp_path / "." / "city" / "tileset.json"):
        with pytest.raises(OverwritingError, match=r"tileset\.json is read, .*: give another folder"):
            build_tiles(ms.stream_gaussians(named), folder, OPTIONS, replace_old=True)
    assert main(["tiles", str(folder), "-o", str(folder), "--force"]) == 2
    assert digest(folder) == before
    assert not (tmp_path / "city.partial").exists()
    start.need_other_folder([folder / "mine.ply", splats], folder)  # what is not of the tileset stays


def test_one_scene_in_two_formats_is_told_of(splats, tmp_path, recwarn):
    cloud = ms.load_gaussians(splats)
    for name in ("a.ply", "a.spz", "b.ply"):
        ms.save_gaussians(cloud, tmp_path / name)
    ms.save_gaussians(cloud.transformed(np.eye(3) * 2), tmp_path / "b.spz")
    build_tiles(ms.stream_gaussians(tmp_path), tmp_path / "tiles", OPTIONS)
    told = [str(warning.message) for warning in recwarn if "in two formats" in str(warning.message)]
    assert len(told) == 1
    assert "a.ply and " in told[0]
    assert "a.spz look like one scene in two formats" in told[0]


# ---- What is shown


def test_phases_and_shares(splats, tmp_path):
    shown = []
    source = ms.stream_gaussians([splats, shutil.copy(splats, tmp_path / "more.ply")])
    options = TileOptions(max_triangles=800)
    build_tiles(source, tmp_path / "tiles", options, on_progress=lambda *what: shown.append(what))
    names = list(dict.fromkeys(name for name, _ in shown))
    assert names == [
        "surveying the splats",
        "sorting the splats",
        "making the tiles",
        "choosing the alpha mode",
    ]
    shares = {name: [share for other, share in shown if other == name] for name in names}
    assert shares["surveying the splats"] == [None, 0.75, 1]
    assert shares["sorting the splats"] == [None, 0.5, 1]
    assert shares["making the tiles"][0] is None
    assert shares["making the tiles"][-1] == 1
    assert sorted(shares["making the tiles"][1:]) == shares["making the tiles"][1:]


def test_a_log_has_lines(splats, tmp_path, capsys):
    words = ["tiles", str(splats), "-o", str(tmp_path / "tiles"), "--max-triangles", "800"]
    assert main([*words, "--alpha", "mask"]) == 0
    lines = [f"meshsplats: {name} the {what}" for name, what in PHASES]
    assert [line for line in capsys.readouterr().err.splitlines() if line in lines] == lines


PHASES = [("surveying", "splats"), ("sorting", "splats"), ("making", "tiles")]


# ---- Places and boxes


def write_at(path: Path, origin, spread=20.0):
    cloud = next(city_blocks(200, degree=0))
    rng = np.random.default_rng(0)
    fields = {name: getattr(cloud, name) for name in ("quaternions", "scales", "opacities", "sh")}
    means = rng.uniform(-spread, spread, (200, 3)).astype(np.float32)
    ms.save_gaussians(ms.GaussianCloud(means, **fields, origin=np.array(origin)), path)
    return means


PARIS = [4_206_000.0, 169_000.0, 4_776_000.0]


@pytest.mark.parametrize("up", [None, (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_splats_of_the_globe_are_at_their_place_whatever_is_up(tmp_path, up):
    means = write_at(tmp_path / "paris.ply", PARIS)
    options = TileOptions(max_triangles=10_000, alpha="mask", up=up)
    assert build_tiles(ms.stream_gaussians(tmp_path / "paris.ply"), tmp_path / "tiles", options).on_globe
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    center = (matrix @ [*root["boundingVolume"]["box"][:3], 1])[:3]
    np.testing.assert_allclose(center, PARIS + (means.min(axis=0) + means.max(axis=0)) / 2, atol=3)
    assert ms.Tileset(tmp_path / "tiles").root.triangles


def test_which_origins_are_of_the_globe():
    up = np.array([0, 0, 1.0])
    assert on_globe(np.array(PARIS), -up)
    assert on_globe(np.array([6.378e6, 0, 0]), np.array([1.0, 0, 0]))
    assert not on_globe(np.array([500_000, 6_370_000, 120.0]), up)  # of a map, as far from its middle
    assert not on_globe(np.array([600_000, 120, -6_280_000.0]), np.array([0, 1.0, 0]))  # turned to y up
    assert on_globe(np.array([600_000, 120, -6_280_000.0]), np.array([0.09, 0, -1]))  # at the south pole
    assert not on_globe(np.array([0, 0, 0.0]), up)


def test_coordinates_of_a_map_are_told_of(tmp_path, capsys):
    text = "coordinates of a map, not of the globe: docs/tiles.md says how CesiumJS can show them"
    write_at(tmp_path / "map.ply", [431_000.0, 5_412_000.0, 100.0])
    write_at(tmp_path / "paris.ply", PARIS)
    for name, more, told in (("map", [], True), ("map", ["--origin", "local"], False), ("paris", [], False)):
        out = tmp_path / f"{name}{len(more)}"
        words = ["tiles", str(tmp_path / f"{name}.ply"), "-o", str(out), "--alpha", "mask"]
        assert main([*words, *more]) == 0
        out, err = capsys.readouterr()
        assert (text in err) is told
        assert ("next: docs/tiles.md has a page that shows it in CesiumJS" in out) is (name == "map")


def test_boxes_lie_in_those_of_their_parents(tmp_path):
    """With a stray far away, and with faces that they share."""
    rng = np.random.default_rng(0)
    nodes = {}
    for i in range(8):
        low = rng.uniform(-1, 1, 3) + (5e6 if i == 7 else 0)
        high = low + rng.uniform(0, 1e-3, 3)
        nodes[f"0{i}"] = Node(f"0{i}", low.tolist(), high.tolist(), 0.0, 1, 1, 3, [])
    corners = [np.array([[node.low, node.high] for node in nodes.values()])]
    low, high = corners[0].min(axis=(0, 1)).tolist(), corners[0].max(axis=(0, 1)).tolist()
    nodes["0"] = Node("0", low, high, 1.0, 1, 1, 3, sorted(nodes))
    nodes[""] = Node("", low, high, 2.0, 1, 1, 3, ["0"])
    write_tilesets(tmp_path, nodes, "", np.array([0, 0, 1.0]), 8, np.zeros(3))

    def sides(tile):
        box = np.array(tile["boundingVolume"]["box"])
        half = box[3:].reshape(3, 3).diagonal()
        return box[:3] - half, box[:3] + half

    def check(tile):
        for child in tile.get("children", []):
            (low, high), (least, most) = sides(tile), sides(child)
            assert (low <= least).all()
            assert (high >= most).all()
            check(child)

    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    check(root)
    near = sides(root["children"][0]["children"][0])
    assert (near[1] - near[0] < 2e-3).all()
