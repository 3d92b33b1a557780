"""LPIPS against the package ``lpips`` and its formula, with random weights; wrong and missing files."""

from __future__ import annotations

import importlib.util
import sys
import types

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="LPIPS needs torch: pip install 'meshsplats[torch]'")

from torch import nn  # noqa: E402

from meshsplats.errors import FileFormatError  # noqa: E402
from meshsplats.evaluation.lpips import load_lpips  # noqa: E402
from meshsplats.evaluation.report import Report  # noqa: E402
from meshsplats.evaluation.results import notes  # noqa: E402

NETWORKS = ("vgg", "alex")
CHANNELS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
# Where features are taken: numbers of the activations in torchvision's networks.
TAPS = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}


def features(network: str) -> nn.Sequential:
    """The layers named ``features`` of torchvision's vgg16 and alexnet."""
    if network == "alex":
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, 2),
            nn.Conv2d(64, 192, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, 2),
            nn.Conv2d(192, 384, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
            nn.MaxPool2d(3, 2),
        )
    layers: list[nn.Module] = []
    inputs = 3
    for size in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0):
        layers += [nn.Conv2d(inputs, size, 3, padding=1), nn.ReLU()] if size else [nn.MaxPool2d(2, 2)]
        inputs = size or inputs
    return nn.Sequential(*layers)


def backbone(network: str) -> nn.Module:
    model = nn.Module()
    torch.manual_seed(1)
    model.features = features(network)
    with torch.no_grad():
        for layer in model.features:
            if isinstance(layer, nn.Conv2d):  # values that neither vanish nor explode
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                layer.bias.uniform_(-0.1, 0.1)
    # A part that LPIPS does not use, as in torchvision's files.
    model.classifier = nn.Sequential(nn.Linear(2, 2))
    return model


def heads(network: str) -> dict:
    generator = torch.Generator().manual_seed(2)
    return {
        f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for i, channels in enumerate(CHANNELS[network])
    }


FILES = {
    "vgg": ("vgg16-397923af.pth", "vgg.pth"),
    "alex": ("alexnet-owt-7be5be79.pth", "alex.pth"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One folder with the files of both networks, and one that has no business there."""
    folder = tmp_path_factory.mktemp("weights")
    for network, (first, second) in FILES.items():
        torch.save(backbone(network).state_dict(), folder / first)
        torch.save(heads(network), folder / second)
    (folder / "readme.txt").write_text("not weights")
    (folder / "squeeze.pth").write_text("not weights")
    return folder


def image_pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    a = rng.random((height, width, 3)).astype(np.float32)
    return a, np.clip(a + rng.normal(0, 0.2, a.shape), 0, 1).astype(np.float32)


def by_formula(network: str, a: np.ndarray, b: np.ndarray, convention: str) -> float:
    """Layer by layer, in float64."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    layers, weights = backbone(network).double().features, list(heads(network).values())
    maps = []
    for image in (a, b):
        x = image.astype(np.float64)
        x = ((2 * x - 1 if convention == "lpips" else x) - shift) / scale
        x = torch.from_numpy(x).permute(2, 0, 1)[None]
        taken = []
        with torch.no_grad():
            for number, layer in enumerate(layers[: TAPS[network][-1] + 1]):
                x = layer(x)
                if number in TAPS[network]:
                    taken.append(x[0].numpy())
        maps.append(taken)
    total = 0.0
    for one, two, weight in zip(*maps, weights, strict=True):
        one, two = (f / np.sqrt((f**2).sum(axis=0)) for f in (one, two))
        total += (weight.numpy().reshape(-1, 1, 1) * (one - two) ** 2).sum(axis=0).mean()
    return total


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("size", [(31, 47), (64, 50)])
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("convention", ["3dgs", "lpips"])
def test_it_is_the_formula(folder, network, size, convention):
    a, b = image_pair(*size)
    distance = load_lpips(folder, network=network, convention=convention)
    expected = by_formula(network, a, b, convention)
    assert expected > 0.01
    assert distance(a, b) == pytest.approx(expected, rel=1e-5)
    assert distance(b.astype(np.float64), a) == pytest.approx(expected, rel=1e-5)
    assert distance(a, a) == 0


@pytest.mark.parametrize(("network", "convention"), [("vgg", "3dgs"), ("alex", "lpips")])
def test_the_convention_is_that_of_splatting_papers(folder, network, convention):
    """metrics.py of 3DGS gives VGG images as they are, gsplat gives AlexNet scaled ones."""
    distance = load_lpips(folder, network=network)
    assert (distance.network, distance.convention) == (network, convention)
    a, b = image_pair(40, 40)
    assert distance(a, b) == load_lpips(folder, network=network, convention=convention)(a, b)
    assert distance(a, b) == pytest.approx(by_formula(network, a, b, convention), rel=1e-5)


def test_the_table_names_network_and_convention():
    about = {"held_out": True, "samples": 2, "ground_truth": "photographs", "splats": None}
    about |= {"views": 1, "background_description": "white", "lpips_network": None, "lpips_convention": None}
    assert "LPIPS" not in " ".join(notes([Report("", (), about)]))
    about |= {"lpips_network": "vgg", "lpips_convention": "3dgs"}
    assert notes([Report("", (), about)])[-1] == "LPIPS: network vgg, convention '3dgs'."


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("network", NETWORKS)
def test_it_is_the_package_lpips(folder, network, monkeypatch, tmp_path):
    # The package takes its networks from torchvision, which is not needed for this: the same layers stand in.
    models = types.ModuleType("torchvision.models")
    models.vgg16 = lambda pretrained: backbone("vgg")
    models.alexnet = lambda pretrained: backbone("alex")
    vision = types.ModuleType("torchvision")
    vision.models = models
    monkeypatch.setitem(sys.modules, "torchvision", vision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    if importlib.util.find_spec("tqdm") is None:  # shows the progress of training
        monkeypatch.setitem(sys.modules, "tqdm", types.SimpleNamespace(tqdm=None))
    for name in [name for name in sys.modules if name.split(".")[0] == "lpips"]:
        monkeypatch.delitem(sys.modules, name)
    package = pytest.importorskip("lpips", reason="compared with the package lpips: pip install lpips")
    torch.save(heads(network), tmp_path / "heads.pth")
    model = package.LPIPS(net=network, model_path=str(tmp_path / "heads.pth"), verbose=False)
    a, b = image_pair(64, 70)
    batch = [torch.from_numpy(p).permute(2, 0, 1)[None] for p in (a, b)]
    with torch.no_grad():
        expected = model(*batch, normalize=True).item()
    distance = load_lpips(folder, network=network, convention="lpips")
    assert distance(a, b) == pytest.approx(expected, rel=1e-5)
    # The whole module in one file.
    torch.save(model.state_dict(), tmp_path / "whole.pth")
    whole = load_lpips(tmp_path / "whole.pth", network=network, convention="lpips")
    assert whole(a, b) == pytest.approx(expected, rel=1e-5)


def test_files_can_be_named_and_be_safetensors(folder, tmp_path):
    safetensors = pytest.importorskip("safetensors.torch", reason="about safetensors files")
    a, b = image_pair(40, 40)
    expected = load_lpips(folder, network="alex")(a, b)
    first, second = (folder / name for name in FILES["alex"])
    assert load_lpips([str(first), second], network="alex")(a, b) == expected
    for name in FILES["alex"]:
        safetensors.save_file(
            torch.load(folder / name, weights_only=True), tmp_path / f"{name[:-4]}.safetensors"
        )
    assert load_lpips(tmp_path, network="alex")(a, b) == expected


def test_names_of_a_whole_module_stored_once(folder, tmp_path):
    first, second = (torch.load(folder / name, weights_only=True) for name in FILES["alex"])
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    whole = {
        f"net.slice{slices[int(name.split('.')[1])]}.{name.removeprefix('features.')}": tensor
        for name, tensor in first.items()
        if name.startswith("features")
    }
    whole |= {name.replace("lin", "lins."): tensor for name, tensor in second.items()}
    torch.save(whole, tmp_path / "whole.pth")
    a, b = image_pair(40, 40)
    assert load_lpips(tmp_path / "whole.pth", network="alex")(a, b) == load_lpips(folder, network="alex")(
        a, b
    )


def test_without_weights_there_is_no_distance():
    assert load_lpips(None) is None
    with pytest.raises(ValueError, match="network must be one of vgg, alex, got 'squeeze'"):
        load_lpips(None, network="squeeze")
    with pytest.raises(ValueError, match="convention must be one of 3dgs, lpips, got 'valid'"):
        load_lpips(None, convention="valid")


def test_wrong_files_are_refused(folder, tmp_path):
    first, second = (folder / name for name in FILES["alex"])
    with pytest.raises(FileNotFoundError, match=r"no weights for LPIPS at .*nowhere: no such file"):
        load_lpips(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"put torchvision's vgg16-397923af\.pth and vgg\.pth"):
        load_lpips(tmp_path)
    with pytest.raises(FileNotFoundError, match="at least one file"):
        load_lpips([])
    with pytest.raises(
        FileFormatError, match=r"no lin0 \(5 of 15 tensors .* missing\); needed are .*alexnet-owt"
    ):
        load_lpips(first, network="alex")
    with pytest.raises(FileFormatError, match=r"no features\.0\.weight \(10 of 15"):
        load_lpips(second, network="alex")
    with pytest.raises(FileFormatError, match=r"no features\.2\.weight"):
        load_lpips([first, second], network="vgg")
    with pytest.raises(
        FileFormatError, match=r"lin1 has shape \(1, 128, 1, 1\), .*\(1, 192, 1, 1\): .*another network"
    ):
        load_lpips([first, folder / "vgg.pth"], network="alex")
    with pytest.raises(FileFormatError, match=r"both hold lin0: give one of them only"):
        load_lpips([first, second, folder / "vgg.pth"], network="alex")
    changed = tmp_path / "alex.pth"
    for value, match in [
        (float("nan"), "lin2 has values that are not finite"),
        (None, "lin2 must hold floats"),
    ]:
        tensors = heads("alex")
        if value is None:
            tensors["lin2.model.1.weight"] = tensors["lin2.model.1.weight"].to(torch.int64)
        else:
            tensors["lin2.model.1.weight"][0, 5] = value
        torch.save(tensors, changed)
        with pytest.raises(FileFormatError, match=match):
            load_lpips([first, changed], network="alex")


class Harmful:
    """Would leave a trace if a reader ran it."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return (open, (str(self.trace), "w"))


def test_broken_and_hostile_files(folder, tmp_path):
    file, trace = tmp_path / "alex.pth", tmp_path / "trace"
    whole = (folder / "alex.pth").read_bytes()
    for content in (b"", b"nonsense", whole[: len(whole) // 2], b"PK\x03\x04" + bytes(100)):
        for name in ("alex.pth", "alex.safetensors"):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(FileFormatError, match=r"alex\.\w+: not a (file of weights|safetensors file)"):
                load_lpips(tmp_path / name, network="alex")
    torch.save({"lin0.model.1.weight": Harmful(trace)}, file)
    with pytest.raises(FileFormatError, match="not a file of weights"):
        load_lpips(file, network="alex")
    assert not trace.exists()
    for content in ([torch.zeros(2)], {"a": 1}, {3: torch.zeros(2)}, torch.zeros(2)):
        torch.save(content, file)
        with pytest.raises(FileFormatError, match="not a file of named tensors"):
            load_lpips(file, network="alex")


def test_bad_images_are_refused(folder):
    for network, smallest in (("vgg", 16), ("alex", 31)):
        distance = load_lpips(folder, network=network)
        a, b = image_pair(smallest, smallest)
        assert np.isfinite(distance(a, b))
        with pytest.raises(
            ValueError, match=rf"at least {smallest} x {smallest} pixels, got {smallest - 1} x"
        ):
            distance(a[1:], b[1:])
        with pytest.raises(ValueError, match=r"RGB images \(h, w, 3\), got"):
            distance(a[..., 0], b[..., 0])
        with pytest.raises(ValueError, match="same shape"):
            distance(a, b[1:])
        with pytest.raises(TypeError, match="divide bytes by 255"):
            distance((a * 255).astype(np.uint8), (b * 255).astype(np.uint8))


def test_gradients_are_left_alone(folder):
    a, b = image_pair(40, 40)
    load_lpips(folder, network="alex")(a, b)
    assert torch.is_grad_enabled()
