"""Splats that move in time are shown at one instant, by the formulas of those who train them."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from _splat_files import random_splats, splat_table, write_ply

from meshsplats import DataWarning, FileFormatError, load_gaussians, stream_gaussians
from meshsplats.cli import main
from meshsplats.scene.gaussians import SH_C0, GaussianCloud


def spacetime(n=40, seed=0, **more):
    """Spacetime Gaussians of the lite model; ``more``: columns in place of random ones."""
    rng = np.random.default_rng(seed)
    values = random_splats(n, 0, seed)
    values["opacity"] = np.full(n, 3, np.float32)
    names = [
        "trbf_center",
        "trbf_scale",
        *(f"motion_{i}" for i in range(9)),
        *(f"omega_{i}" for i in range(4)),
    ]
    values |= {name: rng.normal(size=n).astype(np.float32) for name in names}
    return values | {name: np.asarray(value, np.float32) for name, value in more.items()}


def saved(tmp_path, values, name="a.ply", encoding="binary_little_endian"):
    return write_ply(tmp_path / name, [splat_table(values)], encoding)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_spacetime_gaussians_at_an_instant(tmp_path, encoding):
    values = spacetime(trbf_scale=np.full(40, 1))
    time = 0.25
    cloud = load_gaussians(saved(tmp_path, values, encoding=encoding), time=time)
    shown = 0
    for i in range(40):
        v = {name: float(column[i]) for name, column in values.items()}
        dt = time - v["trbf_center"]
        opacity = 1 / (1 + np.exp(-v["opacity"])) * np.exp(-((dt / np.exp(v["trbf_scale"])) ** 2))
        if opacity < 1 / 255:
            continue
        path = np.array([v[f"motion_{k}"] for k in range(9)]).reshape(3, 3)
        mean = np.array([v[a] for a in "xyz"]) + path[0] * dt + path[1] * dt**2 + path[2] * dt**3
        turned = np.array([v[f"rot_{k}"] + v[f"omega_{k}"] * dt for k in range(4)])
        np.testing.assert_allclose(cloud.means[shown], mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(cloud.quaternions[shown], turned / np.linalg.norm(turned), atol=1e-6)
        np.testing.assert_allclose(cloud.opacities[shown], opacity, rtol=1e-5)
        color = [v[f"f_dc_{k}"] for k in range(3)]  # colours themselves, in the lite model
        np.testing.assert_allclose(0.5 + SH_C0 * cloud.sh[shown, 0], color, atol=1e-5)
        shown += 1
    assert shown == len(cloud) > 20


def test_colours_that_are_stored_as_they_are_are_converted_once(tmp_path):
    path = saved(tmp_path, spacetime())
    plain, told = (load_gaussians(path, time=0.25, activated=which) for which in ((), ("colors",)))
    np.testing.assert_array_equal(told.sh, plain.sh)


def test_two_balls_alive_at_different_times(tmp_path):
    values = spacetime(800, trbf_center=np.repeat([0, 1], 400), trbf_scale=np.full(800, -2))
    values["x"][400:] += 100
    path = saved(tmp_path, values)
    for time, first in [(0, True), (1, False)]:
        cloud = load_gaussians(path, time=time)
        assert len(cloud) == 400
        assert ((cloud.means[:, 0] < 50) == first).all()
        assert sum(map(len, stream_gaussians(path, time=time, block=64))) == 400
    with pytest.warns(
        DataWarning, match=r"move in time \(Spacetime Gaussians, times 0 to 1\), shown at 0; time"
    ):
        cloud = load_gaussians(path)
    assert len(cloud) == 400
    with pytest.raises(FileFormatError, match=r"none of its splats is visible at time 7"):
        load_gaussians(path, time=7)


def test_blocks_are_the_whole(tmp_path):
    path = saved(tmp_path, spacetime(300))
    with pytest.warns(DataWarning, match="move in time"):
        whole = load_gaussians(path)
    with pytest.warns(DataWarning, match="move in time"):
        parts = GaussianCloud.joined(list(stream_gaussians(path, block=32)))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_colours_are_harmonics_where_there_are_more(tmp_path):
    values = spacetime(5, trbf_center=np.zeros(5), trbf_scale=np.zeros(5)) | {
        f"f_rest_{i}": np.zeros(5, np.float32) for i in range(9)
    }
    cloud = load_gaussians(saved(tmp_path, values), time=0)
    np.testing.assert_allclose(cloud.sh[:, 0, 0], values["f_dc_0"], rtol=1e-6)


def sliced(**columns):
    """Splats of 4D Gaussian Splatting with quaternions 1, 0, 0, 0 but for ``columns``."""
    n = len(next(iter(columns.values())))
    one, none = np.ones(n, np.float32), np.zeros(n, np.float32)
    values = random_splats(n, 0) | {"opacity": 5 * one}
    for i in range(4):
        values |= {f"rot_{i}": none if i else one}
    values |= {"t": none, "scale_t_0": none, **{f"rot_r_{i}": none if i else one for i in range(4)}}
    return values | {name: np.asarray(value, np.float32) for name, value in columns.items()}


def test_4d_gaussians_that_do_not_lean_in_time_only_fade(tmp_path):
    values = sliced(t=[0, 0.5, 1, 9])
    cloud = load_gaussians(saved(tmp_path, values), time=0.5)
    assert len(cloud) == 3  # the last is below the share of 0.05 at which their program stops
    opacity = 1 / (1 + np.exp(-5)) * np.exp(-0.5 * np.array([0.5, 0, 0.5]) ** 2)
    np.testing.assert_allclose(cloud.opacities, opacity, rtol=1e-6)
    np.testing.assert_array_equal(cloud.means[:, 0], values["x"][:3])
    expected = np.sort(np.exp([values[f"scale_{i}"][:3] for i in range(3)]), axis=0).T
    np.testing.assert_allclose(np.sort(cloud.scales, axis=1), expected, rtol=1e-5)


def test_4d_gaussians_that_lean_in_time_move(tmp_path):
    """One that leans by an angle in the plane of z and t: its slice moves along z alone, with the velocity
    of a long ellipse's axis, and is thinner than its shadow."""
    angle, long, short = 0.5, 4.0, 0.01
    # Left and right by half the angle about the same axis turn one plane by the angle, and leave the other.
    half = np.array([np.cos(angle / 2), np.sin(angle / 2)], np.float32)
    values = sliced(
        t=[0.0],
        **{"x": [1.0], "y": [2.0], "z": [3.0], "scale_0": [np.log(short)], "scale_1": [np.log(short)]},
        **{"scale_2": [np.log(short)], "scale_t_0": [np.log(long)]},
        **{"rot_0": half[:1], "rot_1": half[1:], "rot_r_0": half[:1], "rot_r_1": -half[1:]},
    )
    before, after = (load_gaussians(saved(tmp_path, values), time=t) for t in (0.0, 1.0))
    np.testing.assert_allclose(before.means, [[1, 2, 3]], atol=1e-6)
    moved = (after.means - before.means)[0].astype(float)
    assert np.abs(moved[:2]).max() < 1e-6
    # The axis of length 4 points along (sin, cos) of (z, t), so dz / dt is its tangent (short is nearly 0).
    np.testing.assert_allclose(abs(moved[2]), np.tan(angle), rtol=1e-3)
    np.testing.assert_allclose(np.sort(before.scales[0]), [short, short, short / np.cos(angle)], rtol=1e-3)
    np.testing.assert_allclose(
        after.opacities / before.opacities, np.exp(-0.5 / (long * np.cos(angle)) ** 2), rtol=1e-4
    )


def test_4d_gaussians_agree_with_a_direct_transcription(tmp_path):
    rng = np.random.default_rng(3)
    n, time = 30, 0.1
    columns = {f"{name}_{i}": rng.normal(size=n) for name in ("rot", "rot_r") for i in range(4)}
    columns |= {f"scale_{i}": rng.normal(size=n) - 2 for i in range(3)}
    values = sliced(t=rng.normal(size=n), scale_t_0=rng.normal(size=n), **columns)
    cloud = load_gaussians(saved(tmp_path, values), time=time)
    shown = 0
    for i in range(n):
        v = {name: float(column[i]) for name, column in values.items()}
        a, b, c, d = unit([v[f"rot_{k}"] for k in range(4)])
        p, q, r, s = unit([v[f"rot_r_{k}"] for k in range(4)])
        # As the CUDA program of the authors has them, column by column.
        left = np.array([[a, b, -c, d], [-b, a, d, c], [c, -d, a, b], [-d, -c, -b, a]]).T
        right = np.array([[p, q, -r, -s], [-q, p, s, -r], [r, -s, p, -q], [s, r, q, p]]).T
        scaled = (
            np.diag(np.exp([v[k] for k in ("scale_0", "scale_1", "scale_2", "scale_t_0")])) @ right @ left
        )
        sigma = scaled.T @ scaled
        dt = time - v["t"]
        share = np.exp(-0.5 * dt * dt / sigma[3, 3])
        if share <= 0.05:
            continue
        mean = np.array([v[k] for k in "xyz"]) + sigma[:3, 3] / sigma[3, 3] * dt
        covariance = sigma[:3, :3] - np.outer(sigma[:3, 3], sigma[:3, 3]) / sigma[3, 3]
        axes = cloud.rotations[shown].astype(float) * cloud.scales[shown]
        np.testing.assert_allclose(cloud.means[shown], mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(axes @ axes.T, covariance, rtol=1e-3, atol=1e-5 * covariance.max())
        np.testing.assert_allclose(cloud.opacities[shown], share / (1 + np.exp(-5)), rtol=1e-4)
        shown += 1
    assert shown == len(cloud) > 5


def unit(v):
    return np.array(v) / np.linalg.norm(v)


@pytest.mark.parametrize(
    ("lacking", "more", "message"),
    [
        (["trbf_scale"], {}, r"move in time \(Spacetime Gaussians\) without trbf_scale"),
        (["motion_8"], {}, r"of which motion_0 to motion_8 are expected"),
        (["omega_3"], {}, r"of which omega_0 to omega_3 are expected"),
        ([], {"f_t_0": 0, "f_t_1": 0, "f_t_2": 0}, "full model of Spacetime Gaussians, whose colours"),
        (["trbf_center", "trbf_scale"], {}, r"move in time \(motion_0, omega_0\), in a layout whose formula"),
    ],
)
def test_what_cannot_be_shown_is_refused(tmp_path, lacking, more, message):
    values = spacetime(5) | {name: np.full(5, value, np.float32) for name, value in more.items()}
    path = saved(tmp_path, {name: column for name, column in values.items() if name not in lacking})
    for read in (load_gaussians, lambda p: list(stream_gaussians(p))):
        with pytest.raises(FileFormatError, match=message):
            read(path)


@pytest.mark.parametrize("name", ["duration", "mu_t", "scale_t"])
def test_unknown_layouts_are_refused(tmp_path, name):
    path = saved(tmp_path, random_splats(5, 0) | {name: np.zeros(5, np.float32)})
    with pytest.raises(FileFormatError, match=f"move in time \\({name}\\)"):
        load_gaussians(path)


def test_a_property_t_alone_is_no_motion(tmp_path):
    path = saved(tmp_path, random_splats(5, 0) | {"s": np.zeros(5, np.float32), "t": np.zeros(5, np.float32)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_gaussians(path)) == 5


def test_time_is_for_splats_that_move(tmp_path):
    path = saved(tmp_path, random_splats(5, 0))
    with pytest.raises(ValueError, match="its splats do not move: time is for those that do"):
        load_gaussians(path, time=0)
    with pytest.raises(ValueError, match="time must be a finite number, got nan"):
        load_gaussians(path, time=np.nan)


def test_times_that_are_not_finite(tmp_path):
    path = saved(tmp_path, spacetime(5, trbf_center=[np.nan, 0, 0, np.inf, 1], trbf_scale=np.zeros(5)))
    with pytest.warns(DataWarning) as told:
        load_gaussians(path)
    assert "times 0 to 1" in str(told[0].message)
    assert "2 with values that are not finite" in str(told[1].message)
    path = saved(tmp_path, spacetime(5, trbf_center=np.full(5, np.nan)))
    with pytest.raises(FileFormatError, match="none of the times"):
        load_gaussians(path)


def test_commands_name_and_take_the_time(tmp_path, capsys):
    path = saved(tmp_path, spacetime(100, trbf_center=np.linspace(0, 2, 100), trbf_scale=np.full(100, -1)))
    assert main(["info", str(path), "--json"]) == 0
    told = capsys.readouterr()
    found = json.loads(told.out)
    assert found["moves"] == "Spacetime Gaussians"
    assert found["times"] == [0, 2]
    assert "--time chooses" in told.err
    out = tmp_path / "m.npz"
    assert main(["convert", str(path), "-o", str(out), "--time", "0", "--no-sidecar", "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["splats"] == len(load_gaussians(path, time=0))
    assert "--time" not in told.err
