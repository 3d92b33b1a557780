"""All kernels in Tint, the compiler of Dawn and so of Chromium, which is stricter than naga, that of wgpu."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

from _needs import lacking

from meshsplats.scene.order import Order
from meshsplats.webgpu import kernels

FOLDER = Path(__file__).parents[2] / "build" / "dawn"
"""Where `make dawn` installs it."""
ENTRY = re.compile(r"@compute\s+@workgroup_size\([^)]*\)\s*fn\s+(\w+)")


def sources() -> dict[str, str]:
    """Every text that the package gives a compiler, by a name."""
    found = {
        "lists": kernels.lists_source(),
        "filter": kernels.filter_source(),
        "training": kernels.training_source(),
    }
    kinds: list[tuple[int, bool, Order]] = [
        (queue, groups, "fragment")
        for queue, groups in itertools.product((kernels.QUEUE, kernels.LONG_QUEUE), (False, True))
    ]
    for queue, groups, order in [*kinds, (kernels.QUEUE, False, "splat")]:
        name = f"{queue}{' groups' * groups}, {order}"
        found[f"gradients {name}"] = kernels.gradients_source(queue, groups=groups, order=order)
        for output in kernels.OUTPUTS:
            text = kernels.raster_source(queue, output=output, groups=groups, order=order)
            found[f"{output} {name}"] = text
    return found


def compile_all(texts: dict[str, str]) -> dict[str, list[str]]:
    """What Dawn says of each text; skips without node or Dawn."""
    if shutil.which("node") is None:
        lacking("dawn", "node is not installed here")
    if not (FOLDER / "node_modules" / "webgpu").is_dir():
        lacking("dawn", f"there is no {FOLDER / 'node_modules' / 'webgpu'}")
    script = Path(__file__).with_name("compile_with_dawn.mjs")
    given = {name: {"code": code, "entries": ENTRY.findall(code)} for name, code in texts.items()}
    assert all(each["entries"] for each in given.values())
    command = ["node", str(script), str(FOLDER)]
    done = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, timeout=300)
    if "GLIBC" in done.stderr:
        lacking("dawn", f"it does not load here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_kernel_compiles():
    assert {name: problems for name, problems in compile_all(sources()).items() if problems} == {}


def test_every_file_of_kernels_is_among_the_texts():
    """But for the parameters that are put into a text."""
    all_lines = {line for text in sources().values() for line in text.splitlines()}
    for path in files("meshsplats.webgpu").iterdir():
        if path.name.endswith(".wgsl"):
            lines = [line for line in path.read_text("utf-8").splitlines() if "$" not in line]
            assert all_lines.issuperset(lines), path.name


TYPES = "@group(0) @binding(0) var<storage, read_write> data: array<u32>;\n"
MAIN = "@compute @workgroup_size(64) fn main(@builtin(local_invocation_index) i: u32) {{ {} }}"
WRONG = {
    "a name that is not there": (TYPES + MAIN.format("data[0] = lenght;"), "unresolved"),
    "a barrier that not all reach": (
        TYPES + MAIN.format("if (data[i] > 0) { workgroupBarrier(); }"),
        "uniform control flow",
    ),
    "more memory than a workgroup has": (
        TYPES + "var<workgroup> ours: array<u32, 8192>;\n" + MAIN.format("ours[i] = 1; data[i] = ours[0];"),
        "workgroup storage",
    ),
    "more buffers than a stage has": (
        "\n".join(f"@group(0) @binding({i}) var<storage> b{i}: array<u32>;" for i in range(10))
        + MAIN.format("_ = " + " + ".join(f"b{i}[0]" for i in range(10)) + ";"),
        "storage buffers",
    ),
}


def test_mistakes_are_found():
    said = compile_all({name: code for name, (code, _) in WRONG.items()})
    for name, (_, message) in WRONG.items():
        assert any(message in problem for problem in said[name]), f"{name}: {said[name]}"
