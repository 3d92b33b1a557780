"""What a page shows: splats that are merged if they are many, their mesh, a coarse level for weak devices; a
surface beside them or alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from meshsplats._common.arrays import block_means
from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.conversion.budget import usual_triangles_each
from meshsplats.conversion.gaps import with_usual_look
from meshsplats.conversion.merging import simplify_in_blocks
from meshsplats.conversion.merging_views import merging_views, views_of_place
from meshsplats.conversion.recovery import recover_splats
from meshsplats.evaluation.metrics import psnr
from meshsplats.rendering import render, render_splats
from meshsplats.rendering.layers import SMALLEST, affordable
from meshsplats.rendering.previews import USUAL
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer.page import Page, PageOptions, estimated_size, make_page

SIDE = 400
"""Largest side of the image by which the errors of merging and quantisation are measured."""
MEASURED_FRAGMENTS = 1e9
"""Largest number of its fragments: of a scene that has more, the image is smaller."""
TRIANGLES = 4_000_000
"""Usual limit: more take seconds to sort and draw, and pages of more than 40 MB."""
COARSE_TRIANGLES = 300_000
"""Triangles of the coarse level, which any phone draws; meshes with more get one."""
WHOLE = 0.9
"""Share of the fans of a mesh that must be complete for a coarse level of them."""
ALIKE_SIDE, AREA = 200, 8
"""Sides in pixels of the images that tell whether splats show what a mesh does, and of areas of them."""
ALIKE_LEVEL, ALIKE_SHARE = 0.1, 0.01
"""By how much the mean colours of an area differ at most, and share of the areas that differ by more."""
MOST_TRIANGLES = 20_000_000
"""Triangles of a page at most: browsers hold no more."""


class TooManyTrianglesError(ValueError):
    """A page cannot hold the mesh."""


@dataclass(frozen=True)
class Content:
    """What a page shows."""

    mesh: SplatMesh | None
    """None: the surface alone, or with splats."""
    splats: GaussianCloud | None
    """Shown beside it."""
    coarse: SplatMesh | None = None
    surface: BaseMesh | None = None
    kept: int = 0
    """Splats of the mesh, where it was made of splats."""
    merged_from: int | None = None
    """How many there were, if they were merged."""
    merging_psnr: float = 0.0
    """dB between images of all splats and of those that are left, in one view."""

    @property
    def main(self) -> SplatMesh | BaseMesh:
        """The mesh, else the surface."""
        main = self.surface if self.mesh is None else self.mesh
        assert main is not None
        return main

    def page(self, cameras: Sequence[Camera], options: PageOptions) -> Page:
        """The page of it, as by ``make_page``."""
        surface = None if self.mesh is None else self.surface
        return make_page(
            self.main,
            splats=self.splats,
            coarse=self.coarse,
            surface=surface,
            cameras=cameras,
            options=options,
        )

    def estimated_size(self) -> int:
        """About how many bytes its page will have."""
        return estimated_size(self.mesh, self.splats, self.coarse, self.surface)

    def counts(self) -> dict[str, int]:
        """How many triangles and splats there are."""
        surface = {} if self.surface is None else {"surface_triangles": len(self.surface.faces)}
        return {
            "triangles": 0 if self.mesh is None else len(self.mesh.faces),
            "coarse_triangles": 0 if self.coarse is None else len(self.coarse.faces),
            **surface,
            "splats": 0 if self.splats is None else len(self.splats),
        }


def content_of_splats(
    cloud: GaussianCloud,
    cameras: Sequence[Camera] = (),
    *,
    max_triangles: int | None = None,
    shown: bool = True,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> Content:
    """The content of a page of splats, merged until their mesh has at most ``max_triangles``.

    ``cameras``: where they are seen from. ``shown``: whether the splats are in the page, too. ``up``: (3,)
    direction, where the user names it. ``threads``: at most this many.

    Raises TooManyTrianglesError above ``MOST_TRIANGLES``.
    """
    each = usual_triangles_each()
    count = len(cloud) if max_triangles is None else max(1, max_triangles // each)
    _check_size(each * min(count, len(cloud)))
    views = merging_views(cloud, up=up, threads=threads) if count < len(cloud) else None
    kept = simplify_in_blocks(cloud, count, cameras=views, threads=threads)
    mesh = convert(kept, with_usual_look(kept, threads=threads) if kept is cloud else None, threads=threads)
    coarse = _coarse(mesh, kept, views, up, threads)
    content = Content(mesh, kept.of_degree(0) if shown else None, coarse, kept=len(kept))
    if kept is cloud:
        return content
    camera = _camera(cloud, cameras)
    images = (render_splats(each, camera, threads=threads).color for each in (kept, cloud))
    return replace(content, merged_from=len(cloud), merging_psnr=psnr(*images))


def content_of_mesh(
    mesh: SplatMesh,
    splats: GaussianCloud | None = None,
    threads: int | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> Content:
    """The content of a page of a mesh, with ``splats`` to compare it with. ``say`` gets a line where there
    are no splats for a coarse level that show what the mesh does.

    Raises TooManyTrianglesError above ``MOST_TRIANGLES``.
    """
    _check_size(len(mesh.faces))
    if splats is None:
        return Content(mesh, None)
    coarse = None
    if len(mesh.faces) > COARSE_TRIANGLES:
        source = _splats_of_coarse(mesh, splats.relative_to(mesh.origin), threads)
        if source is None:
            say(
                "no coarse level: the splats do not look like the mesh, which is drawn whole while it moves"
                " and on phones"
            )
        else:
            coarse = _coarse(mesh, source, threads=threads)
    return Content(mesh, splats.of_degree(0), coarse)


def _show_the_same(mesh: SplatMesh, splats: GaussianCloud, threads: int | None) -> bool:
    """Whether images of both, from two opposite sides, differ in hardly any area: where something was moved,
    removed or recoloured, they do."""
    degree, errors = min(mesh.sh_degree, splats.sh_degree), []
    bare = replace(mesh.of_degree(degree), filter_px2=0.0)
    for camera in orbit(mesh, 2, azimuth=USUAL, width=ALIKE_SIDE, height=ALIKE_SIDE):
        camera = affordable(mesh, camera, 2, MEASURED_FRAGMENTS) or camera.scaled(SMALLEST)
        drawn = render(bare, camera, samples=2, threads=threads)
        # Neither is widened by a filter: in images so small, it would cover gaps.
        shown = render_splats(splats, camera, samples=2, sh_degree=degree, dilation=0.0, threads=threads)
        difference = np.dstack([drawn.color - shown.color, drawn.alpha - shown.alpha])
        errors.append(np.abs(block_means(difference, AREA)).max(axis=2).ravel())
    return bool((np.concatenate(errors) > ALIKE_LEVEL).mean() <= ALIKE_SHARE)


def _splats_of_coarse(mesh: SplatMesh, splats: GaussianCloud, threads: int | None) -> GaussianCloud | None:
    """What shows ``mesh`` with few triangles: the splats that its fans are, wherever they have been moved or
    recoloured; if too many are incomplete, ``splats``, if they show the same."""
    with suppress(ValueError):  # which splats its triangles were is not known
        own, whole = recover_splats(mesh.of_degree(min(mesh.sh_degree, splats.sh_degree)))
        if whole.mean() >= WHOLE:
            return own
    return splats if _show_the_same(mesh, splats, threads) else None


def measured(
    content: Content, page: Page, cameras: Sequence[Camera], threads: int | None = None
) -> dict[str, Any]:
    """Sizes of ``page``, and the errors that merging and quantisation make."""
    mesh, packed = content.mesh, page.mesh
    image = {}
    if mesh is not None:
        camera = _camera(mesh, cameras)
        camera = affordable(mesh, camera, 2, MEASURED_FRAGMENTS) or camera.scaled(SMALLEST)
        shown = (mesh, packed.decoded)
        images = [render(each, camera, samples=2, threads=threads).color for each in shown]
        image = {"image_error_levels": 255 * float(np.abs(images[0] - images[1]).max())}
    merged: dict[str, Any] = {}
    if content.merged_from is not None:
        merged = {"merged_from": content.merged_from, "merging_psnr": round(content.merging_psnr, 2)}
    return {
        **content.counts(),
        **({"texture_bytes": page.texture} if page.texture else {}),
        **merged,
        "viewpoints": len(cameras),
        "bytes": len(page.html.encode("utf-8")),
        "bytes_a_triangle": round(packed.bytes_a_triangle, 2),
        "position_error": packed.position_error,
        "position_error_radii": packed.relative_error,
        "color_error_levels": packed.color_error,
        "alpha_error_levels": packed.alpha_error,
        **image,
    }


def in_words(counts: dict[str, Any]) -> str:
    """Of ``Content.counts`` or ``measured``: what there is."""
    kinds = {
        "triangles": "{:,} triangle{}",
        "coarse_triangles": "a coarse level of {:,}",
        "surface_triangles": "a surface of {:,} triangle{}",
        "splats": "{:,} splat{}",
        "viewpoints": "{:,} viewpoint{}",
    }
    there = [(text, counts.get(name, 0)) for name, text in kinds.items()]
    return ", ".join(text.format(count, "" if count == 1 else "s") for text, count in there if count)


def errors_in_words(result: dict[str, Any]) -> str:
    """Of ``measured``: bytes, and what quantisation changes."""
    moved = (
        f"{result['bytes_a_triangle']:.1f} bytes a triangle; quantisation moves vertices by at most"
        f" {result['position_error_radii']:.1g} of the scene's radius"
    )
    if "image_error_levels" not in result:
        return moved
    return (
        f"{moved},\ncolours by {result['color_error_levels']:.2g}, opacities by"
        f" {result['alpha_error_levels']:.2g} and pixels of one view by"
        f" {result['image_error_levels']:.2g} of 255 levels"
    )


def _coarse(
    mesh: SplatMesh,
    splats: GaussianCloud,
    views: Sequence[Camera] | None = None,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> SplatMesh | None:
    """The coarse level of a mesh with many triangles, made of its splats, for ``views``: by default those of
    a place. An object is shown so while it moves only."""
    if len(mesh.faces) <= COARSE_TRIANGLES:
        return None
    views = views or views_of_place(splats, up=up, threads=threads)
    splats = splats.of_degree(min(mesh.sh_degree, splats.sh_degree))
    count = COARSE_TRIANGLES // usual_triangles_each()
    few = simplify_in_blocks(splats, count, cameras=views, threads=threads)
    return convert(few, up=mesh.up, threads=threads)


def _check_size(triangles: int) -> None:
    if triangles > MOST_TRIANGLES:
        raise TooManyTrianglesError(
            f"a page holds at most {MOST_TRIANGLES:,} triangles, and these would be {triangles:,}"
        )


def _camera(scene: SplatMesh | GaussianCloud, cameras: Sequence[Camera]) -> Camera:
    """The view of the measurements."""
    return cameras[0].within(SIDE) if cameras else orbit(scene, 1, azimuth=USUAL, width=SIDE, height=SIDE)[0]
