"""Laws of the look that files get whose splats are smaller than the gaps between them."""

import json
import warnings
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from meshsplats.cli import main
from meshsplats.conversion.gaps import gap_share, with_usual_look, without_gaps
from meshsplats.conversion.options import ConversionOptions
from meshsplats.errors import DataWarning
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewer.content import content_of_splats


def wall(sigma: float, side: int = 60) -> GaussianCloud:
    """A square of ``side`` x ``side`` round opaque splats, one unit apart."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    n = x.size
    return GaussianCloud(
        means=np.column_stack([x.ravel(), y.ravel(), np.zeros(n)]).astype(np.float32),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        scales=np.full((n, 3), sigma, np.float32),
        opacities=np.full(n, 0.99, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
    )


@pytest.fixture(autouse=True)
def small_images(monkeypatch):
    """Of 120 pixels, in which a unit is about 1.5 pixels wide: a splat viewer adds a sigma of 0.35 to it."""
    monkeypatch.setattr("meshsplats.conversion.gaps.SIDE", 120)


def test_only_gaps_that_a_splat_viewer_closes_count():
    assert gap_share(wall(0.6)) == 0  # they overlap
    assert gap_share(wall(0.3)) > 0.5
    assert gap_share(wall(0.02)) == 0  # a splat viewer shows a sieve, too
    assert gap_share(wall(0.3).take([])) == 0


def test_a_few_gaps_are_no_sieve():
    """Of a wall, so many in a hundred columns are thin."""
    for percent, look in ((2, None), (15, "splats")):
        cloud = wall(0.6, 100)
        thin = cloud.means[:, 0] < percent
        cloud = replace(cloud, scales=np.where(thin[:, None], np.float32(0.3), cloud.scales))
        with nullcontext() if look is None else pytest.warns(DataWarning):
            assert with_usual_look(cloud).look == look


def test_the_look_is_widened_with_a_word_and_only_where_nobody_chose_it():
    with pytest.warns(DataWarning, match=r"smaller than the gaps between them; .*images of 1000 pixels$"):
        assert with_usual_look(wall(0.3)) == ConversionOptions(look="splats")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert with_usual_look(wall(0.6)) == ConversionOptions()
        for given in ({"look": "area"}, {"footprint": "none"}, {"footprint_px2": 0.1}):
            assert with_usual_look(wall(0.3), ConversionOptions(**given)) == ConversionOptions(**given)


def test_programs_that_make_a_first_image_take_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_gaussians(wall(0.3), "fine.ply")
    save_gaussians(wall(0.6), "plain.ply")
    sizes = {}
    for name, options in (("fine", []), ("area", ["--look", "area"]), ("splats", ["--look", "splats"])):
        assert main(["convert", "fine.ply", "-o", f"{name}.npz", "--no-preview", *options]) == 0
        captured = capsys.readouterr()
        assert ("gaps between them" in captured.err) == (name == "fine")
        assert ("(--look splats; --look area leaves" in captured.err) == (name == "fine")
        assert ("--look splats" in captured.out) == (name != "area")  # the next command scores that look
        with np.load(f"{name}.npz") as arrays:
            sizes[name] = arrays["vertices"].copy()
    np.testing.assert_array_equal(sizes["fine"], sizes["splats"])
    assert np.abs(sizes["fine"] - sizes["area"]).max() > 0.01
    assert main(["render", "fine.ply", "-o", "fine.png", "--width", "80"]) == 0
    err = capsys.readouterr().err
    assert "gaps between them" in err
    assert "--look" not in err  # render has no such option
    assert main(["convert", "plain.ply", "-o", "plain.npz", "--no-preview"]) == 0
    assert "gaps" not in capsys.readouterr().err
    with pytest.warns(DataWarning, match="gaps between them"):
        content = content_of_splats(wall(0.3))
    np.testing.assert_allclose(content.mesh.vertices, sizes["fine"], atol=1e-4)


def test_splats_that_are_optimised_close_their_gaps():
    with pytest.warns(DataWarning, match=r"images of 1000 pixels, hint$"):
        closed = without_gaps(wall(0.3), hint=", hint")
    added = closed.scales.astype(np.float64) ** 2 - 0.3**2
    assert added.min() > 0
    np.testing.assert_allclose(added, np.broadcast_to(added[:, :1], added.shape), rtol=1e-4)
    plain = wall(0.6)
    assert without_gaps(plain) is plain


def test_fine_tuning_begins_without_gaps_unless_a_look_is_chosen(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_gaussians(wall(0.3, 20), "fine.ply")
    monkeypatch.setattr("meshsplats.conversion.gaps.SIDE", 40)
    brief = ["finetune", "fine.ply", "--steps", "1", "--views", "2", "--held-out", "1", "--width", "32"]
    for name, options in (("closed.npz", []), ("area.npz", ["--look", "area"])):
        assert main([*brief, "-o", name, *options]) == 0
        assert ("(--look area leaves them as they are)" in capsys.readouterr().err) == (not options)
    extents = [np.ptp(np.load(name)["vertices"], axis=0).max() for name in ("closed.npz", "area.npz")]
    assert extents[0] > extents[1]
    assert main(["levels", "fine.ply", "-o", "chain", "--no-tune", "--levels", "1", "--width", "40"]) == 0
    assert "gaps between them" in capsys.readouterr().err


def test_scores_have_no_gaps_either_unless_a_look_is_chosen(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_gaussians(wall(0.3, 20), "fine.ply")
    monkeypatch.setattr("meshsplats.conversion.gaps.SIDE", 40)
    monkeypatch.setattr("meshsplats.conversion.footprint.FRAMING_PIXELS", 40)
    assert main(["convert", "fine.ply", "-o", "fine.npz", "--no-preview"]) == 0
    capsys.readouterr()
    compared = {}
    for name, options in (("closed", []), ("area", ["--look", "area"])):
        words = ["compare", "fine.ply", "fine.npz", "-o", name, "--orbit", "1", "--width", "60", *options]
        assert main([*words, "--json"]) == 0
        captured = capsys.readouterr()
        assert ("gaps between them" in captured.err) == (not options)
        compared[name] = json.loads(captured.out)["mean"]["psnr"]
    assert compared["closed"] > compared["area"] + 3
    cameras = ["--cameras", "closed/cameras.json"]
    for name, options in (("scores", []), ("scores-area", ["--look", "area"])):
        words = ["evaluate", "fine.npz", "--splats", "fine.ply", *cameras, "-o", name, "--samples", "2"]
        assert main([*words, *options]) == 0
        assert ("gaps between them" in capsys.readouterr().err) == (not options)
