"""Scores of images against known ground truth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from _datasets import simple_colmap

from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_views
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.evaluation.benchmarks import BENCHMARKS, Benchmark, find_input, run_benchmark
from meshsplats.evaluation.metrics import ssim
from meshsplats.evaluation.report import (
    COLUMNS,
    MethodScores,
    Report,
    ViewScores,
    evaluate,
    image_of,
    masked_ssim,
)
from meshsplats.evaluation.strips import image_folder, markdown_table, worst_window
from meshsplats.images.writing import save_image
from meshsplats.rendering import render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

CAMERA = Camera(np.eye(4), 10, 10, 12, 8, 24, 16, name="a/one.png")


def quad(color, *, half=0.5, blending="display") -> SplatMesh:
    """A square before the camera, at depth 1: it covers columns 7 to 16, rows 3 to 12."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half + [0, 0, 1]
    return SplatMesh(corners, [[0, 1, 2], [0, 2, 3]], np.tile(color, (4, 1)), blending=blending)


def view(color, alpha=None, mask=None, camera=CAMERA, background=(1.0, 1.0, 1.0)) -> View:
    shape = (camera.height, camera.width)
    image = np.broadcast_to(np.asarray(color, np.float32), (*shape, 3)).copy()
    return View(camera, ViewImage(image, alpha, mask), background)


def test_psnr_by_hand_and_on_the_views_background():
    """The square covers 100 of 384 pixels and differs by 0.1 there; elsewhere both are background."""
    inside = np.zeros((16, 24), np.float32)
    inside[3:13, 7:17] = 1
    target = View(
        CAMERA, ViewImage(np.float32(0.5) * inside[..., None].repeat(3, 2), inside), (0.2, 0.4, 0.6)
    )
    report = evaluate(quad([0.6, 0.6, 0.6, 1]), Dataset((), (target,)))
    scores = report.method("mesh").views[0]
    assert scores.psnr == pytest.approx(10 * np.log10(384 / (100 * 0.01)), abs=1e-4)
    assert scores.name == "a/one.png"
    assert scores.floaters == 0
    assert (scores.lpips, scores.psnr_exposure) == (None, None)


class Differing:
    """In place of LPIPS: the largest difference of two images."""

    network, convention = "vgg", "3dgs"

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        return float(np.round(np.abs(a - b).max(), 5))


def test_masked_pixels_do_not_count():
    mask = np.ones((16, 24), bool)
    mask[:, :12] = False
    wrong = np.full((16, 24, 3), 0.5, np.float32)
    wrong[:, :12] = 0.9
    target = View(CAMERA, ViewImage(wrong, None, mask))
    perfect = quad([0.5, 0.5, 0.5, 1], half=20)
    scores = evaluate(perfect, Dataset((), (target,))).method("mesh").views[0]
    assert scores.psnr > 100
    assert scores.ssim == pytest.approx(1, abs=1e-6)
    measured = evaluate(perfect, Dataset((), (target,)), lpips=Differing())
    assert measured.method("mesh").views[0].lpips == 0
    nothing = View(CAMERA, ViewImage(wrong, None, ~mask & mask))
    with pytest.warns(DataWarning, match="1 of 2 held-out photographs are not scored"):
        both = evaluate(perfect, Dataset((), (nothing, target)))
    assert both.method("mesh").views == (scores,)
    with pytest.warns(DataWarning), pytest.raises(ValueError, match=r"a/one\.png.*no pixel"):
        evaluate(perfect, Dataset((target,), (nothing,)))


def test_masked_ssim_is_that_of_the_cropped_image():
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 30, 40, 3)).astype(np.float32)
    mask = np.zeros((30, 40), bool)
    mask[4:25, 6:33] = True
    assert masked_ssim(a, b, mask) == pytest.approx(ssim(a[4:25, 6:33], b[4:25, 6:33]), abs=1e-6)
    assert masked_ssim(a, b, None) == pytest.approx(ssim(a, b), abs=1e-6)


def test_floaters_are_counted_away_from_the_subject():
    """Truth: one column. The mesh fills 10 x 10 pixels, of which columns 7 to 9 lie more than 2 away."""
    alpha = np.zeros((16, 24), np.float32)
    alpha[:, 12] = 1
    target = view([0.0, 0, 0], alpha)
    found = evaluate(quad([0, 0, 0, 0.5]), Dataset((), (target,))).method("mesh").views[0].floaters
    assert found == 10 * (len(range(7, 10)) + len(range(15, 17)))
    masked = view([0.0, 0, 0], alpha, np.arange(24) + np.zeros((16, 1)) < 12)
    left = evaluate(quad([0, 0, 0, 0.5]), Dataset((), (masked,))).method("mesh").views[0].floaters
    assert left == 10 * len(range(7, 10))
    faint = evaluate(quad([0, 0, 0, 0.04]), Dataset((), (target,))).method("mesh").views[0].floaters
    assert faint == 0


def test_exposure_fit_undoes_gain_and_offset():
    """Of what counts, of flat channels, and of a cut-out subject whatever is behind it."""
    rng = np.random.default_rng(1)
    image = rng.random((12, 9, 3)).astype(np.float32)
    gain, offset = np.array([0.5, 0.7, 0.6], np.float32), np.array([0.1, 0.2, 0.3], np.float32)
    camera, mask = Camera(np.eye(4), 9, 9, 4.5, 6, 9, 12), np.zeros((12, 9), bool)

    def fitted(image, color, alpha=None, mask=None, background=(1, 1, 1)):
        view = View(camera, ViewImage(color, alpha, mask), background)
        dataset = Dataset((), (view,))
        found = evaluate(None, dataset, images=lambda *_: (image, alpha), fit_exposure=True)
        return found.method("images").views[0].psnr_exposure

    truth = image * gain + offset
    assert fitted(image, truth) > 100
    spoilt = truth.copy()
    spoilt[:6] = 0
    mask[6:] = True
    assert fitted(image, spoilt, mask=mask) > 100
    flat = np.full((12, 9, 3), 0.5, np.float32)
    assert fitted(flat, flat * 0.5) > 100
    alpha = rng.choice(np.array([0, 0.3, 1, 1], np.float32), (12, 9))
    subject = ViewImage(alpha[..., None] * image, alpha)
    for background in ((1, 1, 1), (0, 0, 0), (0.2, 0.6, 0.1)):
        photograph = alpha[..., None] * truth
        assert fitted(subject.over(background), photograph, alpha, None, background) > 100


def test_linear_meshes_are_blended_in_linear_light():
    half = image_of(quad([1, 1, 1, 0.5], blending="linear"), CAMERA, (0, 0, 0))[0][8, 12]
    assert np.allclose(half, linear_to_srgb(np.float32(0.5)), atol=1e-6)
    behind = image_of(quad([1, 1, 1, 0.5], blending="linear"), CAMERA, (0.25, 0.5, 1))[0]
    assert np.allclose(behind[0, 0], [0.25, 0.5, 1], atol=1e-6)
    expected = linear_to_srgb(0.5 + 0.5 * srgb_to_linear(np.array([0.25, 0.5, 1])))
    assert np.allclose(behind[8, 12], expected, atol=1e-6)
    assert np.allclose(image_of(quad([1, 1, 1, 0.5]), CAMERA, (0, 0, 0))[0][8, 12], 0.5)


def cloud(degree: int) -> GaussianCloud:
    rng = np.random.default_rng(2)
    n = 30
    return GaussianCloud(
        rng.normal(size=(n, 3)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        rng.uniform(0.1, 0.3, (n, 3)),
        rng.uniform(0.3, 0.9, n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.5,
    )


def test_splats_beside_the_mesh_at_degree_zero_and_in_full():
    splats = cloud(1)
    cameras = orbit(splats, 3, width=40, height=30)
    dataset = Dataset((), splat_views(splats, cameras))
    seen = []
    report = evaluate(None, dataset, splats=splats, on_view=seen.append)
    assert [m.method for m in report.methods] == ["splats_sh0", "splats"]
    full = report.method("splats")
    assert min(v.psnr for v in full.views) > 60  # float16 keeps the truth
    assert report.method("splats_sh0").mean("psnr") < 45
    assert [s.view.name for s in seen] == [c.name for c in cameras]
    assert seen[1].scores["splats"] == full.views[1]
    assert [m.method for m in evaluate(None, dataset, splats=cloud(0)).methods] == ["splats_sh0"]


def test_splats_are_as_bright_against_photographs_as_their_trainer_draws_them():
    splats = replace(cloud(0), sh=4 * cloud(0).sh)
    assert (0.5 + 0.28209479 * splats.sh[:, 0]).max() > 1
    same = replace(splats, sh=np.concatenate([splats.sh, np.zeros((len(splats), 3, 3), np.float32)], axis=1))
    cameras = orbit(splats, 2, width=40, height=30)
    photographs = [ViewImage(render_splats(same, camera).color, None) for camera in cameras]
    dataset = Dataset((), tuple(View(*pair) for pair in zip(cameras, photographs, strict=True)))
    assert evaluate(None, dataset, splats=splats).method("splats_sh0").mean("psnr") > 100


def report_of(psnrs, ssims, lpips) -> Report:
    rows = zip(psnrs, ssims, lpips, strict=True)
    views = tuple(ViewScores(f"{i}.png", *row) for i, row in enumerate(rows))
    return Report("scene", (MethodScores("mesh", views),), {"samples": 1})


def test_results_have_the_shape_of_the_3dgs_code():
    report = report_of([20.0, 30.0, 25.0], [0.5, 0.9, 0.7], [0.2, 0.1, 0.3])
    assert report.results() == {
        "mesh": {"SSIM": pytest.approx(0.7), "PSNR": pytest.approx(25), "LPIPS": pytest.approx(0.2)}
    }
    per_view = report.per_view()["mesh"]
    assert per_view["PSNR"] == {"0.png": 20.0, "1.png": 30.0, "2.png": 25.0}
    assert set(per_view) == {"SSIM", "PSNR", "LPIPS"}
    full = report.to_dict()
    assert full["methods"]["mesh"]["median"]["psnr"] == 25
    assert full["ssim_convention"] == "3dgs"
    assert set(full["methods"]["mesh"]["mean"]) == set(COLUMNS)


def test_views_of_one_name_and_of_none_are_told_apart():
    names = ["", "a.png", "a.png", "", "a.png 2", "a.png"]
    views = tuple(ViewScores(name, float(i), 1.0) for i, name in enumerate(names))
    psnrs = Report("scene", (MethodScores("mesh", views),)).per_view()["mesh"]["PSNR"]
    wanted = ["view_0000", "a.png", "a.png 3", "view_0003", "a.png 2", "a.png 4"]
    assert psnrs == {name: float(i) for i, name in enumerate(wanted)}


def test_unknown_and_infinite_values_are_null():
    report = report_of([float("inf"), 30.0], [1.0, 0.9], [None, 0.1])
    assert report.results()["mesh"] == {"SSIM": pytest.approx(0.95), "PSNR": None, "LPIPS": None}
    json.dumps(report.to_dict(), allow_nan=False)
    assert report.method("mesh").mean("lpips") is None


def test_errors_say_what_is_missing():
    with pytest.raises(ValueError, match="nothing to evaluate"):
        evaluate(None, Dataset((), (view([0, 0, 0]),)))
    with pytest.raises(ValueError, match="no view"):
        evaluate(quad([0, 0, 0, 1]), Dataset((), ()))
    with pytest.raises(KeyError, match="no method 'other'"):
        report_of([1.0], [1.0], [1.0]).method("other")


def test_views_are_all_scored_where_none_is_held_out():
    with pytest.warns(DataWarning, match="no view is held out, so all 1 training views are scored"):
        report = evaluate(quad([0, 0, 0, 1]), Dataset((view([0.0, 0, 0]),)))
    assert (report.about["views"], report.about["held_out"]) == (1, False)


# ---- Images from elsewhere


def test_images_by_name_and_by_order(tmp_path):
    cameras = [replace(CAMERA, name=f"set/r_{i}.png") for i in (2, 10)]
    for i, name in enumerate(("r_2", "r_10")):
        save_image(tmp_path / f"{name}.png", np.full((16, 24, 3), (51 + 51 * i) / 255, np.float32))
    at = image_folder(tmp_path, cameras)
    assert at(cameras[0], (1, 1, 1))[0][0, 0] == pytest.approx([0.2] * 3)
    assert at(cameras[1], (1, 1, 1))[0][0, 0] == pytest.approx([0.4] * 3)
    (tmp_path / "._r_2.png").write_bytes(b"\0")  # as macOS leaves it
    unnamed = [replace(CAMERA, name=f"other_{i}") for i in range(2)]
    at = image_folder(tmp_path, unnamed)
    assert at(unnamed[0], (1, 1, 1))[0][0, 0] == pytest.approx([0.2] * 3)  # 2 before 10
    with pytest.raises(FileNotFoundError, match="2 images for 3 views"):
        image_folder(tmp_path, [*unnamed, CAMERA])
    with pytest.raises(FileNotFoundError, match="no folder"):
        image_folder(tmp_path / "none", unnamed)


def test_images_with_alpha_go_over_the_background_and_sizes_are_checked(tmp_path):
    save_image(tmp_path / "one.png", np.tile(np.float32([1, 0, 0, 0.6]), (16, 24, 1)))
    color, alpha = image_folder(tmp_path, [CAMERA])(CAMERA, (0, 0, 1))
    assert np.allclose(color, [0.6, 0, 0.4], atol=1e-6)
    assert np.allclose(alpha, 0.6)
    small = replace(CAMERA, width=20)
    with pytest.raises(ValueError, match="24 x 16 pixels, the view 20 x 16"):
        image_folder(tmp_path, [small])(small, (0, 0, 0))


def test_worst_window_holds_the_largest_error():
    error = np.zeros((20, 24))
    error[11, 17] = 5
    error[2, 2] = 4
    top, left, side = worst_window(error)
    assert side == 5
    assert top <= 11 < top + side
    assert left <= 17 < left + side


# ---- Tables and benchmarks


def test_table_has_every_scene_and_their_mean():
    one, two = report_of([20.0], [0.5], [0.1]), report_of([30.0], [0.7], [None])
    table = markdown_table([one, two], title="T", reported={"paper": (28.08, 0.817, 0.229)})
    assert "# T" in table
    assert "| scene | mesh | 20.00 | 20.00 | 0.5000 | 0.1000 |" in table
    assert "| mean | mesh | 25.00 | 25.00 | 0.6000 |  |" in table
    assert "| reported | paper | 28.08 |  | 0.8170 | 0.2290 |" in table


def test_columns_that_nothing_fills_are_left_out():
    heads = lambda *reports, **more: markdown_table(reports, **more).splitlines()[0]  # noqa: E731
    plain = report_of([20.0], [0.5], [None])
    assert heads(plain) == "| scene | method | PSNR | median PSNR | SSIM |"
    assert heads(plain, reported={"paper": (28.0, 0.8, 0.2)}).endswith("| SSIM | LPIPS |")
    assert heads(plain, report_of([30.0], [0.7], [0.1])).endswith("| SSIM | LPIPS |")
    view = replace(plain.methods[0].views[0], psnr_exposure=21.0, floaters=3)
    fitted = replace(plain, methods=(replace(plain.methods[0], views=(view,)),))
    table = markdown_table([fitted], notes=["Behind: grey."]).splitlines()
    assert table[0].endswith("| SSIM | PSNR colour-corrected | floater px |")
    assert table[2].endswith("| 0.5000 | 21.00 | 3.0 |")
    assert table[-2:] == ["", "Behind: grey."]


def test_several_meshes_have_names_of_their_own():
    cloud = make_scene(200)
    meshes = {"a": convert(cloud), "b": convert(cloud, mode="flat")}
    data = Dataset(splat_views(cloud, orbit(cloud, 1, width=16, height=16)))
    report = evaluate(meshes, data, splats=cloud)
    assert [scores.method for scores in report.methods] == ["a", "b", "splats_sh0", "splats"]
    assert report.about["triangles"] == {name: len(mesh.faces) for name, mesh in meshes.items()}
    for name, mesh in meshes.items():
        alone = evaluate(mesh, data)
        assert alone.method("mesh").views == report.method(name).views
        assert alone.about["triangles"] == len(mesh.faces)
    with pytest.raises(ValueError, match="cannot have the name 'before'"):
        evaluate({"before": meshes["a"]}, data, before=meshes["b"])


def test_benchmarks_are_those_of_the_papers_table():
    assert len(BENCHMARKS["mipnerf360"].scenes) == 7
    assert set(BENCHMARKS["mipnerf360-9"].scenes) - set(BENCHMARKS["mipnerf360"].scenes) == {
        "flowers",
        "treehill",
    }
    outdoor = {"bicycle", "flowers", "garden", "stump", "treehill"}
    for scene, factor in BENCHMARKS["mipnerf360-9"].scenes.items():
        assert factor == (4 if scene in outdoor else 2)
    assert set(BENCHMARKS["tanks-and-temples"].scenes) == {"train", "truck"}
    assert set(BENCHMARKS["deep-blending"].scenes) == {"drjohnson", "playroom"}
    for benchmark in BENCHMARKS.values():
        assert (benchmark.test_every, benchmark.sh_degree) == (8, 0)


def test_a_scenes_input_is_found_by_name(tmp_path):
    assert find_input(tmp_path, "room") is None
    (tmp_path / "room").mkdir()
    assert find_input(tmp_path, "room") == tmp_path / "room"
    (tmp_path / "room.npz").touch()
    assert find_input(tmp_path, "room") == tmp_path / "room.npz"


def test_a_benchmark_needs_every_photograph_before_it_scores_any(tmp_path):
    """The second scene lacks one image of nine."""
    benchmark = Benchmark("Two scenes", {"one": 1, "two": 1}, {})
    for name in benchmark.scenes:
        simple_colmap(tmp_path / "data" / name, count=9)
        (tmp_path / "models" / name).mkdir(parents=True)
    (tmp_path / "data" / "two" / "images" / "p03.png").unlink()
    scored: list[str] = []
    with pytest.raises(FileFormatError, match=r"two.*: 1 of 9 images are missing \(images/p03\.png\)$"):
        run_benchmark(benchmark, tmp_path / "models", tmp_path / "data", load=scored.append)
    assert not scored


@pytest.mark.filterwarnings(
    "ignore:Two scenes. scene one is left out", "ignore:Two scenes. scene two is left out"
)
def test_a_benchmark_scores_each_scene_that_is_there(tmp_path):
    from _photographs import write_photographs

    benchmark = Benchmark("Two scenes", {"one": 1, "two": 1}, {"paper": (28.0, 0.8, 0.2)}, test_every=2)
    cloud = make_scene(200)
    cameras = orbit(cloud, 4, width=24, height=24)
    images = [render_splats(cloud, camera).color for camera in cameras]
    write_photographs(tmp_path / "data" / "one", cameras, np.clip(images, 0, 1))
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "one.ply").touch()
    folders = tmp_path / "models", tmp_path / "data"
    with pytest.warns(DataWarning, match="Two scenes: scene two is left out"):
        result = run_benchmark(benchmark, *folders, load=lambda path: cloud)
    assert set(result.means()) == {"mesh", "splats_sh0", "splats"}
    assert result.means() == result.reports[0].results()
    record = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert (record["scenes"], record["missing"], record["downscale"]) == (["one"], ["two"], {"one": 1})
    assert record["reports"][0]["views"] == 2
    assert "# Two scenes: 1 scene of 2" in result.table()
    assert "| reported | paper | 28.00 |" in result.table()
    with (
        pytest.warns(DataWarning),
        pytest.raises(FileNotFoundError, match="none of the scenes of Two scenes"),
    ):
        run_benchmark(benchmark, tmp_path, tmp_path / "data", load=lambda path: cloud)
