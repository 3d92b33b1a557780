"""The WGSL text of the kernels, and the frame: which kernel runs when, on which buffers, how often.

Any host can run it, in Python or in a browser: docs/webgpu.md describes what a host has to do.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, Literal

QUEUE = 16
"""Default length of the fragment queue of each sample, in the first walk through a tile list."""

LONG_QUEUE = 32
"""The same in later walks, of the tiles whose first queues were too short."""

TILE = 8
"""Samples along each side of a tile."""

RUN = 8
"""Most triangles of a run."""

MAX_TILES = 65535
"""Tiles of one frame: their indices have 16 bits, and 65535 stands for none."""

MAX_PAIRS = 16_000_000
"""Pairs of a run and a tile in one frame."""

MAX_RUNS = 1 << 24
MAX_FACES = 1 << 29

Output = Literal["color", "depth", "vertex_normals", "face_normals"]
OUTPUTS: tuple[Output, ...] = ("color", "depth", "vertex_normals", "face_normals")


def lists_source() -> str:
    """WGSL of the kernels that make the tile lists, and of ``resolve``."""
    return _text("common.wgsl") + _text("lists.wgsl")


def raster_source(queue: int = QUEUE, *, output: Output = "color", groups: bool = False) -> str:
    """WGSL of ``raster``.

    Args:
        queue: fragments that each sample keeps at a time, at least 2. The image does not depend on it.
        output: what is blended: the values of the vertices, the depth of the fragment, or unit normals that
            face the camera, from those of the vertices or from their positions.
        groups: whether the mesh has depth groups.
    """
    if queue < 2:
        raise ValueError(f"queue must be at least 2, got {queue}")
    text = _text("raster.wgsl").replace("$OUTPUT", str(OUTPUTS.index(output)))
    text = text.replace("$GROUPS", str(groups).lower()).replace("$K", str(queue))
    return _text("common.wgsl") + text


def _text(name: str) -> str:
    return files("meshsplats.webgpu").joinpath(name).read_text("utf-8")


DIGITS = ((0, 0), (8, 0), (16, 0), (24, 0), (24, 1))
"""Shift and word of each digit of the sort: the depth key from its lowest byte on, then the tile."""


def list_steps() -> list[dict[str, Any]]:
    """The steps from vertices to sorted tile lists, in their order, as JSON values.

    A step ``{"kernel": name, "bind": {binding: buffer}, ...}`` is a dispatch. Its size is ``"count": [name,
    n]``, the quotient of a count and n, rounded up, or ``"indirect": [buffer, byte]``. With ``"if": name`` it
    is left out where that count is 0. A buffer ``digits.i`` is the uniform of 16 bytes from byte 256 i on in
    the buffer ``digits``. A step ``{"clear": buffer, "from": byte}`` fills a buffer with 0.
    """
    steps: list[dict[str, Any]] = [{"clear": name, "from": 0} for name in ("counters", "group_bounds")]

    def add(kernel: str, bind: dict[int, str], *, only_if: str | None = None, **size: Any) -> None:
        condition = {} if only_if is None else {"if": only_if}
        steps.append(
            {"kernel": kernel, "bind": {str(i): name for i, name in bind.items()}, **size, **condition}
        )

    def scan(digit: str, data: str, **size: Any) -> None:
        common = {0: "frame", 11: "sums", 13: "plan", 17: digit}
        add("scan_blocks", {**common, 10: data}, **size)
        add("scan_sums", common, count=["one", 1])
        add("scan_add", {**common, 10: data}, **size)

    add("project", {0: "frame", 1: "vertices", 6: "projected"}, count=["vertices", 256])
    filtered = {0: "frame", 1: "vertices", 2: "values", 3: "mesh", 4: "fans", 6: "projected"}
    add("widen", filtered, count=["fans", 64], only_if="fans")
    bounds = {0: "frame", 3: "mesh", 5: "projected", 7: "group_bounds"}
    add("bound_groups", bounds, count=["faces", 256], only_if="groups")
    planes = {0: "frame", 3: "mesh", 6: "projected", 7: "group_bounds"}
    add("find_planes", planes, count=["groups", 64], only_if="groups")
    boxes = {0: "frame", 3: "mesh", 5: "projected", 8: "boxes", 10: "offsets"}
    add("bound_runs", boxes, count=["runs", 256])
    scan(f"digits.{len(DIGITS)}", "offsets", count=["runs", 2048])
    add("make_plan", {0: "frame", 11: "sums", 12: "plan", 19: "counters"}, count=["one", 1])
    pairs = {0: "frame", 3: "mesh", 5: "projected", 9: "boxes", 13: "plan", 14: "offsets", 15: "pairs_a"}
    add("emit", pairs, indirect=["plan", 24])
    source, target = "pairs_a", "pairs_b"
    for i in range(len(DIGITS)):
        digit = f"digits.{i}"
        add("count_digits", {10: "table", 13: "plan", 16: source, 17: digit}, indirect=["plan", 0])
        scan(digit, "table", indirect=["plan", 12])
        add("scatter", {10: "table", 13: "plan", 15: target, 16: source, 17: digit}, indirect=["plan", 0])
        source, target = target, source
    assert source == "pairs_b"
    return steps


def raster_steps() -> list[dict[str, Any]]:
    """The steps from sorted pairs to samples: the first walk through all lists, and two more of those that
    need them."""
    return [
        *({"clear": "counters", "from": 8}, {"clear": "lists", "from": 0}, {"clear": "again", "from": 0}),
        {
            "kernel": "find_lists",
            "bind": {"13": "plan", "16": "pairs_b", "18": "lists"},
            "indirect": ["plan", 24],
        },
        _raster("raster", "lists", "again", count=["tiles", 1]),
        *again_steps(),
    ]


def again_steps() -> list[dict[str, Any]]:
    """Two more walks through the lists that need them. A host repeats them until there are none."""
    return [
        {"clear": "lists", "from": 0},
        _raster("raster_again", "again", "lists", indirect=["again", 0]),
        {"clear": "again", "from": 0},
        _raster("raster_again", "lists", "again", indirect=["lists", 0]),
    ]


def resolve_steps() -> list[dict[str, Any]]:
    """From samples to pixels; without effect for one sample in each pixel."""
    bind = {"0": "frame", "20": "samples", "21": "pixels"}
    return [{"kernel": "resolve", "bind": bind, "count": ["columns", 8], "rows": ["rows", 8]}]


def _raster(kernel: str, work: str, next_work: str, **size: Any) -> dict[str, Any]:
    bind = ("frame", "projected", "mesh", "values", "pairs_b", work, "samples", next_work, "counters")
    return {"kernel": kernel, "bind": {str(i): name for i, name in enumerate(bind)}, **size}
