"""Splats to and from the tensors of training programs."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import (
    DataWarning,
    FileFormatError,
    GaussianCloud,
    gaussians_from_tensors,
    gaussians_to_tensors,
    load_gaussians,
    save_gaussians,
)
from meshsplats.demo_scene import make_scene
from meshsplats.scene.gaussians import SH_C0

LAYOUTS = ("gsplat", "inria", "nerfstudio")
FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


def trained(n: int = 50, degree: int = 2, seed: int = 0) -> dict[str, np.ndarray]:
    """Parameters as training leaves them, in the layout of gsplat."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.1, 30, (n, 1)),
        "scales": rng.uniform(-12, 2, (n, 3)),
        "opacities": rng.uniform(-8, 8, n),
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)),
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def activated(n: int, degree: int, seed: int, ends: bool) -> GaussianCloud:
    """A cloud, with opacities of 0 and 1 and a scale of 0 where ``ends``."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    scales, opacities = np.exp(rng.uniform(-20, 3, (n, 3))), rng.uniform(size=n)
    if ends:
        opacities[0], opacities[-1] = 0, 1
        scales[0, 0] = 0
    sh = rng.normal(size=(n, (degree + 1) ** 2, 3))
    return GaussianCloud(rng.normal(size=(n, 3)), quaternions, scales, opacities, sh)


clouds = st.builds(activated, st.integers(1, 40), st.integers(0, 3), st.integers(0, 10**6), st.booleans())


def assert_close(found: GaussianCloud, wanted: GaussianCloud) -> None:
    """Exact, but for what passes through logarithms, logits and lengths in float32."""
    np.testing.assert_array_equal(found.means, wanted.means)
    np.testing.assert_array_equal(found.sh, wanted.sh)
    np.testing.assert_allclose(found.quaternions, wanted.quaternions, atol=2e-7)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=1e-5, atol=1.2e-38)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=1e-6)


def test_the_formulas_of_the_programs():
    """By hand: exp, sigmoid, w x y z divided by the length, harmonics one after the other."""
    cloud = gaussians_from_tensors(
        {
            "means": np.array([[1.0, 2, 3]]),
            "quats": np.array([[0.0, 0, 3, 4]]),
            "scales": np.log([[0.5, 2, 8]]),
            "opacities": np.array([np.log(3)]),
            "sh0": np.array([[[0.1, 0.2, 0.3]]]),
            "shN": np.arange(9.0).reshape(1, 3, 3),
        }
    )
    np.testing.assert_array_equal(cloud.means, [[1, 2, 3]])
    np.testing.assert_allclose(cloud.quaternions, [[0, 0, 0.6, 0.8]], atol=1e-7)
    np.testing.assert_allclose(cloud.scales, [[0.5, 2, 8]], rtol=1e-6)
    np.testing.assert_allclose(cloud.opacities, [0.75], rtol=1e-6)
    np.testing.assert_allclose(cloud.sh[0], [[0.1, 0.2, 0.3], [0, 1, 2], [3, 4, 5], [6, 7, 8]], rtol=1e-7)
    assert cloud.kernel == "3dgs"


@given(clouds, st.sampled_from(LAYOUTS))
def test_there_and_back(cloud, layout):
    found = gaussians_from_tensors(gaussians_to_tensors(cloud, layout))
    if layout == "nerfstudio" and cloud.sh_degree == 0:
        np.testing.assert_allclose(found.colors, cloud.colors, atol=1e-6)
        return
    assert_close(found, cloud)
    ends = (cloud.opacities == 0) | (cloud.opacities == 1)
    np.testing.assert_allclose(found.opacities[ends], cloud.opacities[ends], atol=1e-13)


@given(st.integers(0, 10**6), st.sampled_from((0, 1, 2, 3)))
def test_back_and_there(seed, degree):
    before = trained(20, degree, seed)
    found = gaussians_to_tensors(gaussians_from_tensors(before))
    assert list(found) == list(before)
    for name in ("means", "sh0", "shN"):
        np.testing.assert_array_equal(found[name], before[name])
    np.testing.assert_allclose(found["scales"], before["scales"], atol=2e-6)
    np.testing.assert_allclose(found["opacities"], before["opacities"], atol=1e-3)  # float32 near 1
    length = np.linalg.norm(before["quats"], axis=1, keepdims=True)
    np.testing.assert_allclose(found["quats"], before["quats"] / length, atol=1e-6)
    assert all(array.dtype == np.float32 and array.flags["C_CONTIGUOUS"] for array in found.values())


@given(clouds, st.sampled_from(("gsplat", "inria")))
def test_a_file_of_the_program_has_the_same_bits(tmp_path_factory, cloud, layout):
    path = tmp_path_factory.mktemp("splats") / "a.ply"
    save_gaussians(cloud, path)
    found, wanted = gaussians_from_tensors(gaussians_to_tensors(cloud, layout)), load_gaussians(path)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_shapes_and_names_of_each_layout():
    cloud = gaussians_from_tensors(trained(7, 1))
    shapes = {
        layout: {name: array.shape for name, array in gaussians_to_tensors(cloud, layout).items()}
        for layout in LAYOUTS
    }
    common = {"means": (7, 3), "quats": (7, 4), "scales": (7, 3)}
    assert shapes["gsplat"] == common | {"opacities": (7,), "sh0": (7, 1, 3), "shN": (7, 3, 3)}
    rest = {"opacities": (7, 1), "features_dc": (7, 3), "features_rest": (7, 3, 3)}
    assert shapes["nerfstudio"] == common | rest
    assert shapes["inria"] == {
        "_xyz": (7, 3),
        "_rotation": (7, 4),
        "_scaling": (7, 3),
        "_opacity": (7, 1),
        "_features_dc": (7, 1, 3),
        "_features_rest": (7, 3, 3),
    }
    for layout in LAYOUTS:
        arrays = gaussians_to_tensors(cloud, layout)
        assert_close(gaussians_from_tensors(arrays), cloud)
        assert_close(gaussians_from_tensors(SimpleNamespace(**arrays)), cloud)  # a GaussianModel, say
        for array in arrays.values():
            array[:] = 0  # copies: the cloud stays as it is
    assert cloud.means.any()
    assert cloud.sh[:, 1:].any()


def test_colours_of_degree_0_in_nerfstudio_are_logits():
    tensors = gaussians_to_tensors(gaussians_from_tensors(trained(5, 0)), "nerfstudio")
    tensors["features_dc"] = np.log(np.array([[3.0, 1, 1 / 3]] * 5))
    np.testing.assert_allclose(gaussians_from_tensors(tensors).colors, [[0.75, 0.5, 0.25]] * 5, atol=1e-6)
    of_gsplat = trained(5, 0) | {"sh0": np.full((5, 1, 3), 0.25 / SH_C0)}
    del of_gsplat["shN"]  # degree 0, too
    np.testing.assert_allclose(gaussians_from_tensors(of_gsplat).colors, 0.75, atol=1e-6)


def test_flat_splats():
    tensors = trained(6, 0)
    flat = gaussians_from_tensors(tensors, kernel="2dgs")
    assert flat.kernel == "2dgs"
    assert not flat.scales[:, 2].any()
    of_2dgs = gaussians_to_tensors(flat, "inria")
    assert of_2dgs["_scaling"].shape == (6, 2)
    again = gaussians_from_tensors(of_2dgs)
    assert again.kernel == "2dgs"
    assert_close(again, flat)
    assert gaussians_from_tensors(tensors, kernel="antialiased").kernel == "antialiased"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_torch(layout):
    torch = pytest.importorskip("torch", reason="pip install 'meshsplats[torch]'")
    cloud = gaussians_from_tensors(trained(9, 2))
    tensors = gaussians_to_tensors(cloud, layout, torch=True)
    assert all(isinstance(t, torch.Tensor) and t.dtype == torch.float32 for t in tensors.values())
    assert_close(gaussians_from_tensors(tensors), cloud)
    parameters = {name: torch.nn.Parameter(tensor) for name, tensor in tensors.items()}
    assert_close(gaussians_from_tensors(parameters), cloud)
    assert_close(gaussians_from_tensors(torch.nn.ParameterDict(parameters)), cloud)
    for kind, tolerance in ((torch.float16, 0.02), (torch.bfloat16, 0.1), (torch.float64, 1e-5)):
        found = gaussians_from_tensors({name: tensor.to(kind) for name, tensor in tensors.items()})
        np.testing.assert_allclose(found.scales, cloud.scales, rtol=tolerance)
        np.testing.assert_allclose(found.sh, cloud.sh, rtol=tolerance, atol=1e-6)


class OnGpu:
    """Behaves as a tensor with gradients on a GPU: NumPy gets it after detach and cpu only."""

    def __init__(self, array: np.ndarray, done: tuple[str, ...] = ()) -> None:
        self._array, self._done = array, done

    def detach(self) -> OnGpu:
        return OnGpu(self._array, (*self._done, "detach"))

    def cpu(self) -> OnGpu:
        return OnGpu(self._array, (*self._done, "cpu"))

    def float(self) -> OnGpu:
        return OnGpu(self._array.astype(np.float32), self._done)

    def numpy(self) -> np.ndarray:
        assert set(self._done) == {"detach", "cpu"}
        return self._array

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


def test_tensors_on_a_gpu():
    tensors = trained(4, 1)
    found = gaussians_from_tensors({name: OnGpu(array) for name, array in tensors.items()})
    assert_close(found, gaussians_from_tensors(tensors))


def test_torch_is_not_imported_for_arrays():
    code = (
        "import sys, numpy as np, meshsplats as ms\n"
        "ones = np.ones((1, 3))\n"
        "cloud = ms.GaussianCloud(ones, [[1, 0, 0, 0]], ones, [1], np.zeros((1, 1, 3)))\n"
        "ms.gaussians_from_tensors(ms.gaussians_to_tensors(cloud))\n"
        "assert 'torch' not in sys.modules\n"
        "sys.modules['torch'] = None\n"
        "try:\n"
        "    ms.gaussians_to_tensors(cloud, torch=True)\n"
        "except ms.MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("torch tensors need torch; ")


def test_unusable_splats_are_left_out_or_refused():
    tensors = trained(5, 0)
    tensors["quats"][1] = 0
    tensors["means"][3, 1] = np.nan
    tensors["opacities"][:] = np.inf  # an opacity of 1
    with pytest.warns(DataWarning, match="the tensors of gsplat: 2 of 5 splats are unusable") as caught:
        cloud = gaussians_from_tensors(tensors)
    assert caught[0].filename == __file__
    assert len(cloud) == 3
    assert (cloud.opacities == 1).all()
    with pytest.raises(FileFormatError, match="1 with a zero quaternion; the first is splat 1"):
        gaussians_from_tensors(tensors, strict=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quats": np.zeros((4, 3))}, r"'quats' must have shape \(5, 4\), got \(4, 3\)"),
        ({"shN": np.zeros((5, 3, 8))}, r"\(5, k, 3\) with k = 0, 3, 8 or 15, got \(5, 3, 8\)"),
        ({"opacities": np.zeros((5, 2))}, r"'opacities' must have shape \(5,\) or \(5, 1\), got \(5, 2\)"),
        ({"means": np.zeros((0, 3))}, r"'means' holds no splats, its shape is \(0, 3\)"),
        ({"means": np.float32(3)}, r"'means' must have shape \(n, 3\), got \(\)"),
        ({"sh0": None}, r"tensors must hold means, quats, .* as gsplat does; missing: 'sh0'"),
    ],
)
def test_tensors_that_do_not_fit(change, message):
    with pytest.raises(ValueError, match=message):
        gaussians_from_tensors({k: v for k, v in (trained(5) | change).items() if v is not None})


@pytest.mark.parametrize(
    ("tensors", "words"),
    [
        ("a.pt", "the text 'a.pt'"),
        (None, "got None"),
        ({"state": 1}, "a dict with state"),
        ([1, 2], "a list of 2 int"),
        (gaussians_from_tensors(trained(2)), "got a GaussianCloud"),
        ({"means": "a", "quats": "b", "scales": "c", "opacities": "d", "sh0": "e"}, "the text 'a'"),
    ],
)
def test_what_holds_no_tensors(tensors, words):
    with pytest.raises(TypeError, match=words):
        gaussians_from_tensors(tensors)


def test_a_layout_that_is_none():
    with pytest.raises(ValueError, match="layout must be one of gsplat, inria, nerfstudio, got 'ply'"):
        gaussians_to_tensors(gaussians_from_tensors(trained(2)), "ply")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_values_after_activation_are_told_of_and_taken(layout):
    cloud = make_scene(600).of_degree(1)
    tensors = gaussians_to_tensors(cloud, layout)
    gaussians_from_tensors(tensors)  # says nothing
    for name, array in tensors.items():
        if "scal" in name:
            tensors[name] = np.exp(array)
        elif "opac" in name:
            tensors[name] = cloud.opacities.reshape(array.shape)
    with pytest.warns(DataWarning, match=rf"tensors of {layout}: .* activated=scales,opacities") as told:
        gaussians_from_tensors(tensors)
    assert told[0].filename == __file__
    assert_close(gaussians_from_tensors(tensors, activated=["scales", "opacities"]), cloud)
    with pytest.raises(ValueError, match="activated must be of scales, opacities, colors, got 'size'"):
        gaussians_from_tensors(tensors, activated=["size"])
