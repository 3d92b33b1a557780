"""What the commands do with files, done by a program of one's own."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated
from zipfile import ZipFile

import numpy as np
import pytest
from _datasets import simple_colmap
from _glb import edit_glb
from _priors import bumpy
from _splats import few_splats
from PIL import Image

import meshsplats as ms
from meshsplats._common.options import Help, settings
from meshsplats.blender.files import PictureOptions
from meshsplats.cli import main
from meshsplats.cluster import Workers
from meshsplats.conversion.cleaning_rules import FLOATERS, CleaningRules
from meshsplats.datasets.scene_files import PartOfScene, SceneReading
from meshsplats.datasets.scene_views import SceneViews, check_photographs
from meshsplats.errors import DataWarning, OptionsError, OptionValueError
from meshsplats.evaluation.comparison_files import save_comparison
from meshsplats.evaluation.level_tables import load_table, table_in_words
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.evaluation.options import ComparisonOptions
from meshsplats.finetuning.file_tuning import FileTuning
from meshsplats.finetuning.plans import RunResult
from meshsplats.finetuning.run import RunOptions
from meshsplats.finetuning.setup import Setup
from meshsplats.finetuning.start_options import StartOptions
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.outputs import check_mesh_suffix, check_splat_endings, placed
from meshsplats.operations.batches import formats_of
from meshsplats.operations.chains import make_chain
from meshsplats.operations.edits import EditCallbacks, bake_file, clean_file, simplify_file
from meshsplats.operations.inspection import describe
from meshsplats.operations.options import (
    BakingOptions,
    ChainOptions,
    LevelTuning,
    ScoringOptions,
    SimplifyOptions,
)
from meshsplats.operations.product import Product
from meshsplats.operations.scoring import Scoring
from meshsplats.prior.options import LayingOptions
from meshsplats.prior.planning import PriorTraining, pose_files, save_poses
from meshsplats.renders.options import ImageOptions
from meshsplats.renders.saving import ImageRun
from meshsplats.surfaces.files import SurfaceFileOptions
from meshsplats.surfaces.options import SurfaceOptions
from meshsplats.tiles.options import TilingOptions
from meshsplats.tiles.source import open_tileset
from meshsplats.training.photographs import PhotographOptions
from meshsplats.viewer.files import ViewingOptions, shown_file

SMALL = SceneViews(orbit=2, width=24)


@pytest.fixture
def files(tmp_path):
    """A folder with splats and their mesh."""
    ms.save_gaussians(few_splats(), tmp_path / "s.ply")
    ms.save_mesh(ms.convert(few_splats()), tmp_path / "m.npz")
    return tmp_path


def test_large_splats_are_named_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr("meshsplats.datasets.scene_files.LARGE_BYTES", 500)
    told = []
    monkeypatch.setattr(SceneReading, "tell", lambda self, text: told.append(text))
    folder, broken = tmp_path / "sog", tmp_path / "broken.ply"
    ms.save_gaussians(few_splats(), tmp_path / "s.sog")
    with ZipFile(tmp_path / "s.sog") as archive:
        archive.extractall(folder)
    SceneReading().load(folder / "meta.json")
    size = sum(file.stat().st_size for file in folder.iterdir())
    size -= (folder / "meta.json").stat().st_size
    assert told == [f"reading {size / 1000:.1f} kB"]
    (folder / "holiday.mp4").write_bytes(bytes(5000))
    (folder / "holiday").mkdir()
    (folder / "holiday" / "beach.webp").write_bytes(bytes(5000))
    SceneReading().load(folder / "meta.json")
    assert told.pop() == told[0]
    broken.write_bytes(b"ply" + 600 * b" ")
    with pytest.raises(ms.FileFormatError):
        SceneReading().load(broken)
    assert told[1:] == ["reading 603 bytes"]


def test_long_work_is_told_of_before_it_begins(files, monkeypatch, capsys):
    told = []
    monkeypatch.setattr(SceneReading, "tell", lambda self, text: told.append(text))
    clean_file(files / "s.ply", files / "few.ply", CleaningRules(min_opacity=0.01))
    assert not told
    monkeypatch.setattr("meshsplats.datasets.scene_files.LARGE_COUNT", 40)
    clean_file(files / "s.ply", files / "clean.ply", CleaningRules(min_opacity=0.01))
    simplify_file(files / "s.ply", files / "few.ply", SimplifyOptions(count=20), force=True)
    shown_file(files / "s.ply", ViewingOptions())
    assert told == [
        "looking for floaters among 40 splats",
        "merging 40 splats to 20",
        "looking for views of 40 splats",
        "converting 40 splats",
    ]
    assert main(["convert", str(files / "s.ply"), "-o", str(files / "new.npz"), "--no-preview"]) == 0
    assert "meshsplats: converting 40 splats" in capsys.readouterr().err
    main(["cameras", str(files / "s.ply"), "-o", str(files / "c.json"), "--width", "20"])
    assert "meshsplats: looking for views of 40 splats" in capsys.readouterr().err


def test_errors_name_options_as_python_and_as_commands_do():
    error = OptionsError("``as_splats`` has no effect with ``mesh``")
    assert str(error) == "as_splats has no effect with mesh"
    assert error.spelled(str.upper) == "AS_SPLATS has no effect with MESH"
    with pytest.raises(OptionValueError, match=r"^fidelity must be a number of views, at least 1, got 0$"):
        Product(fidelity=0).check(["glb"], [], Path("a.glb"))


def test_help_may_stand_in_a_mark():
    @dataclass
    class Options:
        a: Annotated[int, Help("Made of a table.")] = 1

    assert settings(Options)["a"].help == "Made of a table."


def test_reading_tells_what_headers_say(files):
    told = []

    class Telling(SceneReading):
        def tell(self, text: str) -> None:
            told.append(text)

    ms.save_gaussians(replace(few_splats(), kernel="antialiased", up=np.array([0, 0, 1.0])), files / "a.ply")
    assert len(Telling().load(files / "a.ply")) == 40
    assert told == ["up: z, from the file's header", "kernel: antialiased, from the file"]
    told.clear()
    Telling(kernel="antialiased").load(files / "a.ply", up="y")
    assert told == []
    assert isinstance(SceneReading().load_scene(files / "m.npz"), ms.SplatMesh)
    with pytest.raises(OptionsError, match="holds no splats: kernel, time would"):
        SceneReading(kernel="2dgs", time=1.0).load_scene(files / "m.npz")
    with pytest.raises(ms.FileFormatError, match="a mesh, not splats"):
        SceneReading().load(files / "m.npz")


def test_outputs_have_names_and_places():
    assert placed(replace(few_splats(), origin=np.ones(3)), "local").origin.tolist() == [0, 0, 0]
    moved = placed(replace(few_splats(), origin=np.ones(3)), (1.0, 1.0, 2.0))
    np.testing.assert_allclose(moved.means, few_splats().means - [0, 0, 1], atol=1e-6)
    with pytest.raises(OptionsError, match="origin: too far from the scene"):
        placed(few_splats(), (1e12, 0, 0))
    with pytest.raises(OptionsError, match=r"output must end in .*, got 'a.stl'; 'meshsplats surface' makes"):
        check_mesh_suffix(Path("a.stl"))
    with pytest.raises(OptionsError, match=r"not as .glb2"):
        check_splat_endings("ply", "glb2")
    assert formats_of(Path("folder"), (), folder=True, as_splats=True) == ("ply",)
    assert formats_of(Path("folder"), ("ply", "glb"), folder=True, as_splats=False) == ("ply", "glb")
    assert formats_of(Path("a.npz"), (), folder=False, as_splats=False) == ()
    with pytest.raises(OptionsError, match="several inputs or formats need a folder: output a, say"):
        formats_of(Path("a.glb"), (), folder=True, as_splats=False)
    assert pose_files(Path("a.glb"), 1) == [Path("a.glb")]
    assert pose_files(Path("a.glb"), 2) == [Path("a_0001.glb"), Path("a_0002.glb")]


def test_images_are_files(files):
    options = ImageOptions(views=SMALL, depth="npy", animation="png")
    made = ImageRun(files / "s.ply", files / "images", options).save()
    assert [path.name for path in made.files.images] == ["view_0000.png", "view_0001.png"]
    assert all(path.is_file() for path in (*made.files.images, *made.files.depths, made.files.cameras))
    assert made.files.turntable is not None
    assert made.files.turntable.is_file()
    assert not made.files.config.exists(), "the record is the program's"
    with pytest.raises(FileExistsError):
        ImageRun(files / "s.ply", files / "images", options).save()
    with pytest.raises(OptionsError, match=r"2 views do not fit one .png"):
        ImageRun(files / "s.ply", files / "one.png", options).save()
    with pytest.raises(OptionsError, match="max_error is for tilesets"):
        open_tileset(files / "s.ply", max_error=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transparent": True, "animation": "gif"}, "GIF has no translucency"),
        ({"as_splats": True, "depth": "png"}, "depth is that of a mesh"),
        ({"as_splats": True, "cutoff": 0.5}, "cutoff is for a mesh"),
        ({"views": SceneViews(orbit=1, dome=2)}, "give one of orbit, dome, not several"),
        ({"views": SceneViews(dome=2, azimuth=3.0)}, "azimuth has no effect with dome"),
        ({"views": SceneViews(downscale=2)}, "downscale has no effect without data"),
    ],
)
def test_images_need_options_that_agree(options, message):
    with pytest.raises(OptionsError, match=message):
        ImageOptions(**options).check(Path("images"))


def test_photographs_have_options_of_their_own():
    with pytest.raises(OptionsError, match="give cameras or data, not both"):
        check_photographs(Path("d"), "few", Path("c"))
    with pytest.raises(OptionsError, match="masks has no effect without data"):
        check_photographs(None, "few", masks="subject")
    with pytest.raises(ValueError, match=r"^cache must be a number of gigabytes"):
        PhotographOptions(cache=-1.0).check()


def test_a_comparison_is_a_folder(files):
    options = ComparisonOptions(views=SMALL)
    made = save_comparison(files / "s.ply", files / "m.npz", files / "out", options)
    saved = json.loads((files / "out" / "results.json").read_text())
    assert saved == made.result
    assert [view.name for view in made.scores.views] == ["view_0000", "view_0001"]
    assert saved["splats"] == 40
    assert saved["mean"]["psnr"] == made.scores.psnr > 25
    assert (files / "out" / "view_0001.png").is_file()
    box = replace(options, part=PartOfScene(crop=(-1, -1, -1, 1, 1, 1)))
    part = save_comparison(files / "s.ply", files / "m.npz", files / "part", box)
    assert part.result["splats"] < 40
    with pytest.raises(ms.FileFormatError, match="not a mesh; give splats first"):
        save_comparison(files / "s.ply", files / "s.ply", files / "none", options)


def test_scores_are_a_folder(files):
    ms.save_cameras(ms.orbit(few_splats(), 2, width=24, height=24), files / "cameras.json")
    options = ScoringOptions(splats=files / "s.ply", cameras=files / "cameras.json", strips=1)
    shown = []
    report = Scoring(options, files / "out", progress=lambda views, count: shown.append(count) or views).run(
        [files / "m.npz"]
    )
    assert json.loads((files / "out" / "report.json").read_text()) == report.to_dict()
    assert (report.about["held_out"], report.about["background"], shown) == (None, [1.0, 1.0, 1.0], [2])
    assert len(list((files / "out" / "strips").iterdir())) == 1
    with pytest.raises(FileExistsError):
        Scoring(options, files / "out").run([files / "m.npz"])
    with pytest.raises(OptionsError, match="nothing to compare with"):
        ScoringOptions().check([files / "m.npz"])
    with pytest.raises(OptionsError, match="tune is for protocol"):
        replace(options, tune="paper").check([files / "m.npz"])
    wrong = Scoring(replace(options, amplify=-1.0), files / "wrong")
    with pytest.raises(OptionValueError, match="amplify must be positive"):
        wrong.run([files / "m.npz"])
    with pytest.raises(OptionsError, match="give protocol, and data with its scenes"):
        Scoring(options, files / "wrong").run_benchmark(files, Workers)
    assert not (files / "wrong").exists()


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda a: ImageOptions(depth="jpg").check(a), "depth must be one of none, png, npy, got 'jpg'"),
        (lambda a: ComparisonOptions(look="real").check(), "look must be one of area, splats, got 'real'"),
        (lambda a: ScoringOptions(network="vgg16").check([a]), "network must be one of vgg, alex"),
        (lambda a: MeshFileOptions(alpha="solid").check(["glb"]), "alpha must be one of auto, blend"),
        (lambda a: Product(spz_version=5).check(["spz"], [a], a), "spz_version must be one of 3, 4, got 5"),
        (lambda a: Product(origin="world").check(["glb"], [a], a), "origin must be 'keep', 'local' or three"),
        (lambda a: placed(few_splats(), "world"), "origin must be 'keep', 'local' or three"),
        (lambda a: ChainOptions(format="fbx").check(), "format must be one of glb"),
        (lambda a: PictureOptions(lights="moon").scene_options(a), "lights must be one of sun, noon"),
        (lambda a: LayingOptions(colors="red").check(), "colors must be one of auto, texture"),
    ],
)
def test_words_that_no_option_has_are_refused_before_the_work(check, message):
    with pytest.raises(ValueError, match=message):
        check(Path("a.png"))


def test_a_page_shows_a_file(files):
    shown = shown_file(files / "m.npz", ViewingOptions(splats=files / "s.ply"))
    page, sizes = shown.page("scene")
    assert "<title>scene" in page.html
    assert (sizes["triangles"], sizes["splats"]) == (len(ms.convert(few_splats()).faces), 40)
    for options, message in (
        (ViewingOptions(splats=files / "s.ply"), "splats is for a mesh"),
        (ViewingOptions(whole=True, max_triangles=9), "give max_triangles or whole, not both"),
        (ViewingOptions(max_triangles=7), "max_triangles must be from 8"),
    ):
        with pytest.raises(OptionsError, match=message):
            shown_file(files / "s.ply", options)


def test_a_page_shows_photographs_stored_on_their_side_upright(files):
    folder = simple_colmap(files / "photos", 2)
    exif = Image.Exif()
    exif[0x112] = 6
    for path in (folder / "images").iterdir():
        Image.open(path).save(path, exif=exif)
    shown = shown_file(files / "m.npz", ViewingOptions(data=folder))
    assert [(camera.width, camera.height) for camera in shown.cameras] == [(8, 12)] * 2


def test_floaters_are_taken_out_of_a_file(files):
    made = clean_file(files / "s.ply", files / "out.ply", CleaningRules(min_opacity=0.5))
    assert len(ms.load_gaussians(files / "out.ply")) == int(made.found.kept.sum()) < 40
    assert made.preview.is_file()
    assert made.extent[0] == [round(float(v), 4) for v in made.left.means.min(axis=0)]
    looked = clean_file(files / "s.ply", files / "not.ply", CleaningRules(), preview_only=True)
    assert looked.rules == FLOATERS
    assert not (files / "not.ply").exists()
    with pytest.raises(OptionsError, match="output must end in"):
        clean_file(files / "m.npz", files / "m.sog")


def test_splats_of_a_file_are_merged(files):
    noted = []
    callbacks = EditCallbacks(record=noted.append, draw=lambda cloud, path, camera: noted.append(len(cloud)))
    made = simplify_file(files / "s.ply", files / "out.ply", SimplifyOptions(share=0.5), callbacks)
    assert (made.read, len(made.kept), len(ms.load_gaussians(files / "out.ply"))) == (40, 20, 20)
    assert noted == [files / "out.ply.config.toml", 20]
    assert SimplifyOptions(count=3).wanted(40) == 3
    with pytest.raises(OptionsError, match="give count or share, one of them"):
        SimplifyOptions(count=3, share=0.5).check()
    with pytest.raises(ms.FileFormatError, match="simplify needs a splat file"):
        simplify_file(files / "m.npz", files / "no.ply", SimplifyOptions(count=1))


def test_a_filter_becomes_part_of_a_mesh(files):
    made = bake_file(files / "m.npz", files / "out.npz", BakingOptions(views=SMALL, filter_px2=0.5))
    np.testing.assert_array_equal(ms.load_mesh(files / "out.npz").vertices, made.mesh.vertices)
    assert made.in_words() == "a filter of 0.5 px^2 for 2 views of 24 x 24"
    with pytest.raises(ValueError, match="nothing to bake"):
        bake_file(files / "m.npz", files / "no.npz", BakingOptions())


def test_products_need_options_that_agree():
    output = Path("a.glb")
    for product, message in (
        (Product(collider=output), "with_mesh and collider go beside splats"),
        (Product(as_splats=True, preset="paper"), "preset: for a mesh, no effect with as_splats"),
        (Product(stream=True), "stream writes .ply"),
    ):
        with pytest.raises(OptionsError, match=message):
            product.check(["ply"] if product.as_splats else ["glb"], [], output)
    assert Product(conversion=ms.ConversionOptions(footprint="filter")).look == "splats"


def test_a_chain_is_told_in_a_table(files):
    assert LevelTuning(steps=3).config() == ms.make_config(steps=3)
    assert LevelTuning(no_tune=True).config() is None
    assert LevelTuning().config().minutes == 2
    with pytest.raises(OptionsError, match="give minutes or steps, not both"):
        LevelTuning(minutes=1, steps=1).config()
    with pytest.raises(OptionsError, match=r"alpha mask is for .glb files, not .npz"):
        ChainOptions(alpha="mask", format="npz").check()
    table = make_chain(few_splats(), files / "chain", ChainOptions(levels=1, width=24))
    assert load_table(files / "chain" / "levels.json") == table
    lines = table_in_words(table)
    assert lines[1].split()[:2] == ["level_0.glb", "40"]
    assert lines[0].endswith("alpha")
    assert lines[-1].startswith("look area: ")


def test_surfaces_and_tiles_need_options_that_agree():
    with pytest.raises(OptionsError, match="wants a solid: shape closed"):
        SurfaceFileOptions(surface=SurfaceOptions(shape="open")).checked(Path("a.stl"))
    with pytest.raises(OptionsError, match="scale must be above 0"):
        SurfaceFileOptions(scale=0.0).checked(Path("a.glb"))
    assert SurfaceFileOptions().checked(Path("a.glb")) == SurfaceOptions()
    tiles = TilingOptions(up="z", min_opacity=0.5).tile_options("local")
    assert (tiles.up, tiles.place, tiles.conversion.min_opacity) == ((0, 0, 1), "local", 0.5)


def test_blender_needs_options_that_agree():
    output = Path("a.png")
    assert PictureOptions(fast=True).scene_options(output).samples == 4
    assert PictureOptions().scene_options(Path("a.blend")).samples == 1
    assert PictureOptions(lit=True, light=ms.blender.LightOptions(glass=True)).chosen_views().distance == 1.7
    for options, message in (
        (PictureOptions(no_denoise=True), "no_denoise is for lit with Cycles"),
        (PictureOptions(light=ms.blender.LightOptions(sky=1.0)), "the options of light need lit"),
        (PictureOptions(format="exr"), "the name given with output decides"),
    ):
        with pytest.raises(OptionsError, match=message):
            options.scene_options(output)


class Silent:
    def phase(self, text, share=None):
        pass

    def __call__(self, progress):
        pass


def test_a_file_is_tuned_as_planned(files):
    tuning = FileTuning(
        files / "s.ply",
        files / "out.npz",
        Targets(views=4, held_out=2, width=24),
        StartOptions(),
        SceneReading(),
        (),
        lambda threads: nullcontext(Workers(threads)),
        lambda text: None,
    )
    tuning.files.folder.mkdir()
    config = ms.make_config(steps=2)
    plan = tuning.plan(config, None, Setup(Silent(), 0.0, None))
    assert "4 training views, 2 held out, of 24 x 24 pixels; memory: about" in plan.in_words(1 << 20)
    trained = plan.optimise(RunOptions(folder=tuning.files.folder, report_every=1), Silent())
    ms.save_mesh(trained.saved, tuning.files.mesh)
    result = RunResult(tuning.files, trained, 1.5, plan.scored(config), 2)
    told = result.to_dict()
    assert (told["steps"], told["seconds"], told["triangles"]) == (2, 1.5, len(trained.saved.faces))
    assert told["held_out_psnr"]["after"] > 20
    first = next(iter(result.in_words()))
    assert f"{len(trained.saved.faces):,} triangles): 2 steps in 1.5 s; held out: " in first
    assert first.endswith("(look area, 2 x 2 samples)")


def test_a_glb_with_an_animation_is_no_film_and_says_so(tmp_path):
    ms.save_mesh(ms.bind(bumpy(2)).mesh, tmp_path / "prior.npz")
    ms.save_base(bumpy(2), tmp_path / "a.glb")
    edit_glb(
        tmp_path / "a.glb", lambda document: document.update(animations=[{"channels": [], "samplers": []}])
    )
    with pytest.warns(DataWarning, match=r"a\.glb: holds an animation, .* export it as \.usdc"):
        files = save_poses(tmp_path / "prior.npz", [tmp_path / "a.glb"], tmp_path / "p.npz")
    assert files == {tmp_path / "p.npz": tmp_path / "a.glb"}


def test_priors_need_options_that_agree(tmp_path):
    from meshsplats.formats.base_meshes import save_base

    base, prior = bumpy(2), tmp_path / "prior.npz"
    ms.save_mesh(ms.bind(base).mesh, prior)
    for name, factor in (("a", 1.0), ("b", 2.0)):
        save_base(replace(base, vertices=base.vertices * np.float32(factor)), tmp_path / f"{name}.ply")
    bases = [tmp_path / "a.ply", tmp_path / "b.ply"]
    (tmp_path / "there.npz").touch()
    with pytest.raises(FileExistsError):  # when it is called
        save_poses(prior, bases[:1], tmp_path / "there.npz")
    poses: list[ms.SplatMesh] = []
    one, two = save_poses(prior, bases, tmp_path / "p.npz", place=lambda mesh: poses.append(mesh) or mesh)
    first, second = poses
    assert [one, two] == pose_files(tmp_path / "p.npz", 2)
    np.testing.assert_allclose(second.vertices, 2 * first.vertices, atol=1e-5)
    np.testing.assert_array_equal(ms.load_mesh(two).vertices, second.vertices)
    with pytest.raises(OptionsError, match="spacing has no effect with one layer"):
        LayingOptions(layers=1, spacing=0.1).check()
    given = (LayingOptions(), Targets(), None, SceneReading(), print)
    with pytest.raises(OptionsError, match=r"which keep the binding, got 'p.obj'"):
        PriorTraining(tmp_path / "a.ply", tmp_path / "p.obj", *given).check()
    with pytest.raises(OptionsError, match="give photographs with data, or splats with splats"):
        PriorTraining(tmp_path / "a.ply", tmp_path / "p.npz", *given).check()


def test_functions_of_files_take_paths_of_any_kind(files, monkeypatch):
    """Text as well as ``Path``, as ``load_gaussians`` does; anything else is named at once."""
    ply, mesh, folder = (files / name for name in ("s.ply", "m.npz", "texts"))
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert clean_file(str(ply), "clean.ply").preview == Path("clean.ply.preview.png")
    simplify_file(str(ply), "few.ply", SimplifyOptions(count=5, no_preview=True))
    views = SceneViews(width=16)
    bake_file(str(mesh), "baked.npz", BakingOptions(views=views, filter_px2=0.3))
    save_comparison(str(ply), str(mesh), "compared", ComparisonOptions(views=replace(views, orbit=1)))
    ImageRun(str(ply), "image.png", ImageOptions(views=views)).save()
    Scoring(ScoringOptions(splats=ply, strips=0, cameras=Path("image.png.cameras.json")), "scores").run(
        [str(mesh)]
    )
    assert describe(str(ply))["kind"] == "splats"
    made = ("clean.ply", "few.ply", "baked.npz", "compared", "image.png", "scores")
    assert all(Path(name).exists() for name in made)
    before = sorted(folder.iterdir())
    for call in (
        lambda: clean_file(1, "a.ply"),
        lambda: simplify_file(ply, None, SimplifyOptions(count=5)),
        lambda: bake_file(ms.load_mesh(mesh), "a.npz", BakingOptions()),
        lambda: save_comparison(ply, mesh, 2, ComparisonOptions()),
        lambda: ImageRun(ms.load_gaussians(ply), "a.png"),
        lambda: Scoring(ScoringOptions(), 3),
        lambda: describe(ms.load_mesh(mesh)),
        lambda: save_poses(mesh, [4], "a.npz"),
        lambda: make_chain(ms.load_gaussians(ply), 5),
    ):
        with pytest.raises(TypeError, match="must be a path, got "):
            call()
    assert sorted(folder.iterdir()) == before
