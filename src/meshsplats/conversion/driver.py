"""The driver of a conversion: what turns the splats of one scene, whole or in blocks, into its mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshsplats.conversion.fan_sizes import Fans
from meshsplats.conversion.footprint import SceneViews
from meshsplats.conversion.options import ConversionOptions
from meshsplats.conversion.selection import within
from meshsplats.scene.gaussians import DILATION, GaussianCloud, Kernel
from meshsplats.scene.mesh import SplatMesh


def worth_drawing(cloud: GaussianCloud, options: ConversionOptions) -> np.ndarray:
    """(k,) rows of the splats that are inside the crop box and opaque enough, ascending."""
    return np.flatnonzero(within(cloud, options.crop, options.min_opacity))


def drawn_part(cloud: GaussianCloud, rows: np.ndarray, options: ConversionOptions) -> GaussianCloud:
    """The splats ``rows`` (k,) of ``cloud``, ascending, with the harmonics that the mesh depends on."""
    part = cloud if options.colors != "base" else cloud.of_degree(0)
    if options.colors == "view":
        part = part.of_degree(min(part.sh_degree, options.color_degree or 3))
    return part if len(rows) == len(cloud) else part.take(rows)


def filter_of(kernel: Kernel, options: ConversionOptions) -> float:
    """``filter_px2`` of the mesh of splats of that kernel: variance in square pixels, 0 for none."""
    if options.footprint != "filter":
        return 0.0
    if kernel != "3dgs":
        raise ValueError(
            f"footprint='filter' draws as 3DGS does, but these splats are of kernel {kernel!r}, which"
            " filters in another way: choose another footprint, or none"
        )
    return DILATION if options.footprint_px2 is None else float(options.footprint_px2)


@dataclass(frozen=True, eq=False)
class Piece:
    """Splats, each with its row among all, and their fans."""

    cloud: GaussianCloud
    rows: np.ndarray
    """(n,) int32, for ``face_splat``."""
    colors: np.ndarray
    """(n, 3) display RGB."""
    fans: Fans

    def select(self, index: np.ndarray) -> Piece:
        """The splats at ``index`` (k,), ascending."""
        if len(index) == len(self.rows):
            return self
        own: dict[str, Any] = {name: np.take(getattr(self.fans, name), index, axis=0) for name in _PER_SPLAT}
        return Piece(self.cloud.take(index), self.rows[index], self.colors[index], self.fans._replace(**own))

    @staticmethod
    def together(pieces: Sequence[Piece]) -> Piece:
        if len(pieces) == 1:
            return pieces[0]
        own: dict[str, Any] = {
            name: np.concatenate([getattr(p.fans, name) for p in pieces]) for name in _PER_SPLAT
        }
        return Piece(
            GaussianCloud.joined([p.cloud for p in pieces]),
            np.concatenate([p.rows for p in pieces]),
            np.concatenate([p.colors for p in pieces]),
            pieces[0].fans._replace(**own),
        )


_PER_SPLAT = tuple(name for name in Fans._fields if name != "shapes")


@dataclass(frozen=True, eq=False)
class Driver:
    """Makes the fans of any splats of one scene; together, parts are the mesh of the whole."""

    options: ConversionOptions
    """Resolved ones."""
    views: SceneViews
    up: np.ndarray
    """(3,) unit vector."""
    origin: np.ndarray
    """(3,) float64 that the splats and the mesh are relative to."""
    filter_px2: float = 0.0

    def piece(self, cloud: GaussianCloud, rows: np.ndarray) -> Piece:
        """The fans of the splats ``cloud``, whose rows among all are ``rows`` (n,)."""
        return self.sized(cloud, rows, self.views.pixel_sizes(cloud.means))

    def sized(self, cloud: GaussianCloud, rows: np.ndarray, pixel: np.ndarray | None) -> Piece:
        """As ``piece`` with the size of a pixel at each splat (n,); None for no low-pass filter."""
        return Piece(cloud, rows, self.views.colors(cloud), Fans.of(cloud, self.options, pixel))

    def has_area(self, piece: Piece) -> np.ndarray:
        """(n,) bool: the splats whose triangles show something; all of them without a least opacity."""
        return piece.fans.areas[:, 0] > 0 if self.options.min_opacity else np.ones(len(piece.rows), bool)

    def mesh(self, piece: Piece, keep: np.ndarray | None = None) -> SplatMesh:
        """The triangles of the splats that ``keep`` (n,) names, by default of all."""
        kept = None if keep is None or keep.all() else np.flatnonzero(keep)
        vertices, faces, colors, owners = piece.fans.build(
            piece.cloud, piece.rows, piece.colors, self.options.compensation, kept
        )
        harmonics = None
        if self.options.colors == "view" and piece.cloud.sh_degree:
            harmonics = piece.cloud.sh[:, 1:] if kept is None else piece.cloud.sh[kept, 1:]
        return SplatMesh(
            vertices,
            faces,
            colors,
            face_splat=owners,
            harmonics=harmonics,
            up=self.up,
            filter_px2=self.filter_px2,
            origin=self.origin,
        )
