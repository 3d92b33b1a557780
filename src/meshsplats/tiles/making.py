"""The tiles of a tileset, from the leaves to the root: geometry, merged splats, geometric errors."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from meshsplats._files.atomic import write_bytes, write_text
from meshsplats.cameras.framing import DEFAULT_UP, unit_up, weighted_quantile
from meshsplats.cluster import Shared
from meshsplats.conversion.driver import Driver
from meshsplats.conversion.footprint import SceneViews
from meshsplats.conversion.merging import low_pass_of, merge
from meshsplats.conversion.options import ConversionOptions
from meshsplats.conversion.streaming import Survey
from meshsplats.formats._orientation import tile_frame
from meshsplats.formats.cutting import CUTOFF, cut_mesh
from meshsplats.formats.gltf.splat_tiles import write_splat_tile
from meshsplats.formats.gltf.writer import Alpha
from meshsplats.formats.meshes import save_mesh
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.mesh import SplatMesh
from meshsplats.tiles.buckets import (
    DEPTH,
    Cube,
    check_size,
    cloud_of,
    read_records,
    record_type,
    records_of,
)
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.tileset import Node, tile_path

SHARE = 4
"""Splats of the children for each one of an inner tile: surfaces, seen from twice as far, cover a quarter."""
ERROR_SHARE = 0.99
"""Share of the mass of an inner tile that its geometric error speaks for."""
SPLAT_REACH = 3.0
"""Standard deviations from the centre of a splat to where viewers end it, about."""
SURVEY = "survey.npz"
"""Beside the journal of an unfinished tileset."""


def stored_survey(path: Path) -> Survey:
    """The survey that a run has written."""
    with np.load(path) as stored:
        kept, step, degree = (int(n) for n in stored["counts"])
        low, high, origin = stored["bounds"]
        kernel: Kernel = str(stored["kernel"])  # type: ignore[assignment]
        return Survey(kept, kernel, cloud_of(stored["sample"], kernel), step, origin, low, high, degree)


def harmonics_degree(scene: Survey, options: ConversionOptions) -> int:
    """Degree of the harmonics that tiles have, with the resolved ``options``."""
    return min(scene.sh_degree, options.color_degree or 3) if options.colors == "view" else 0


def build_cell(tiles: Shared[TileWriter], cell: tuple[str, list[Path]]) -> int:
    """Writes the tiles of a cell of that key, with the splats of these files; their count."""
    key, files = cell
    writer = tiles.get()
    records = read_records(files, writer.degree)
    writer.keep(key, *writer.subtree(key, records))
    return len(records)


class TileWriter:
    """Writes tiles into the folder of a run whose survey is done. Keeps nothing of them."""

    def __init__(self, folder: Path, options: TileOptions, threads: int | None) -> None:
        self._options, self._threads = options, threads
        self._conversion = options.resolved()
        self._work, self._out = folder / "work", folder / "tileset"
        self._most = options.max_triangles // options.triangles_each(self._conversion)
        self._up = up = unit_up(options.up or DEFAULT_UP)
        self._frame = tile_frame(up)
        scene = stored_survey(self._work / SURVEY)
        self._kernel = scene.kernel
        self.degree = harmonics_degree(scene, self._conversion)
        self._type = _with_spread(record_type(self.degree))
        self._views = SceneViews(scene, self._conversion, None, up)
        # Tiles are relative to the origin of the splats.
        self._driver = Driver(self._conversion, self._views, up, np.zeros(3))
        self._cube = Cube(scene.low, scene.high)

    # -- cells in memory

    def subtree(self, key: str, records: np.ndarray) -> tuple[list[Node], np.ndarray]:
        """Writes the tiles of a cell; their nodes, its own last, and the splats that stand for it."""
        codes = self._cube.codes(records["means"])
        order = np.lexsort((records["row"], codes))
        return self._tree(key, records[order], codes[order])

    def _tree(self, key: str, records: np.ndarray, codes: np.ndarray) -> tuple[list[Node], np.ndarray]:
        if len(records) <= self._most:
            return self._leaf(key, records)
        starts = self._starts(key, codes)
        groups = self._groups(starts)
        if len(groups) == 1:  # a cell with one child is that child
            return self._tree(f"{key}{groups[0][0]}", records, codes)
        nodes: list[Node] = []
        children, parts = [], []
        for octant, part in groups:
            found, merged = self._tree(f"{key}{octant}", records[part], codes[part])
            nodes += found
            children.append(found[-1])
            parts.append(merged)
        node, merged = self._inner(key, children, parts)
        return [*nodes, node], merged

    def _groups(self, starts: np.ndarray) -> list[tuple[int, slice]]:
        """The children of a cell: first octant and splats of each. Octants with few splats share a leaf."""
        groups: list[tuple[int, slice]] = []
        for octant in np.flatnonzero(np.diff(starts)):
            begin, end = int(starts[octant]), int(starts[octant + 1])
            if groups and end - groups[-1][1].start <= self._most:
                groups[-1] = (groups[-1][0], slice(groups[-1][1].start, end))
            else:
                groups.append((int(octant), slice(begin, end)))
        return groups

    def _starts(self, key: str, codes: np.ndarray) -> np.ndarray:
        """(9,) first splat of each octant of a cell whose ``codes`` are ascending, and their count."""
        if len(key) >= DEPTH:
            return np.arange(9, dtype=np.int64) * len(codes) // 8
        octants = (codes >> np.uint64(3 * (DEPTH - 1 - len(key)))) & np.uint64(7)
        return np.searchsorted(octants, np.arange(9, dtype=np.uint64))

    def _leaf(self, key: str, records: np.ndarray) -> tuple[list[Node], np.ndarray]:
        records = records[np.argsort(records["row"], kind="stable")]
        cloud = cloud_of(records, self._kernel)
        node = self._write(key, cloud, records["row"], self._views.pixel_sizes(cloud.means), 0.0, [])
        return [node], _merged_from(records)

    def _inner(
        self, key: str, children: Sequence[Node], parts: Sequence[np.ndarray]
    ) -> tuple[Node, np.ndarray]:
        """Writes the tile that stands for ``children``, which show the splats ``parts``."""
        below = np.concatenate(list(parts))
        below = below[np.argsort(below["row"], kind="stable")]
        cloud = cloud_of(below, self._kernel)
        count = max(1, min(self._most, -(-len(below) // SHARE)))
        finest = max(child.error for child in children)
        pixel = np.full(len(below), finest, np.float32)
        if not finest:
            own = self._views.pixel_sizes(cloud.means)
            pixel = np.zeros_like(pixel) if own is None else own
        result = merge(cloud, count, low_pass_of(self._kernel, pixel), threads=self._threads)
        first = np.unique(result.group, return_index=True)[1]
        rows = below["row"][first]
        merged = _merged_from(records_of(result.cloud, rows, self.degree))
        weights, totals = _weights(result.group, result.masses)
        away = np.square(cloud.means.astype(np.float64) - result.cloud.means[result.group]).sum(axis=1)
        merged["spread"] = np.bincount(result.group, weights * (below["spread"] + away), len(rows))
        apart = np.sqrt(merged["spread"])
        # None counts for more than the whole tile: else one stray, of any size, would speak for all.
        usual = np.quantile(cloud.means.astype(np.float64), (0.01, 0.99), axis=0)
        totals = np.minimum(totals, float(np.ptp(usual, axis=0).max()) ** 2)
        error = weighted_quantile(apart, totals, ERROR_SHARE) if totals.any() else float(apart.max())
        error = max(error, finest)
        size = None if self._views.is_none else np.full(len(rows), error, np.float32)
        node = self._write(key, result.cloud, rows, size, error, [child.key for child in children], children)
        return node, merged

    def _write(
        self,
        key: str,
        cloud: GaussianCloud,
        rows: np.ndarray,
        pixel: np.ndarray | None,
        error: float,
        children: list[str],
        below: Sequence[Node] = (),
    ) -> Node:
        """Writes the content of a tile."""
        path = self._out / tile_path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        triangles = vertices = 0
        if self._options.as_splats:
            write_splat_tile(cloud, path, self._up)
            corners = self._reach(cloud)
        else:
            mesh = self._save_mesh(self._driver.mesh(self._driver.sized(cloud, rows, pixel)), path)
            triangles, vertices = len(mesh.faces), len(mesh.vertices)
            corners = mesh.vertices.astype(np.float64) @ self._frame.T
        low = np.min([corners.min(axis=0), *(node.low for node in below)], axis=0)
        high = np.max([corners.max(axis=0), *(node.high for node in below)], axis=0)
        return Node(
            key=key,
            low=[float(x) for x in low],
            high=[float(x) for x in high],
            error=float(error),
            splats=len(cloud),
            triangles=triangles,
            vertices=vertices,
            children=children,
        )

    def _save_mesh(self, mesh: SplatMesh, path: Path) -> SplatMesh:
        """Writes the ``mesh`` of a tile; returns it as it is written."""
        alpha: Alpha = "mask" if self._options.alpha == "auto" else self._options.alpha
        if alpha == "opaque":
            # A tile of nothing but fog keeps its densest part: glTF has no empty meshes.
            mesh = cut_mesh(mesh, min(CUTOFF, 0.9 * float(mesh.colors[:, 3].max())))
        lit = True if self._options.lit else None
        save_mesh(mesh, path, lit=lit, alpha=None if alpha == "opaque" else alpha)
        return mesh

    def _reach(self, cloud: GaussianCloud) -> np.ndarray:
        """(2 n, 3) least and greatest corners of the boxes around splats, in the frame of the tileset."""
        centers = cloud.means.astype(np.float64) @ self._frame.T
        axes = self._frame @ (cloud.rotations.astype(np.float64) * cloud.scales[:, None])
        reach = SPLAT_REACH * np.linalg.norm(axes, axis=2)
        return np.concatenate([centers - reach, centers + reach])

    # -- cells above those in memory

    def keep(self, cell: str, nodes: list[Node], merged: np.ndarray) -> None:
        """Files what is done of a cell, for the ones above it and for a resumed run."""
        # Not by tofile, whose errors do not say that the disk is full.
        write_bytes(self._merged(cell), merged.view(np.uint8).data)
        write_text(
            self._work / "done" / f"cell-{cell}.json", json.dumps([asdict(node) for node in nodes]) + "\n"
        )

    def _merged(self, cell: str) -> Path:
        return self._work / "done" / f"cell-{cell}.merged"

    def upper(self, cells: Sequence[str], journal: Journal) -> str:
        """Writes the tiles above ``cells``, ascending; the cell that holds all of them."""
        top = os.path.commonprefix(list(cells))  # noqa: RUF071 - a character is a level
        if len(cells) == 1:
            return top
        parts = [
            self.upper([cell for cell in cells if cell.startswith(top + octant)], journal)
            for octant in sorted({cell[len(top)] for cell in cells})
        ]
        if top not in journal.keys("above"):
            below = [self.root_of(place) for place in parts]
            for place, child in zip(parts, below, strict=True):
                check_size(self._merged(place), child.splats * self._type.itemsize)
            merged = [np.fromfile(self._merged(place), self._type) for place in parts]
            node, own = self._inner(top, below, merged)
            self.keep(top, [node], own)
            journal.add("above", key=top)
        return top

    def root_of(self, cell: str) -> Node:
        """The uppermost tile of a cell that is done."""
        nodes = json.loads((self._work / "done" / f"cell-{cell}.json").read_text(encoding="utf-8"))
        return Node(**nodes[-1])


def _with_spread(record: np.dtype[np.void]) -> np.dtype[np.void]:
    """A splat of a tile: its ``record``, and the variance of the centres of the file's splats around it,
    square scene units."""
    return np.dtype([*record.descr, ("spread", "<f8")])


def _merged_from(records: np.ndarray) -> np.ndarray:
    """``records`` with a spread of 0."""
    merged = np.zeros(len(records), _with_spread(records.dtype))
    for name in records.dtype.names or ():
        merged[name] = records[name]
    return merged


def _weights(group: np.ndarray, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) share of each splat in the mass of its group, and (g,) masses of the groups. In a group without
    mass, all members count alike."""
    totals = np.bincount(group, masses)
    sizes = np.bincount(group)
    own = totals[group]
    shares = np.divide(masses, own, out=np.zeros_like(masses), where=own > 0)
    return np.where(own > 0, shares, 1 / sizes[group]), totals
