"""The WGSL text of the kernels, and the frame: which kernel runs when, on which buffers, how often.

Any host can run it, in Python or in a browser: docs/webgpu-host.md describes what a host has to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from typing import Any, Literal

from meshsplats.scene.order import Order

QUEUE = 32
"""Default length of the fragment queue of each sample, in the first walk through a tile list."""

LONG_QUEUE = 64
"""The same in later walks, of the tiles whose first queues were too short."""

TILE = 8
"""Samples along each side of a tile."""

RUN = 8
"""Most triangles of a run."""

CORE_TILES: dict[Order, int] = {"fragment": 16, "splat": 32}
"""Samples along each side of a tile of the core, from whose corners the core's numbers are rounded."""

MAX_TILES = 65535
"""Tiles of one frame: their indices have 16 bits, and 65535 stands for none."""

MAX_PAIRS = 16_000_000
"""Pairs of a run and a tile in one frame."""

MAX_RUNS = 1 << 24

Output = Literal["color", "depth", "vertex_normals", "face_normals"]
OUTPUTS: tuple[Output, ...] = ("color", "depth", "vertex_normals", "face_normals")


def lists_source() -> str:
    """WGSL of the kernels that shade and make the tile lists, and of ``resolve``."""
    names = ("common", "lists", "harmonics", "shading", "sorting", "splat_order")
    return "".join(_text(f"{name}.wgsl") for name in names)


def raster_source(
    queue: int = QUEUE, *, output: Output = "color", groups: bool = False, order: Order = "fragment"
) -> str:
    """WGSL of ``raster``.

    Args:
        queue: fragments that each sample keeps at a time, at least 2. The image does not depend on it.
        output: what is blended: the values of the vertices, the depth of the fragment, or unit normals that
            face the camera, from those of the vertices or from their positions.
        groups: whether the mesh has depth groups; the order 'fragment' alone knows them.
        order: of blending. 'splat' has no queue.
    """
    return _raster_source(queue, output, groups, order) + _text("image.wgsl")


def gradients_source(queue: int = QUEUE, *, groups: bool = False, order: Order = "fragment") -> str:
    """WGSL of ``raster`` with a tape, and of the kernels from the tape to gradients.

    Arguments are those of ``raster_source``.
    """
    return _raster_source(queue, "color", groups, order) + _text("tape.wgsl") + _text("gradients.wgsl")


def filter_source() -> str:
    """WGSL of ``widen_backward``."""
    return lists_source() + _text("filter.wgsl")


def training_source() -> str:
    """WGSL of the loss and of Adam."""
    return "".join(_text(f"{name}.wgsl") for name in ("common", "harmonics", "training"))


def _raster_source(queue: int, output: Output, groups: bool, order: Order) -> str:
    if queue < 2:
        raise ValueError(f"queue must be at least 2, got {queue}")
    by_splat = order == "splat"
    queue = 1 if by_splat else queue
    text = _text("raster.wgsl") + _text("triangles.wgsl")
    text = text.replace("$OUTPUT", str(OUTPUTS.index(output)))
    text = text.replace("$GROUPS", str(groups).lower()).replace("$K", str(queue))
    text = text.replace("$BY_SPLAT", str(by_splat).lower()).replace("$CORE_TILE", str(CORE_TILES[order]))
    return _text("common.wgsl") + text


def _text(name: str) -> str:
    return files("meshsplats.webgpu").joinpath(name).read_text("utf-8")


DIGITS = ((0, 0), (8, 0), (16, 0), (24, 0), (24, 1))
"""Shift and word of each digit of the sort: the depth key from its lowest byte on, then the tile."""

TILE_DIGITS = (3, 4)
RUN_DIGITS = (0, 1, 2, 3)
"""Of ``DIGITS``: those of the tile, and those of the depth of a run's splat, which has 32 bits."""


def list_steps(order: Order = "fragment") -> list[dict[str, Any]]:
    """The steps from vertices to their colours and sorted tile lists, in their order, as JSON values.

    A step ``{"kernel": name, "bind": {binding: buffer}, ...}`` is a dispatch. Its size is ``"count": [name,
    n]``, the quotient of a count and n, rounded up, or ``"indirect": [buffer, byte]``. With ``"if": name`` it
    is left out where that count is 0. A buffer ``digits.i`` is the uniform of 16 bytes from byte 256 i on in
    the buffer ``digits``. A step ``{"clear": buffer, "from": byte}`` fills a buffer with 0.
    """
    return [*shade_steps(), *tile_steps(order)]


def shade_steps() -> list[dict[str, Any]]:
    """From vertices to their colours in a view; without effect where these do not depend on it."""
    bind = {"0": "frame", "1": "vertices", "25": "values", "26": "base", "27": "harmonics", "28": "owners"}
    return [{"kernel": "shade", "bind": bind, "count": ["vertices", 256], "if": "harmonics"}]


def tile_steps(order: Order) -> list[dict[str, Any]]:
    """From vertices and their colours to sorted tile lists. In the order 'splat', runs are sorted first, and
    pairs by their tiles alone."""
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

    def sort(source: str, target: str, indices: Sequence[int]) -> None:
        for i in indices:
            digit = f"digits.{i}"
            counted = {10: "table", 13: "plan", 16: source, 17: digit}
            add("count_digits", counted, indirect=["plan", 0])
            scan(digit, "table", indirect=["plan", 12])
            add("scatter", counted | {15: target}, indirect=["plan", 0])
            source, target = target, source

    by_splat = order == "splat"
    add("project", {0: "frame", 1: "vertices", 6: "projected"}, count=["vertices", 256])
    filtered = {0: "frame", 1: "vertices", 2: "values", 3: "mesh", 4: "fans", 6: "projected"}
    add("widen", filtered, count=["fans", 64], only_if="fans")
    bounds = {0: "frame", 3: "mesh", 5: "projected", 7: "group_bounds"}
    add("bound_groups", bounds, count=["faces", 256], only_if="groups")
    planes = {0: "frame", 3: "mesh", 6: "projected", 7: "group_bounds"}
    add("find_planes", planes, count=["groups", 64], only_if="groups")
    if by_splat:
        splats = {0: "frame", 1: "vertices", 3: "mesh", 4: "fans", 15: "pairs_a"}
        add("find_depths", splats, count=["splats", 256])
        add("plan_runs", {0: "frame", 12: "plan"}, count=["one", 1])
        sort("pairs_a", "pairs_b", RUN_DIGITS)
        add("order_runs", {0: "frame", 16: "pairs_a", 24: "mesh"}, count=["runs", 256])
    boxes = {0: "frame", 3: "mesh", 5: "projected", 8: "boxes", 10: "offsets"}
    add("bound_runs", boxes, count=["runs", 256])
    scan(f"digits.{len(DIGITS)}", "offsets", count=["runs", 2048])
    add("make_plan", {0: "frame", 11: "sums", 12: "plan", 19: "counters"}, count=["one", 1])
    # The sorted pairs are to be in pairs_b.
    start, other = ("pairs_b", "pairs_a") if by_splat else ("pairs_a", "pairs_b")
    pairs = {0: "frame", 3: "mesh", 5: "projected", 9: "boxes", 13: "plan", 14: "offsets", 15: start}
    add("emit", pairs, indirect=["plan", 24])
    sort(start, other, TILE_DIGITS if by_splat else range(len(DIGITS)))
    return steps


def raster_steps() -> list[dict[str, Any]]:
    """The steps from sorted pairs to samples: the first walk through all lists, and two more of those that
    need them."""
    return [*first_walk_steps(), *again_steps()]


def first_walk_steps() -> list[dict[str, Any]]:
    """The steps from sorted pairs to the samples of all tiles whose lists need one walk."""
    return [
        *({"clear": "counters", "from": 8}, {"clear": "lists", "from": 0}, {"clear": "again", "from": 0}),
        {
            "kernel": "find_lists",
            "bind": {"13": "plan", "16": "pairs_b", "18": "lists"},
            "indirect": ["plan", 24],
        },
        _raster("raster", "lists", "again", count=["tiles", 1]),
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


MARK, WRITE, SCAN = "modes.0", "modes.1", "modes.2"
"""Uniforms of the kernels with a tape: the two walks, and prefix sums by pair."""
MODES = ((0, 0, 0, 0), (1, 0, 0, 0), (0, 0, 2, 0))


GRADIENT_KERNELS = ("count_marks", "place_marks", "find_behind", "add_samples", "add_tiles", "add_corners")
"""Kernels of ``gradients_source``, besides ``raster``."""


TRAINING_KERNELS = (
    *("store_window", "load_window", "judge", "rate", "add_losses", "find_image_gradient"),
    *("check_gradients", "adam", "adam_harmonics", "round_fans"),
)
"""Kernels of ``training_source``."""


def mark_steps() -> list[dict[str, Any]]:
    """``raster_steps`` with marks, which find the fragments' places on the tape."""
    return [
        *({"clear": "counters", "from": 8}, {"clear": "lists", "from": 0}, {"clear": "again", "from": 0}),
        *_walk_steps(MARK),
    ]


def mark_again_steps(mode: str = MARK) -> list[dict[str, Any]]:
    """``again_steps`` with a tape."""
    return [
        {"clear": "lists", "from": 0},
        _taped("tape_again", "again", "lists", mode, indirect=["again", 0]),
        {"clear": "again", "from": 0},
        _taped("tape_again", "lists", "again", mode, indirect=["lists", 0]),
    ]


def place_steps() -> list[dict[str, Any]]:
    """From marks to the places of fragments on the tape, and of the sums of triangles in tiles."""
    names = {0: "frame", 4: "pairs_b", 8: "counters", 10: "offsets", 11: "boxes", 12: "plan"}
    names |= {13: "fragment_starts", 14: "sum_starts", 15: "marked"}
    bind = {str(i): name for i, name in names.items()}
    steps: list[dict[str, Any]] = [{"clear": name, "from": 0} for name in ("sum_starts", "marked")]
    steps.append({"kernel": "count_marks", "bind": bind, "indirect": ["plan", 24]})
    for data in ("fragment_starts", "sum_starts"):
        common = {"0": "frame", "11": "sums", "13": "plan", "17": SCAN}
        steps += [
            {"kernel": "scan_blocks", "bind": common | {"10": data}, "indirect": ["plan", 0]},
            {"kernel": "scan_sums", "bind": common, "count": ["one", 1]},
            {"kernel": "scan_add", "bind": common | {"10": data}, "indirect": ["plan", 0]},
        ]
    return [*steps, {"kernel": "place_marks", "bind": bind, "indirect": ["plan", 24]}]


def gradient_steps(rounds: int) -> list[dict[str, Any]]:
    """From the gradient of the image to those of vertices, which it adds to ``gradients``.

    Args:
        rounds: how often ``mark_again_steps`` were needed.
    """

    def step(kernel: str, bind: dict[int, str], **size: Any) -> dict[str, Any]:
        return {"kernel": kernel, "bind": {str(i): name for i, name in bind.items()}, **size}

    steps: list[dict[str, Any]] = [
        {"clear": "counters", "from": 8, "size": 44},
        *({"clear": "lists", "from": 0}, {"clear": "again", "from": 0}),
        *_walk_steps(WRITE),
    ]
    for _ in range(rounds):
        steps += mark_again_steps(WRITE)
    pixels = {0: "frame", 3: "tape", 6: "samples", 8: "counters"}
    steps.append(step("find_behind", pixels, count=["width", 8], rows=["height", 8]))
    taped = {0: "frame", 1: "projected", 2: "mesh", 3: "tape", 4: "pairs_b", 6: "samples", 8: "counters"}
    steps.append(step("add_samples", taped | {12: "plan", 16: "tile_sums"}, indirect=["plan", 24]))
    sums = {0: "frame", 2: "mesh", 10: "offsets", 12: "plan", 14: "sum_starts", 15: "marked"}
    by_face = sums | {16: "tile_sums", 17: "face_sums"}
    steps.append(step("add_tiles", by_face, count=["run_columns", 1], rows=["run_rows", 1]))
    corners = {0: "frame", 1: "projected", 2: "mesh", 17: "face_sums", 18: "vertex_corners", 19: "gradients"}
    steps.append(step("add_corners", corners, count=["vertices", 256]))
    return steps


def filter_steps() -> list[dict[str, Any]]:
    """From the gradients of moved vertices to those of the mesh's own; without effect without a filter."""
    names = {0: "frame", 1: "vertices", 2: "values", 3: "mesh", 4: "fans", 6: "projected"}
    names |= {22: "gradients", 23: "vertex_corners"}
    bind = {str(i): name for i, name in names.items()}
    return [{"kernel": "widen_backward", "bind": bind, "count": ["fans", 64], "if": "fans"}]


def store_steps() -> list[dict[str, Any]]:
    """From the samples of a window to the image."""
    return [_training("store_window", {2: "samples", 3: "image"}, count=["columns", 8], rows=["rows", 8])]


def loss_steps() -> list[dict[str, Any]]:
    """From the image to its loss and gradient."""
    size: dict[str, Any] = {"count": ["image_columns", 16], "rows": ["image_rows", 16]}
    compared = {3: "image", 4: "target", 5: "derivatives"}
    return [
        {"clear": "results", "from": 0},
        _training("rate", compared | {7: "losses"}, **size),
        _training("add_losses", {7: "losses", 8: "results"}, count=["one", 1]),
        _training("find_image_gradient", compared | {6: "image_gradient"}, **size),
    ]


def window_steps(rounds: int) -> list[dict[str, Any]]:
    """From the gradient of the image to those of vertices, for one window, with ``gradient_steps``."""
    loaded = {2: "samples", 6: "image_gradient"}
    return [
        _training("load_window", loaded, count=["columns", 8], rows=["rows", 8]),
        *gradient_steps(rounds),
        _training("judge", {8: "results", 9: "counters"}, count=["one", 1]),
    ]


def adam_steps() -> list[dict[str, Any]]:
    """From the gradients of vertices to their new positions and colours, and to the new harmonics of splats.

    ``base`` has the mesh's colours, ``values`` those of the view.
    """
    checked = {"0": "frame", "8": "results", "10": "gradients"}
    common = {"1": "step", "11": "vertices", "16": "values"}
    own = {"12": "base", "13": "position_moments", "14": "color_moments", "15": "traits"}
    splats = {"17": "harmonics", "18": "harmonic_means", "19": "harmonic_squares", "20": "splat_vertices"}
    return [
        {"kernel": "check_gradients", "bind": checked, "count": ["vertices", 256]},
        {
            "kernel": "adam_harmonics",
            "bind": checked | common | splats,
            "count": ["harmonic_splats", 64],
            "if": "harmonic_splats",
        },
        {"kernel": "adam", "bind": checked | common | own, "count": ["vertices", 256]},
    ]


def round_steps() -> list[dict[str, Any]]:
    """From the vertices of fans to rounder ones."""
    bind = {"11": "vertices", "21": "rounding", "22": "polygon"}
    return [{"kernel": "round_fans", "bind": bind, "count": ["fans", 64]}]


def _training(kernel: str, bind: dict[int, str], **size: Any) -> dict[str, Any]:
    named = {"1": "step"} | {str(i): name for i, name in bind.items()}
    return {"kernel": kernel, "bind": named, **size}


def _walk_steps(mode: str) -> list[dict[str, Any]]:
    """The first walk through all lists, and two more of those that need them."""
    found = {"13": "plan", "16": "pairs_b", "18": "lists"}
    return [
        {"kernel": "find_lists", "bind": found, "indirect": ["plan", 24]},
        _taped("tape", "lists", "again", mode, count=["tiles", 1]),
        *mark_again_steps(mode),
    ]


def _taped(kernel: str, work: str, next_work: str, mode: str, **size: Any) -> dict[str, Any]:
    step = _raster(kernel, work, next_work, **size)
    return step | {"bind": step["bind"] | {"3": "tape", "9": mode}}


def _raster(kernel: str, work: str, next_work: str, **size: Any) -> dict[str, Any]:
    bind = ("frame", "projected", "mesh", "values", "pairs_b", work, "samples", next_work, "counters")
    return {"kernel": kernel, "bind": {str(i): name for i, name in enumerate(bind)}, **size}
