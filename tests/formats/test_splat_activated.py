"""Scales, opacities and colours stored as they are, where logarithms, logits and harmonics belong."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np
import pytest
from _local import shared_data
from _splat_files import random_splats, splat_table, write_ply

from meshsplats import DataWarning, FileFormatError, load_gaussians, save_gaussians, stream_gaussians
from meshsplats.cli import main
from meshsplats.scene.gaussians import GaussianCloud

COUNT = 3000


def ball(scale=1.0, *, spread=0.4, count=COUNT):
    """Splats on a sphere of radius ``scale``, of about the distance between them, as a .ply stores them."""
    rng = np.random.default_rng(0)
    values = random_splats(count, 0)
    v = rng.normal(size=(count, 3))
    v *= scale / np.linalg.norm(v, axis=1)[:, None]
    values |= dict(zip("xyz", v.T.astype(np.float32), strict=True))
    size = scale * np.sqrt(4 * np.pi / count)
    for i in range(3):
        values[f"scale_{i}"] = np.log(size) + spread * rng.normal(size=count)
    values["opacity"] = 3 * rng.normal(size=count)
    for i in range(3):
        values[f"f_dc_{i}"] = rng.normal(size=count)
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def saved(path, values):
    """A binary file of float32, written at once."""
    rows = np.stack(list(values.values()), axis=1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in values]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + rows.tobytes())
    return path


def activated(values, *which, span=1):
    """``values`` with those of ``which`` stored as they are."""
    values = dict(values)
    if "scales" in which:
        values |= {f"scale_{i}": np.exp(values[f"scale_{i}"]) for i in range(3)}
    if "opacities" in which:
        values["opacity"] = span / (1 + np.exp(-values["opacity"]))
    if "colors" in which:
        for i in range(3):
            values[f"f_dc_{i}"] = span * np.clip(0.5 + 0.28209479177387814 * values[f"f_dc_{i}"], 0, 1)
    if span == 255:
        names = {"opacities": ["opacity"], "colors": [f"f_dc_{i}" for i in range(3)], "scales": []}
        values |= {name: np.round(values[name]) for kind in which for name in names[kind]}
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def said(path, **options):
    """The warnings of reading ``path``."""
    with warnings.catch_warnings(record=True) as found, suppress(FileFormatError):
        warnings.simplefilter("always")
        load_gaussians(path, **options)
    return [str(warning.message) for warning in found]


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("span", [1, 255])
@pytest.mark.parametrize(
    "which",
    [["scales"], ["opacities"], ["colors"], ["scales", "opacities"], ["scales", "opacities", "colors"]],
)
def test_activated_values_are_named_and_read(tmp_path, which, span):
    plain = ball()
    path = saved(tmp_path / "a.ply", activated(plain, *which, span=span))
    (message,) = said(path)
    assert f"; if so, activated={','.join(which)} reads it right" in message
    assert said(path, activated=which) == []
    cloud, expected = load_gaussians(path, activated=which), load_gaussians(saved(tmp_path / "b.ply", plain))
    step = 0.5 / span if span > 1 else 1e-6
    np.testing.assert_allclose(cloud.scales, expected.scales, rtol=1e-5)
    np.testing.assert_allclose(cloud.opacities, expected.opacities, atol=step + 1e-6)
    np.testing.assert_allclose(cloud.colors, expected.colors, atol=step + 1e-6)
    blocks = GaussianCloud.joined(list(stream_gaussians(path, activated=which, block=64)))
    np.testing.assert_array_equal(blocks.opacities, cloud.opacities)
    np.testing.assert_array_equal(blocks.sh, cloud.sh)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 0.1, 1, 10, 1e3, 1e6])
def test_the_unit_of_length_does_not_matter(tmp_path, scale):
    """Logarithms are not doubted in any unit. Of scales as they are, splats of 1e5 have no finite size: the
    warning comes before the error."""
    plain = ball(scale)
    assert said(saved(tmp_path / "a.ply", plain)) == []
    assert said(saved(tmp_path / "b.ply", activated(plain, "scales")))


@pytest.mark.parametrize(("count", "doubted"), [(1, False), (2, False), (31, False), (32, True), (40, True)])
def test_few_splats_are_no_reason(tmp_path, count, doubted):
    path = saved(tmp_path / "a.ply", activated(ball(count=count), "scales", "opacities", "colors"))
    assert bool(said(path)) == doubted


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1, 300])
def test_captures_are_not_doubted(tmp_path, scale):
    """Real scenes, also in a unit in which all logarithms are above 0."""
    for source in sorted(shared_data("splats").glob("*.ply")):
        cloud = load_gaussians(source)
        least = float(cloud.scales[cloud.scales > 0].min()) if scale > 1 else 1.0
        factor = np.float32(min(scale / least, 1e12) if scale > 1 else 1)
        path = tmp_path / "a.ply"
        bigger = type(cloud)(
            cloud.means * factor, cloud.quaternions, cloud.scales * factor, cloud.opacities, cloud.sh[:, :1]
        )
        save_gaussians(bigger, path)
        assert said(path) == [], source.name
        if scale == 1:
            assert said(source) == [], source.name


def test_a_cloud_of_one_value_is_not_doubted(tmp_path):
    """Generators that leave a column at 0, at 0.5 or at 1 mean logarithms and logits."""
    plain = ball(10)
    for value in (0.0, 0.5):
        same = {name: np.full(COUNT, value, np.float32) for name in ("opacity", "f_dc_0", "f_dc_1", "f_dc_2")}
        assert said(saved(tmp_path / "a.ply", plain | same)) == []
    assert said(saved(tmp_path / "a.ply", plain | {f"scale_{i}": np.zeros(COUNT) for i in range(3)})) == []


def test_hostile_values(tmp_path):
    for value in (np.nan, np.inf, 3e38, -3e38):
        values = activated(ball(count=64), "scales", "opacities", "colors")
        for name in ("x", "scale_0", "opacity", "f_dc_0"):
            values[name][::2] = value
        for options in ({}, {"activated": ["scales", "opacities", "colors"]}):
            said(saved(tmp_path / "a.ply", values), **options)


def test_a_scale_below_0_is_none(tmp_path):
    values = activated(ball(count=64), "scales")
    values["scale_0"][0] = -1
    with pytest.warns(DataWarning, match="1 of 64 splats are unusable"):
        assert len(load_gaussians(saved(tmp_path / "a.ply", values), activated=["scales"])) == 63


def test_what_activated_may_be(tmp_path):
    path = write_ply(tmp_path / "a.ply", [splat_table(random_splats(degree=0))])
    with pytest.raises(ValueError, match="activated must be of scales, opacities, colors, got 'rotations'"):
        load_gaussians(path, activated=["rotations"])
    (tmp_path / "a.splat").write_bytes(bytes(24) + bytes([0, 0, 0, 0, 255, 128, 128, 128]))
    with pytest.raises(ValueError, match=r"activated is for float \.ply files, this is splat"):
        load_gaussians(tmp_path / "a.splat", activated=["scales"])


def test_commands_take_it(tmp_path, capsys):
    path = saved(tmp_path / "a.ply", activated(ball(), "scales", "opacities"))
    out = tmp_path / "m.npz"
    assert main(["convert", str(path), "-o", str(out), "--no-sidecar"]) == 0
    told = capsys.readouterr()
    assert "--set activated=scales,opacities" in told.err
    words = ["--set", "activated=scales,opacities"]
    assert main(["convert", str(path), "-o", str(out), "--force", "--no-sidecar", *words]) == 0
    told = capsys.readouterr()
    assert "activated" not in told.err
    assert "--set activated=scales,opacities" in told.out  # the next command reads it in the same way
