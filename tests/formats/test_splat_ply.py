"""Float .ply splats: every layout that trainers and editors write gives the values that it means."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from _local import shared_data
from _splat_files import Table, assert_same_cloud, expected_cloud, random_splats, splat_table, write_ply
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import DataWarning, FileFormatError, GaussianCloud, load_gaussians, save_gaussians
from meshsplats.scene.spherical_harmonics import sh_basis

ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
FACES = Table("face", [("uchar", "int", "vertex_indices")], [[[0, 1, 2]], [[0, 1, 2, 3]], [[]], [[4, 5, 6]]])
EDGES = Table(
    "edge", [("int", "a"), ("ushort", "float", "w"), ("double", "b")], [[1, [0.5] * 3, 2.0], [2, [], 3.0]]
)
CAMERA = Table("camera", [("float", "fx"), ("int", "width")], [[500.0, 640]])


def without(values, *names):
    return {key: value for key, value in values.items() if key not in names}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("real", ["float", "double"])
def test_encodings_types_and_degrees(tmp_path, encoding, real, degree):
    values = random_splats(degree=degree)
    table = splat_table(values, dict.fromkeys(values, real))
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [table], encoding))
    assert cloud.kernel == "3dgs"
    assert cloud.sh_degree == degree
    assert_same_cloud(cloud, expected_cloud(values))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_and_comments(tmp_path, encoding, end):
    values = random_splats()
    # Binary data that begin with a line feed must not be taken for a part of the header's last line end.
    values["x"] = np.frombuffer(b"\n\x00\x00\x3f" * len(values["x"]), "<f4").copy()
    comments = ["exported by hand, µ", "", "end_header is not here", "element vertex 99"]
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)], encoding, end, comments))
    assert_same_cloud(cloud, expected_cloud(values))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("before", [[], [FACES], [EDGES, CAMERA], [FACES, CAMERA, EDGES]])
@pytest.mark.parametrize(
    "after", [[], [Table("chunk", FACES.columns, FACES.rows)], [Table("c2", CAMERA.columns, CAMERA.rows)]]
)
def test_other_elements_are_stepped_over(tmp_path, encoding, before, after):
    values = random_splats(degree=1)
    path = write_ply(tmp_path / "a.ply", [*before, splat_table(values), *after], encoding)
    assert_same_cloud(load_gaussians(path), expected_cloud(values))


@pytest.mark.parametrize(
    "lengths", [[3] * 5000, [3, 4] * 2500, [0, 200_000, 3], [255] * 40 + [1] * 40 + [255] * 40]
)
def test_long_lists_before_the_splats(tmp_path, lengths):
    values = random_splats(degree=0)
    table = Table(
        "face",
        [("uchar", "tag"), ("int", "short", "v"), ("float", "w")],
        [[1, [7] * n, 2.0] for n in lengths],
    )
    path = write_ply(tmp_path / "a.ply", [table, splat_table(values)])
    assert_same_cloud(load_gaussians(path), expected_cloud(values))


def test_second_list_beyond_the_window(tmp_path):
    values = random_splats(degree=0)
    columns = [("uint", "double", "v"), ("uchar", "char", "w")]
    table = Table("face", columns, [[[1.0] * n, [2] * 7] for n in (3, 200_000, 200_000, 0)])
    path = write_ply(tmp_path / "a.ply", [table, splat_table(values)])
    assert_same_cloud(load_gaussians(path), expected_cloud(values))


@given(st.randoms(use_true_random=False), st.integers(0, 3))
def test_order_of_properties_does_not_matter(tmp_path_factory, random, degree):
    values = random_splats(degree=degree)
    keys = list(values)
    random.shuffle(keys)
    types = {key: random.choice(["float", "double"]) for key in keys}
    path = tmp_path_factory.mktemp("order") / "a.ply"
    write_ply(path, [splat_table({key: values[key] for key in keys}, types)], random.choice(ENCODINGS))
    assert_same_cloud(load_gaussians(path), expected_cloud(values))


def test_extra_properties_are_ignored_even_if_not_finite(tmp_path):
    values = random_splats(degree=1)
    values = {"label": np.arange(7), **values, "confidence": np.full(7, np.nan)}
    values["nx"] = np.full(7, np.inf, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values, {"label": "uchar"})]))
    assert_same_cloud(cloud, expected_cloud(random_splats(degree=1)))
    plain = without(random_splats(degree=1), "nx", "ny", "nz")
    assert_same_cloud(
        load_gaussians(write_ply(tmp_path / "b.ply", [splat_table(plain)])), expected_cloud(plain)
    )


def test_integer_properties(tmp_path):
    values = without(random_splats(degree=0), "nx", "ny", "nz")
    values = {key: np.round(4 * value) for key, value in values.items()} | {"rot_0": np.ones(7)}
    path = write_ply(tmp_path / "a.ply", [splat_table(values, dict.fromkeys(values, "short"))])
    assert_same_cloud(load_gaussians(path), expected_cloud(values))


@pytest.mark.parametrize(("kind", "span"), [("uchar", 255), ("ushort", 65535), ("float", 1)])
def test_plain_colours_serve_where_f_dc_is_missing(tmp_path, kind, span):
    values = without(random_splats(degree=0), "f_dc_0", "f_dc_1", "f_dc_2")
    rgb = np.array([[0, 0.2, 1]] * 7)
    values |= {name: rgb[:, c] * span for c, name in enumerate(["red", "green", "blue"])}
    types = dict.fromkeys(["red", "green", "blue"], kind)
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values, types)]))
    np.testing.assert_allclose(cloud.colors, rgb, atol=1e-6)


def test_two_scales_are_2dgs_with_the_third_axis_flat(tmp_path):
    values = without(random_splats(degree=0), "scale_2")
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))
    assert cloud.kernel == "2dgs"
    assert (cloud.scales[:, 2] == 0).all()
    assert_same_cloud(cloud, expected_cloud(values))


def test_mip_splatting_filter_is_fused(tmp_path):
    values = random_splats(degree=0)
    values["scale_1"][0] = -np.inf  # a flat splat without a filter: 0 / 0 in the formula
    with np.errstate(divide="ignore"):
        plain = expected_cloud(values)
    values["filter_3D"] = np.linspace(0, 0.1, 7, dtype=np.float32)
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))
    assert cloud.kernel == "antialiased"
    wide = np.sqrt(plain["scales"] ** 2 + values["filter_3D"][:, None].astype(float) ** 2)
    np.testing.assert_allclose(cloud.scales, wide, rtol=1e-5)
    # The filter keeps the integral o * s_0 * s_1 * s_2 of each splat.
    integral = plain["opacities"] * plain["scales"].prod(axis=1)
    np.testing.assert_allclose(cloud.opacities * cloud.scales.astype(float).prod(axis=1), integral, rtol=1e-5)


@pytest.mark.parametrize(
    ("comment", "kernel"),
    [
        ("SplatRenderMode: mip", "antialiased"),
        ("splatrendermode:  MIP ", "antialiased"),
        ("antialiased 1", "antialiased"),
        ("antialiased 0", "3dgs"),
        ("SplatRenderMode: default", "3dgs"),
        ("antialiased lenses are nice", "3dgs"),
        ("antialiased 1\ncomment SplatRenderMode: default", "3dgs"),
    ],
)
def test_kernel_named_by_a_comment(tmp_path, comment, kernel):
    path = write_ply(
        tmp_path / "a.ply", [splat_table(random_splats(degree=0))], comments=["by Brush", comment]
    )
    assert load_gaussians(path).kernel == kernel


def test_infinite_logits_and_logarithms_of_zero_are_physical(tmp_path):
    values = random_splats(degree=0)
    values["opacity"][:3] = [np.inf, -np.inf, -1000]
    values["scale_1"][0] = -np.inf
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]), strict=True)
    np.testing.assert_array_equal(cloud.opacities[:3], [1, 0, 0])
    assert cloud.scales[0, 1] == 0
    assert len(cloud) == 7


@pytest.mark.parametrize("size", [1e-38, 1e-20, 1, 1e20, 1e38])
def test_quaternions_of_any_length(tmp_path, size):
    values = random_splats(degree=0)
    expected = expected_cloud(values)["quaternions"]
    for i in range(4):
        values[f"rot_{i}"] = values[f"rot_{i}"] * np.float32(size) / 4
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))
    np.testing.assert_allclose(cloud.quaternions, expected, atol=1e-6)


BAD = [
    ("x", 2, np.nan),
    ("z", 0, np.inf),
    ("f_dc_1", 6, -np.inf),
    ("f_rest_8", 3, np.nan),
    ("opacity", 1, np.nan),
]
BAD += [("scale_0", 4, 1000.0), ("scale_2", 5, np.nan), ("rot_3", 2, np.inf)]


@pytest.mark.parametrize("bad", [[b] for b in BAD] + [BAD[:5]])
@pytest.mark.parametrize("encoding", ["ascii", "binary_big_endian"])
def test_splats_that_are_not_finite_are_dropped_and_counted(tmp_path, encoding, bad):
    values = random_splats(degree=1)
    for name, row, value in bad:
        values[name][row] = value
    path = write_ply(tmp_path / "a.ply", [splat_table(values)], encoding)
    keep = np.setdiff1d(np.arange(7), [row for _, row, _ in bad])
    with pytest.warns(
        DataWarning, match=f"{7 - len(keep)} of 7 splats .*{7 - len(keep)} with values that are not finite"
    ):
        cloud = load_gaussians(path)
    assert_same_cloud(cloud, expected_cloud({key: value[keep] for key, value in values.items()}))
    first = min(row for _, row, _ in bad)
    with pytest.raises(FileFormatError, match=rf"a\.ply.*the first is splat {first} "):
        load_gaussians(path, strict=True)


def test_zero_quaternions_are_dropped_and_counted(tmp_path):
    values = random_splats(degree=0)
    for i in range(4):
        values[f"rot_{i}"][[1, 4]] = 0
    path = write_ply(tmp_path / "a.ply", [splat_table(values)])
    with pytest.warns(DataWarning, match="2 with a zero quaternion"):
        assert len(load_gaussians(path)) == 5
    with pytest.raises(FileFormatError, match="2 with a zero quaternion"):
        load_gaussians(path, strict=True)


@pytest.mark.parametrize("field", ["x", "opacity", "rot"])
def test_no_usable_splat_is_an_error(tmp_path, field):
    values = random_splats(degree=0)
    for key in values:
        if key == field:
            values[key][:] = np.nan
        elif key.startswith(field):
            values[key][:] = 0
    with pytest.raises(FileFormatError, match="no usable splats; 7 of 7"):
        load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))


def test_dropping_across_chunks(tmp_path):
    n = 40_000
    values = random_splats(n, degree=0)
    bad = np.arange(5, n, 3)
    values["y"][bad] = np.nan
    path = tmp_path / "a.ply"
    table = np.stack([values[key] for key in values], axis=1)
    header = "".join(f"property float {key}\n" for key in values)
    path.write_bytes(
        f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{header}end_header\n".encode()
    )
    with path.open("ab") as file:
        file.write(table.astype("<f4").tobytes())
    with pytest.warns(DataWarning, match=r"13,332 of 40,000 .* the first is splat 5 "):
        cloud = load_gaussians(path)
    keep = np.setdiff1d(np.arange(n), bad)
    np.testing.assert_array_equal(cloud.means[:, 0], values["x"][keep])
    np.testing.assert_array_equal(cloud.sh[:, 0, 2], values["f_dc_2"][keep])
    assert cloud.means.base is None  # the room of dropped splats was given back


def make_cloud(n=200, degree=3, kernel="3dgs", seed=1):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    scales = np.exp(rng.normal(-3, 2, (n, 3)))
    if kernel == "2dgs":
        scales[:, 2] = 0
    return GaussianCloud(
        rng.normal(size=(n, 3)) * 10,
        q / np.linalg.norm(q, axis=1, keepdims=True),
        scales,
        rng.uniform(size=n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)),
        kernel,
    )


@pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path, kernel, degree):
    cloud = make_cloud(degree=degree, kernel=kernel)
    save_gaussians(cloud, tmp_path / "a.ply")
    back = load_gaussians(tmp_path / "a.ply", strict=True)
    assert back.kernel == kernel
    np.testing.assert_array_equal(back.means, cloud.means)
    np.testing.assert_array_equal(back.sh, cloud.sh)
    np.testing.assert_allclose(back.quaternions, cloud.quaternions, atol=1e-7)
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=3e-6)
    np.testing.assert_allclose(back.opacities, cloud.opacities, atol=1e-6)


def test_extremes_stay_finite_on_disk(tmp_path):
    cloud = make_cloud(4)
    cloud.opacities[:] = [0, 1, 1 - 2**-24, 1e-7]
    cloud.scales[0] = [0, 1e-8, 1e30]
    save_gaussians(cloud, tmp_path / "a.ply")
    raw = (tmp_path / "a.ply").read_bytes()
    table = np.frombuffer(raw[raw.index(b"end_header\n") + 11 :], "<f4").reshape(4, 62)
    assert np.isfinite(table).all()
    back = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(back.opacities, cloud.opacities, rtol=1e-4, atol=1e-12)
    assert back.opacities[1] == 1
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=1e-5, atol=2e-38)


def test_layout_on_disk_is_that_of_the_3dgs_code(tmp_path):
    cloud = make_cloud(3, degree=1)
    save_gaussians(cloud, tmp_path / "a.ply")
    raw = (tmp_path / "a.ply").read_bytes()
    header, data = raw.split(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float ")]
    expected = (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6"
    )
    expected += " f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert names == expected.split()
    table = dict(zip(names, np.frombuffer(data, "<f4").reshape(3, -1).T, strict=True))
    assert_same_cloud(cloud, expected_cloud(table))
    assert (table["nx"] == 0).all()


def test_2dgs_cloud_with_thick_splats_keeps_its_scales(tmp_path):
    cloud = make_cloud(kernel="3dgs")
    thick = GaussianCloud(cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, cloud.sh, "2dgs")
    with pytest.warns(DataWarning, match="read back as '3dgs'"):
        save_gaussians(thick, tmp_path / "a.ply")
    np.testing.assert_allclose(load_gaussians(tmp_path / "a.ply").scales, cloud.scales, rtol=3e-6)


def test_saving_refuses_what_cannot_be_read(tmp_path):
    cloud = make_cloud(3)
    with pytest.raises(ValueError, match=r"\.ply"):
        save_gaussians(cloud, tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="empty"):
        save_gaussians(cloud.take(np.zeros(3, bool)), tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_model_folders(tmp_path):
    for number in (7000, 30000, 9000):
        folder = tmp_path / "model" / "point_cloud" / f"iteration_{number}"
        folder.mkdir(parents=True)
        save_gaussians(make_cloud(number // 1000), folder / "point_cloud.ply")
    (tmp_path / "model" / "point_cloud" / "iteration_99999").mkdir()  # begun and never written
    (tmp_path / "model" / "input.ply").write_text("ply\n")
    assert len(load_gaussians(tmp_path / "model")) == 30
    assert len(load_gaussians(str(tmp_path / "model" / "point_cloud"))) == 30
    assert len(load_gaussians(tmp_path / "model" / "point_cloud" / "iteration_7000")) == 7


def test_real_files_agree_with_a_reader_of_one_line():
    """guitar: property order differs, no normals; the 2DGS and GaMeS rewrites are the same splats, turned."""
    path = shared_data("splats/guitar_sh0.ply")
    raw = path.read_bytes()
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "rot_0", "rot_1", "rot_2", "rot_3"]
    names += ["scale_0", "scale_1", "scale_2"]
    table = np.frombuffer(raw[361:], np.dtype([(n, "<f4") for n in names]))
    cloud = load_gaussians(path)
    assert len(cloud) == 90_854
    np.testing.assert_array_equal(cloud.means[:, 1], table["y"])
    np.testing.assert_allclose(cloud.scales[:, 2], np.exp(table["scale_2"]), rtol=1e-6)
    flat = load_gaussians(shared_data("splats/guitar_sh0_2dgs.ply"))
    games = load_gaussians(shared_data("splats/guitar_sh0_gamesflat.ply"))
    assert (flat.kernel, games.kernel) == ("2dgs", "3dgs")
    assert (flat.scales[:, 2] == 0).all()
    assert (games.scales[:, 0] < 1e-7).all()
    np.testing.assert_allclose(np.abs(flat.rotations[:, :, 2]), np.abs(games.rotations[:, :, 0]), atol=1e-5)


def test_zero_padded_harmonics_change_nothing():
    short = load_gaussians(shared_data("splats/playbot_lod5_3k_sh2.ply"))
    padded = load_gaussians(shared_data("splats/playbot_lod5_3k_sh2_INRIAorder_sh3.ply"))
    assert (short.sh_degree, padded.sh_degree) == (2, 3)
    np.testing.assert_array_equal(padded.sh[:, :9], short.sh)
    assert (padded.sh[:, 9:] == 0).all()
    np.testing.assert_array_equal(padded.means, short.means)
    np.testing.assert_allclose(padded.opacities, short.opacities, rtol=1e-6)


def test_kernels_of_beta_splats_are_named(tmp_path):
    values = random_splats(5, degree=0)
    plain = write_ply(tmp_path / "a.ply", [splat_table(values)])
    beta = write_ply(tmp_path / "b.ply", [splat_table(values | {"beta": values["x"]})])
    expected = load_gaussians(plain)
    with pytest.warns(DataWarning, match=r"Beta splats: kernels other than Gaussians \(beta\) are left out"):
        cloud = load_gaussians(beta)
    np.testing.assert_array_equal(cloud.sh, expected.sh)


def lobes(count: int, each: int) -> np.ndarray:
    """(count, 6, each) red, green, blue, theta, phi and beta of lobes, as files have them."""
    rng = np.random.default_rng(each)
    stored = rng.uniform(-0.4, 0.6, (count, 6, each))
    stored[:, 3], stored[:, 4] = rng.uniform(0, np.pi, (2, count, each)) * np.array([1, 2])[:, None, None]
    stored[:, 5] = rng.uniform(-1, 2, (count, each))
    return stored.astype(np.float32)


def with_lobes(values: dict[str, np.ndarray], stored: np.ndarray) -> dict[str, np.ndarray]:
    flat = stored.reshape(len(stored), -1)
    return values | {f"sb_params_{i}": flat[:, i] for i in range(flat.shape[1])}


@pytest.mark.parametrize("each", [1, 2, 3])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_lobes_of_beta_splats_become_the_nearest_harmonics(tmp_path, each, degree):
    values, stored = random_splats(6, degree=degree), lobes(6, each)
    plain = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))
    path = write_ply(tmp_path / "b.ply", [splat_table(with_lobes(values, stored))])
    with pytest.warns(DataWarning, match=r"lobes \(sb_params_\*\) become harmonics of degree 3"):
        cloud = load_gaussians(path)
    assert cloud.sh_degree == 3
    # Their formula, in directions that cover the sphere evenly; products with each harmonic.
    i = np.arange(100_000) + 0.5
    z, turn = 1 - 2 * i / len(i), np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    around = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    basis = 4 * np.pi / len(i) * sh_basis(around, 3)
    for n in range(6):
        seen = np.zeros((len(i), 3))
        for red, green, blue, theta, phi, beta in stored[n].T.astype(float):
            u = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
            color = np.log1p(2 ** (10 * np.array([red, green, blue]))) / (10 * np.log(2))
            seen += np.maximum(around @ u, 0)[:, None] ** (4 * np.exp(beta)) * color
        expected = basis.T @ seen
        expected[: plain.sh.shape[1]] += plain.sh[n]
        np.testing.assert_allclose(cloud.sh[n], expected, atol=2e-4)


def test_beta_splats_by_their_own_names(tmp_path):
    """Those of the code of the paper; others write f_dc and f_rest."""
    values = with_lobes(random_splats(6, degree=2), lobes(6, 2))
    renamed = {n.replace("f_dc_", "sh0_").replace("f_rest_", "shN_"): v for n, v in values.items()}
    one, other = (write_ply(tmp_path / f"{k}.ply", [splat_table(v)]) for k, v in enumerate((values, renamed)))
    with pytest.warns(DataWarning):
        np.testing.assert_array_equal(load_gaussians(one).sh, load_gaussians(other).sh)


def test_lobes_without_end_cost_their_splats_only(tmp_path):
    """A narrow lobe is none; without a direction or a colour there is no splat."""
    values, stored = random_splats(4, degree=0), lobes(4, 1)
    stored[0, 5], stored[1, 3], stored[2, 0] = 300, np.nan, np.inf
    plain = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values)]))
    path = write_ply(tmp_path / "b.ply", [splat_table(with_lobes(values, stored))])
    with pytest.warns(DataWarning) as told:
        cloud = load_gaussians(path)
    assert [bool(re.search("2 of 4 splats", str(each.message))) for each in told] == [False, True]
    np.testing.assert_array_equal(cloud.means, plain.means[[0, 3]])
    np.testing.assert_array_equal(cloud.sh[0, 1:], 0)


@pytest.mark.parametrize("names", [range(5), range(1, 7), (0, 1, 2, 3, 4, 6)], ids=str)
def test_lobes_of_beta_splats_are_whole(tmp_path, names):
    values = random_splats(5, degree=0)
    wrong = values | {f"sb_params_{i}": values["x"] for i in names}
    with pytest.raises(
        FileFormatError, match=r"found \d sb_params_\* properties up to \d; .* 6 for each lobe"
    ):
        load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(wrong)]))
