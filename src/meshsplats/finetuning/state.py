"""What a fine-tuning changes: positions, colours and exposures, with their optimisers."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from meshsplats.colors import srgb_to_linear
from meshsplats.errors import FileFormatError
from meshsplats.finetuning.adam import RowAdam
from meshsplats.finetuning.bound import BoundPositions, weight_units
from meshsplats.finetuning.checkpoint import mesh_arrays, stored_mesh
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.finetuning.initial import on_open_edges, vertex_sizes
from meshsplats.finetuning.relocation import HALF, Usage, find_moves, halves
from meshsplats.mesh import SplatMesh

GAIN, OFFSET = slice(0, 3), slice(3, 6)


class Gradients(NamedTuple):
    """Of the loss of one picture. float32, C-contiguous."""

    vertices: np.ndarray
    """(v, 3)."""
    colors: np.ndarray
    """(v, 4)."""
    exposure: np.ndarray | None = None
    """(6,): gain and offset of this view; None if they are not fitted."""

    def finite(self) -> bool:
        """Whether all are finite."""
        # A sum of finite numbers may overflow, but then training has failed, too.
        with np.errstate(over="ignore", invalid="ignore"):
            return all(bool(np.isfinite(part.sum())) for part in self if part is not None)


class State:
    """The mesh in the making.

    Attributes:
        vertices: (v, 3) float32, scene units, changed in place.
        colors: (v, 4) float32 straight RGBA in [0, 1], in the space of ``blending``, changed in place.
        mesh: the mesh it began with, as far as it was not dropped: triangles, their splats, attributes.
        sizes: (v,) float32, the unit of each vertex' position or, on a base mesh, of its weights.
        bound: the weights that are optimised instead of positions where the mesh is bound to a base, else
            None; ``vertices`` follow them.
        exposures: (views, 6) float32: gain and offset of red, green and blue of each training view; None if
            they are not fitted.
    """

    def __init__(
        self,
        mesh: SplatMesh,
        sizes: np.ndarray,
        exposures: np.ndarray | None,
        config: FinetuneConfig,
        threads: int | None,
    ) -> None:
        self.mesh, self.sizes, self.config, self.threads = mesh, sizes, config, threads
        self.vertices, self.colors = mesh.vertices.copy(), mesh.colors.copy()
        self.exposures = None if exposures is None else exposures.copy()
        adam = partial(RowAdam, betas=(config.beta1, config.beta2), eps=config.epsilon, threads=threads)
        self.bound = None if mesh.binding is None else BoundPositions(mesh.binding)
        if self.bound is not None:
            self._positions = adam(self.bound.weights, lr=1.0, scale=sizes)
        else:
            unit = sizes if config.position_unit == "splat" else None
            self._positions = adam(self.vertices, lr=1.0, scale=unit)
        self._colors = adam(self.colors, lr=1.0, bounds=(0, 1))
        # Of the triangles alone, so that a resumed run has the same.
        self._edges = on_open_edges(mesh.faces, len(mesh.vertices)) if config.soft_edges else None
        self._exposures = None if self.exposures is None else adam(self.exposures, lr=config.exposure_rate)
        self._usage = Usage.none(len(mesh.vertices)) if config.relocate_share and self.bound is None else None

    @classmethod
    def begin(cls, mesh: SplatMesh, views: int, config: FinetuneConfig, threads: int | None) -> State:
        """That of a mesh before the first step."""
        mesh = replace(mesh, normals=None)  # they would not follow the positions
        if mesh.binding is not None:
            mesh = replace(mesh, vertices=mesh.binding.positions())
        if config.blending == "linear" and mesh.blending == "display":
            colors = mesh.colors.copy()
            colors[:, :3] = np.clip(srgb_to_linear(colors[:, :3]), 0, 1)
            mesh = replace(mesh, colors=colors, blending="linear")
        elif config.blending == "display" and mesh.blending == "linear":
            raise ValueError(
                "the mesh is made to be blended in linear light: choose blending 'mesh' or 'linear'"
            )
        exposures = None
        if config.exposure:
            exposures = np.tile(np.array([1, 1, 1, 0, 0, 0], np.float32), (views, 1))
        if mesh.binding is not None:
            sizes = weight_units(mesh, config.position_unit == "scene")
        else:
            sizes = vertex_sizes(mesh)
        return cls(mesh, sizes, exposures, config, threads)

    @classmethod
    def resume(
        cls,
        arrays: dict[str, np.ndarray],
        blending: str,
        views: int,
        config: FinetuneConfig,
        threads: int | None,
    ) -> State:
        """That of a checkpoint. FileFormatError if its arrays do not fit each other."""
        mesh = stored_mesh(arrays, blending)
        try:
            sizes = _of_shape(arrays["sizes"], (len(mesh.vertices),)).copy()
            exposures = _of_shape(arrays["exposure.values"], (views, 6)) if config.exposure else None
            state = cls(mesh, sizes, exposures, config, threads)
            for name, adam in state._optimisers().items():
                part = {key: arrays[f"{name}.{key}"] for key in ("mean", "square", "steps")}
                adam.load_state(part)
            if state._usage is not None:
                parts = (_of_shape(arrays[name], (len(mesh.vertices),)) for name in state._usage.arrays())
                state._usage = Usage(*(part.copy() for part in parts))
        except KeyError as error:
            raise FileFormatError(f"the checkpoint lacks {error}") from None
        except (ValueError, TypeError) as error:
            raise FileFormatError(f"the checkpoint is broken: {error}") from None
        return state

    def arrays(self) -> dict[str, np.ndarray]:
        """What ``resume`` needs."""
        arrays = mesh_arrays(self.result()) | {"sizes": self.sizes}
        if self.exposures is not None:
            arrays["exposure.values"] = self.exposures
        for name, adam in self._optimisers().items():
            arrays |= {f"{name}.{key}": value for key, value in adam.state().items()}
        if self._usage is not None:
            arrays |= self._usage.arrays()
        return arrays

    def result(self) -> SplatMesh:
        """The mesh as it is now."""
        return replace(
            self.mesh,
            vertices=self.vertices.copy(),
            colors=self.colors.copy(),
            binding=None if self.bound is None else self.bound.binding(),
        )

    def step(self, gradients: Gradients, color_rate: float, position_rate: float, view: int) -> None:
        """One step of Adam along ``gradients`` on what training view number ``view`` reached."""
        # Nothing in a picture moves without its opacity mattering; one column is quick to look through.
        reached = gradients.colors[:, 3] != 0
        opacity = self.colors[:, 3]
        clear = None if self._edges is None else self._edges & (opacity == 0)
        if self._usage is not None:
            self._usage.add(gradients.colors, gradients.vertices, self.sizes, reached)
        self._colors.lr = color_rate
        self._colors.step(gradients.colors, reached)
        if clear is not None:
            opacity[clear] = 0
        if position_rate > 0:
            self._positions.lr = position_rate
            if self.bound is None:
                self._positions.step(gradients.vertices, reached)
            else:
                # A vertex in a corner of its face has nowhere to go.
                movable = reached & (self.bound.weights < 1).all(axis=1)
                rows = np.flatnonzero(movable)
                before = self.bound.weights[rows]
                self._positions.step(self.bound.gradient(gradients.vertices, rows), movable)
                self.bound.settle(before, rows, self.vertices)
        if self._exposures is not None and self.exposures is not None and gradients.exposure is not None:
            towards = np.zeros_like(self.exposures)
            towards[view] = gradients.exposure
            self._exposures.step(towards, np.array([view], np.int32))
            # A gain of all pictures and one of the mesh's colours would be the same: means stay.
            mean = self.exposures.mean(axis=0, dtype=np.float64) - [1, 1, 1, 0, 0, 0]
            self.exposures -= mean.astype(np.float32)

    def relocate(self, looked_at: np.ndarray) -> int:
        """Lets splats that show next to nothing though they are ``looked_at``, (v,) bool, take over halves of
        those that are needed most, as far as the configuration allows; returns how many. What was seen of
        them so far is forgotten."""
        if self._usage is None:
            return 0
        idle, needed = find_moves(self.mesh, self._usage, looked_at, self.config.relocate_share)
        if len(idle):
            positions, colors = self.vertices, self.colors
            positions[needed], positions[idle] = halves(positions[needed])
            colors[idle] = colors[needed]
            # Sizes are the sides of squares.
            self.sizes[needed] *= np.sqrt(np.float32(HALF))
            self.sizes[idle] = self.sizes[needed]
            for rows in (idle, needed):
                self._positions.restart(rows, needed, self.sizes[rows])
                self._colors.restart(rows, needed)
        self._usage.clear()
        return len(idle)

    def prune(self, keep: np.ndarray) -> State:
        """Only the triangles marked in ``keep`` (f,) bool, and the vertices they use."""
        if keep.all():
            return self
        used = np.zeros(len(self.mesh.vertices), bool)
        used[self.mesh.faces[keep].ravel()] = True
        mesh = self.result().keep_faces(keep)
        smaller = State(mesh, self.sizes[used], self.exposures, self.config, self.threads)
        rows = np.flatnonzero(used)
        places = smaller.vertices if smaller.bound is None else smaller.bound.weights
        smaller._positions = self._positions.select(places, rows)
        smaller._colors = self._colors.select(smaller.colors, rows)
        if self._exposures is not None:
            every = np.arange(len(self._exposures.mean))
            smaller._exposures = self._exposures.select(smaller.exposures, every)
        if self._usage is not None:
            smaller._usage = Usage(self._usage.color[used], self._usage.position[used])
        return smaller

    def _optimisers(self) -> dict[str, RowAdam]:
        found = {"positions": self._positions, "colors": self._colors}
        return found if self._exposures is None else found | {"exposure": self._exposures}


def _of_shape(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
        raise ValueError(
            f"an array of shape {array.shape}, {array.dtype}; finite float32 of shape {shape} expected"
        )
    return array
