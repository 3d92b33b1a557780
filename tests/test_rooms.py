"""The import rule: rooms (top-level modules and packages) form floors, and no floor imports from above."""

from __future__ import annotations

import ast
import functools
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import meshsplats

ROOT = Path(meshsplats.__file__).parent
LONGEST_CHAIN = 13
LOWEST = ("_core", "_files", "errors")
"""Rooms that import no other room."""
FLOORS = (
    ("_common", "cluster"),
    ("scene",),
    ("demo_scene", "images"),
    ("cameras", "formats", "webgpu"),
    ("rendering",),
    ("viewpoints",),
    ("conversion", "datasets"),
    ("evaluation", "surfaces"),
    ("finetuning", "viewer"),
    ("levels", "prior", "tiles", "training"),
    ("blender", "operations", "renders"),
    ("cli",),
    ("__main__",),
)


def modules() -> dict[str, Path]:
    """Every module of the package but the front door, by its name inside the package."""
    found = {}
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name:
            found[name] = path
    return found


def imported(text: str, known: set[str]) -> set[str]:
    """The modules that a source imports, wherever in it: inside functions and for type checkers, too."""
    names: list[str] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    result = set()
    for name in names:
        if name.split(".")[0] == "meshsplats":
            inner = name.removeprefix("meshsplats").lstrip(".")
            while inner and inner not in known:  # a name in a module
                inner = inner.rpartition(".")[0]
            result.add(inner)
    return result - {""}


@functools.cache
def graph() -> dict[str, set[str]]:
    found = modules()
    return {name: imported(path.read_text("utf-8"), set(found)) - {name} for name, path in found.items()}


def rooms() -> dict[str, set[str]]:
    result: dict[str, set[str]] = {}
    for name, others in graph().items():
        room = name.split(".")[0]
        result.setdefault(room, set()).update(other.split(".")[0] for other in others)
    return {room: others - {room} for room, others in result.items()}


def in_order(arrows: dict[str, set[str]]) -> list[str]:
    try:
        return list(TopologicalSorter(arrows).static_order())
    except CycleError as error:
        raise AssertionError(f"a circle of imports: {' -> '.join(error.args[1])}") from None


def test_imports_are_found_wherever_they_stand():
    text = (
        "from meshsplats.a import b\ndef f():\n    from meshsplats.c.d import e\nimport meshsplats.f, numpy\n"
    )
    assert imported(text, {"a", "a.b", "c", "c.d", "f"}) == {"a.b", "c.d", "f"}
    assert imported(text, {"a", "c", "f"}) == {"a", "c", "f"}


def test_no_two_modules_import_each_other_by_any_way():
    assert len(in_order(graph())) > 100


def test_no_room_imports_from_a_higher_floor():
    floor = {room: i for i, level in enumerate((LOWEST, *FLOORS)) for room in level}
    assert sorted(floor) == sorted(rooms()), "a room without a floor, or a floor without its room"
    upwards = [
        (room, other) for room, others in rooms().items() for other in others if floor[other] >= floor[room]
    ]
    assert upwards == []


def test_chains_of_rooms_are_short():
    arrows = rooms()
    depth: dict[str, int] = {}
    for room in in_order(arrows):
        depth[room] = 1 + max((depth[other] for other in arrows[room]), default=0)
    assert max(depth.values()) <= LONGEST_CHAIN
