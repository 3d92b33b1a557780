"""The page of the viewer: one HTML file with its styles, scripts, shaders and data inside.

Its modules lie in ``page/``. They are joined into one script, whose hash the content security policy of the
page names: no other script runs, whatever the names of cameras and scenes contain, and nothing is loaded
from anywhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need, need_all
from meshsplats._common.words import legible
from meshsplats.cameras.framing import (
    COVERED,
    MARGIN,
    Bounds,
    guess_up,
    scene_bounds,
    unit_up,
    weighted_quantile,
)
from meshsplats.cameras.trajectories import orbit
from meshsplats.formats.surfaces.vertex_colors import texture_to_vertex_colors
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.order import Order, checked_order
from meshsplats.viewer.packing import pack_splats
from meshsplats.viewer.quantise import QuantisedMesh, estimated_bytes, quantise_mesh
from meshsplats.viewer.surface import PackedSurface, pack_surface
from meshsplats.viewpoints.opening import opening_azimuth
from meshsplats.webgpu import device, frames, kernels

MODULES = (
    *("scene.js", "camera.js", "controls.js", "crop.js", "order.js", "shaders.js", "sorted.js"),
    *("arrays.js", "exact.js", "status.js", "contents.js", "app.js", "main.js"),
)
"""The scripts of the page, in the order in which they are joined."""

OPENING_TRIANGLES = 200_000
"""Triangles, at most, by which the side of a surface is found that shows most."""
MOST_CAMERAS = 2000
"""Cameras in the list of the page; of more, some are left out evenly."""

LONGEST_NAME = 120
"""Characters of a title or the name of a camera."""

_IMPORT = re.compile(r"^import \{[^}]*\}\s+from \"\./\w+\.js\";\n", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) )", re.MULTILINE)


@dataclass(frozen=True)
class PageOptions:
    """What a page shows first."""

    title: str = "MeshSplats"
    """Name of the scene."""
    background: Sequence[float] = (1.0, 1.0, 1.0)
    """Display RGB, 0 to 1."""
    up: Sequence[float] | np.ndarray | None = None
    """(3,) direction that points up. None: by the cameras, else by the mesh."""
    merged_from: int | None = None
    """How many splats there were, if only some are in the page, merged."""
    controls: bool = True
    """Title, state and settings over the scene. False: nothing over it, for a page within another, until H is
    pressed."""


@dataclass(frozen=True)
class Page:
    """A page, and the mesh as it is inside."""

    html: str
    mesh: QuantisedMesh
    """Of a surface alone: its triangles."""
    texture: int = 0
    """Bytes of the texture of a surface in the page."""


def make_page(
    mesh: SplatMesh | BaseMesh,
    *,
    splats: GaussianCloud | None = None,
    coarse: SplatMesh | None = None,
    surface: BaseMesh | None = None,
    cameras: Sequence[Camera] = (),
    options: PageOptions | None = None,
) -> Page:
    """A page that shows ``mesh`` in any current browser, from a server or a disk, without a network.

    Args:
        mesh: the triangles. Normals, attributes and bindings are left out. Or a surface alone, which is drawn
            as a depth buffer does, by WebGL.
        splats: shown beside the mesh or in its place, with colours of degree 0.
        coarse: the same scene with few triangles: drawn first, while the view moves, and on phones, in the
            order of ``mesh``.
        surface: shown beside the mesh or in its place, with its texture as it is, without lights.
        cameras: viewpoints to choose from. The first is where the page begins; without any, it begins before
            the subject.
        options: title, background, up, whether there are controls.

    ``splats``, ``coarse`` and ``surface`` may have other origins than ``mesh``; ``cameras`` have its own.

    Raises ValueError for a mesh without triangles, a surface with several textures, a surface alone with
    another or a coarse level, a coarse level that does not know its splats where the mesh is in their order,
    and a background that is not RGB.
    """
    if not isinstance(mesh, BaseMesh):
        need(SplatMesh, mesh=mesh)
    need(SplatMesh, coarse=coarse, optional=True)
    need(BaseMesh, surface=surface, optional=True)
    need(GaussianCloud, splats=splats, optional=True)
    need_all(Camera, cameras=cameras)
    need(PageOptions, options=options, optional=True)
    options = options or PageOptions()
    if np.shape(options.background) != (3,):
        raise ValueError(f"background must have shape (3,), got {np.shape(options.background)}")
    blocks: dict[str, tuple[str, str]] = {}
    alone = textured = None
    if isinstance(mesh, BaseMesh):
        if surface is not None or coarse is not None:
            raise ValueError("a page of a surface alone has no other surface and no coarse level")
        alone, textured = mesh, pack_surface(mesh)
        mesh, packed = textured.shape, textured.mesh
    else:
        packed = quantise_mesh(mesh)
        blocks |= _mesh_blocks(mesh, packed, None if coarse is None else coarse.relative_to(mesh.origin))
        if surface is not None:
            textured = pack_surface(surface.relative_to(mesh.origin))
    if textured is not None:
        blocks |= _surface_blocks(textured)
    if splats is not None:
        blocks["splats"] = ("text/plain", _base64(pack_splats(splats.relative_to(mesh.origin))))
    views = [camera.with_near_plane(mesh.vertices) for camera in subsample(cameras, MOST_CAMERAS)]
    up = guess_up(mesh, views) if options.up is None else unit_up(options.up)
    bounds = scene_bounds(mesh)
    if not views:
        colored = mesh if alone is None else texture_to_vertex_colors(alone, OPENING_TRIANGLES)
        azimuth = opening_azimuth(splats or colored, up=up, threads=1)
        (view,) = orbit(mesh, 1, azimuth=azimuth, elevation=15, width=1000, height=1000, up=up)
        views = [_narrowed(view, bounds, up)]
    settings = {
        "title": legible(options.title[:LONGEST_NAME]),
        "background": "#" + "".join(f"{round(255 * min(max(c, 0), 1)):02x}" for c in options.background),
        "up": up.tolist(),
        "center": bounds.center.tolist(),
        "radius": bounds.radius,
        "origin": mesh.origin.tolist(),
        "extent": _extent(mesh),
        "cameras": [_described(camera) for camera in views],
        "triangles": {"fine": len(mesh.faces)} | ({} if coarse is None else {"coarse": len(coarse.faces)}),
        "statistics": {
            **({} if options.merged_from is None else {"merged from": f"{options.merged_from:,} splats"}),
            "data": f"{packed.bytes_a_triangle:.1f} bytes a triangle",
            "position error": f"{packed.position_error:.2g}",
            "colour error": f"{packed.color_error:.2g} of 255",
        },
    }
    blocks = {"settings": ("application/json", _json(settings)), **blocks}
    text = _assembled(settings["title"], blocks, "" if options.controls else "plain")
    return Page(text, packed, 0 if textured is None else len(textured.picture))


def _mesh_blocks(
    mesh: SplatMesh, packed: QuantisedMesh, coarse: SplatMesh | None
) -> dict[str, tuple[str, str]]:
    """What the page has of a mesh, for both renderers."""
    grouped = mesh.depth_group is not None and bool((mesh.depth_group >= 0).any())
    groups = grouped and mesh.order == "fragment"
    blocks = {
        "kernels": ("application/json", _json(_kernels(groups, mesh.order))),
        "mesh": ("text/plain", _base64(packed.data)),
    }
    if coarse is not None:
        if coarse.order != mesh.order:
            coarse = replace(coarse, order=checked_order(mesh.order, coarse.face_splat))
        blocks["coarse"] = ("text/plain", _base64(quantise_mesh(coarse).data))
    return blocks


def _surface_blocks(surface: PackedSurface) -> dict[str, tuple[str, str]]:
    """What the page has of a surface."""
    blocks = {"surface": ("text/plain", _base64(surface.mesh.data))}
    if surface.coordinates is not None:
        blocks["coordinates"] = ("text/plain", _base64(surface.coordinates))
        blocks["picture"] = ("text/plain", _base64(surface.picture))
    return blocks


def estimated_size(
    mesh: SplatMesh | None,
    splats: GaussianCloud | None = None,
    coarse: SplatMesh | None = None,
    surface: BaseMesh | None = None,
) -> int:
    """About how many bytes the page of these will have; known in a fraction of a second, that of a surface in
    a few."""
    data = 0 if surface is None else pack_surface(surface).size
    if mesh is not None:
        data += estimated_bytes(mesh, splats)
    elif splats is not None:
        data += len(pack_splats(splats))
    data += 0 if coarse is None else estimated_bytes(coarse)
    texts = sum(len(_read(name)) for name in (*MODULES, "style.css", "index.html"))
    code = 0 if mesh is None else len(_json(_kernels(False, mesh.order)))
    return code + texts + 4 * data // 3


def _kernels(groups: bool, order: Order) -> dict[str, object]:
    """The text of the kernels, their limits and the steps of a frame, for ``page/exact.js``. ``groups``:
    whether the mesh has depth groups that count in the ``order`` of the page's meshes."""
    return {
        "groups": groups,
        "order": order,
        "limits": {
            "window": frames.WINDOW_SAMPLES,
            "firstPairs": frames.FIRST_PAIRS,
            "pairs": kernels.MAX_PAIRS,
            "runs": kernels.MAX_RUNS,
            "tiles": kernels.MAX_TILES,
            "rounds": frames.MAX_ROUNDS,
            "budgets": [*device.SOFTWARE_BUDGETS, device.BUDGET],
        },
        "digits": kernels.DIGITS,
        "lists": kernels.list_steps(order),
        "raster": kernels.first_walk_steps(),
        "again": kernels.again_steps(),
        "sources": {
            "lists": kernels.lists_source(),
            "raster": kernels.raster_source(kernels.QUEUE, groups=groups, order=order),
            "again": kernels.raster_source(kernels.LONG_QUEUE, groups=groups, order=order),
        },
    }


def script() -> str:
    """The modules of the page as one script, in strict mode and a scope of its own."""
    parts = [_EXPORT.sub("", _IMPORT.sub("", _read(name))) for name in MODULES]
    return '"use strict";\n{\n' + "\n".join(parts) + "}\n"


def _assembled(title: str, blocks: Mapping[str, tuple[str, str]], look: str) -> str:
    """``look``: class of the page's body."""
    import meshsplats

    code, style = script(), _read("style.css")
    for text in (code, style):
        # These would end the element that holds them, or hide its end.
        assert not re.search("</script|</style|<!--", text, re.IGNORECASE)
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src {_hash(code)}",
            f"style-src {_hash(style)}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    data = "\n".join(
        f'<script type="{kind}" id="{name}">{content}</script>' for name, (kind, content) in blocks.items()
    )
    values = {
        "policy": policy,
        "generator": f"meshsplats {meshsplats.__version__}",
        "title": title,
        "look": look,
    }
    replaced = {name: html.escape(text, quote=True) for name, text in values.items()}
    replaced |= {"style": style, "script": code, "data": data}
    # In one pass, so that nothing in a title is taken for a place to fill.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: replaced[match[1]], _read("index.html"))


def _narrowed(camera: Camera, bounds: Bounds, up: np.ndarray) -> Camera:
    """``camera`` with an image no wider than the subject while it turns around ``up``: a slender one fills an
    upright window, too."""
    sight = camera.world_to_camera[2, :3]
    away = ((bounds.center - camera.center) @ sight) * sight
    offsets = bounds.points - (camera.center + away)
    heights = offsets @ up
    aside = np.linalg.norm(offsets - heights[:, None] * up, axis=1) + bounds.sizes
    # At a turn by t, a point is aside * sin(t) beside the line of sight, and reach * cos(t) before the axis.
    depths, reach = np.linalg.norm(away) + heights * (sight @ up), aside * np.linalg.norm(np.cross(sight, up))
    slopes = aside / np.sqrt(np.maximum(depths**2 - reach**2, 1e-12 * depths**2))
    needed = 2 * MARGIN * camera.fx * weighted_quantile(slopes, bounds.weights, COVERED)
    width = min(camera.width, math.ceil(needed))
    return replace(camera, width=width, cx=camera.cx - (camera.width - width) / 2)


def _described(camera: Camera) -> dict[str, object]:
    return {
        "name": camera.name[:LONGEST_NAME],
        "matrix": camera.world_to_camera[:3].ravel().tolist(),
        "width": camera.width,
        "height": camera.height,
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "near")},
    }


def _extent(mesh: SplatMesh) -> list[list[float]]:
    """Ends of the crop box's sliders: what holds nearly all vertices, and a margin."""
    low, high = np.quantile(subsample(mesh.vertices, 200_000), (0.002, 0.998), axis=0)
    margin = 0.02 * (high - low) + 1e-3 * float((high - low).max() or 1)
    return [(low - margin).tolist(), (high + margin).tolist()]


def _json(value: object) -> str:
    """JSON that can stand in a script element: no character of it begins a tag."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _read(name: str) -> str:
    return (resources.files("meshsplats.viewer") / "page" / name).read_text(encoding="utf-8")
