"""Engines: the processor and the GPU behind one interface."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

import meshsplats
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.devices import engine
from meshsplats.rendering.engine import Need
from meshsplats.rendering.gpu import CANNOT, NOT_FUSED
from meshsplats.webgpu import frames, gradients, training
from meshsplats.webgpu.device import CORE_BINDING
from meshsplats.webgpu.layout import FANS_IN_WORKGROUP, MAX_WORKGROUPS

SOURCE = Path(meshsplats.__file__).parent
PAGE = SOURCE.parents[1] / "docs" / "webgpu.md"


def asks(pattern: str, *folders: str) -> list[str]:
    """Modules in these folders with a line of that pattern."""
    paths = [path for folder in folders for path in sorted((SOURCE / folder).rglob("*.py"))]
    return [
        path.relative_to(SOURCE).as_posix() for path in paths if re.search(pattern, path.read_text("utf-8"))
    ]


def test_a_device_has_one_engine():
    assert engine("cpu", 3) == CpuEngine(3)
    assert engine("gpu", 3) is engine("gpu")
    with pytest.raises(ValueError, match="device must be 'cpu' or 'gpu', got 'cuda'"):
        engine("cuda")  # type: ignore[arg-type]


def test_one_module_asks_for_the_device():
    rooms = [path.name for path in SOURCE.iterdir() if path.is_dir() and path.name != "cli"]
    assert asks(r"device\W* [!=]= \W*[cg]pu", *rooms) == ["rendering/devices.py"]


def test_one_module_chooses_the_phases_of_a_run():
    assert asks(r"opacity\W* [!=]= \W*(cutoff|blended)", "finetuning", "training") == ["finetuning/config.py"]
    assert asks(r"config\.cuts", "finetuning/phases", "training") == ["finetuning/phases/choice.py"]


@pytest.mark.skipif(not PAGE.is_file(), reason="the documents are not here")
def test_what_the_gpu_cannot_do_is_documented():
    assert NOT_FUSED.isdisjoint(CANNOT)
    assert NOT_FUSED.union(CANNOT) == set(get_args(Need))
    text = PAGE.read_text("utf-8").partition("## What it cannot do")[2].partition("\n## ")[0]
    for need in get_args(Need):
        assert need in text
    for limit in (frames.MAX_FAN, gradients.MAX_FAN, gradients.MAX_VALENCE):
        assert f"{limit:,}" in text
    pixels, harmonics = CORE_BINDING // training.DERIVATIVE_BYTES, CORE_BINDING // 12
    assert f"{pixels / 1e6:.1f} million pixels" in text
    assert f"{harmonics / 3e6:.1f} million splats of degree 1, {harmonics / 8e6:.1f} million" in text
    assert f"{MAX_WORKGROUPS * FANS_IN_WORKGROUP / 1e6:.1f} million splats" in text
