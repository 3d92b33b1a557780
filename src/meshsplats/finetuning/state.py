"""The optimised parameters of a fine-tuning, positions, colours and exposures, with their optimisers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from meshsplats._common.arrays import checked_array, nonzero_rows
from meshsplats._common.choices import Device
from meshsplats._core.kernels import round_fans
from meshsplats.finetuning.adam import RowAdam
from meshsplats.finetuning.bound import BoundPositions, weight_units
from meshsplats.finetuning.checkpoint import mesh_arrays, reading_arrays, stored_mesh
from meshsplats.finetuning.config import HARMONICS_RATE, FinetuneConfig, epsilons
from meshsplats.finetuning.gradients import Gradients, Rates, StepImage
from meshsplats.finetuning.initial import boundary_vertices, order_of, vertex_sizes
from meshsplats.finetuning.loss import LossWeights
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.devices import engine
from meshsplats.rendering.edges import faces_across
from meshsplats.rendering.engine import FusedSteps, Need, Taped
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import srgb_to_linear
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh, Triangles, solid_faces
from meshsplats.webgpu.training import Moments, Parameters, Sums
from meshsplats.webgpu.training import Rates as StepRates

GAIN, OFFSET = slice(0, 3), slice(3, 6)

MAX_OPACITY = np.float32(254 / 255)
"""Greatest opacity of a corner of blended triangles beside opaque ones, so that they differ."""


class State:
    """The optimisation state.

    Attributes:
        vertices: (v, 3) float32, scene units, changed in place. After fused steps of the engine, they are
            fetched when they are read.
        colors: (v, 4) float32 straight RGBA in [0, 1], in the space of ``blending``, likewise. With harmonics
            RGB may be above 1.
        harmonics: (s, k, 3) float32 as in ``SplatMesh``, changed in place; None if the mesh has none.
        mesh: the initial mesh without pruned triangles: triangles, their splats, attributes.
        sizes: (v,) float32, the unit of each vertex' position or, on a base mesh, of its weights.
        bound: for a mesh that is bound to a base, the barycentric weights that are optimised in place of
            positions, and that determine ``vertices``; otherwise None.
        exposures: (views, 6) float32: gain and offset of red, green and blue for each training view; None if
            they are not fitted.
        solid: for a mesh of opaque and blended triangles, (v,) bool: the vertices of opaque ones, whose
            opacities stay; otherwise None.
        frozen: (v,) bool: vertices whose positions and colours stay; None if there are none.
        device: where images are drawn.
    """

    def __init__(
        self,
        mesh: SplatMesh,
        sizes: np.ndarray,
        exposures: np.ndarray | None,
        config: FinetuneConfig,
        threads: int | None,
        device: Device = "cpu",
    ) -> None:
        self.mesh, self.sizes, self.config, self.threads = mesh, sizes, config, threads
        self.device: Device = device
        self._session = engine(device, threads).session(mesh)
        self._ahead: FusedSteps | None = None  # has taken steps that the arrays here do not have
        self._vertices, self._rgba = mesh.vertices.copy(), mesh.colors.copy()
        self.exposures = None if exposures is None else exposures.copy()
        adam = partial(RowAdam, betas=(config.beta1, config.beta2), threads=threads)
        color_epsilon, position_epsilon = epsilons(config)
        self.bound = None if mesh.binding is None else BoundPositions(mesh.binding)
        if self.bound is not None:
            self._positions = adam(self.bound.weights, lr=1.0, scale=sizes, eps=position_epsilon)
        else:
            unit = sizes if config.position_unit == "splat" else None
            self._positions = adam(self._vertices, lr=1.0, scale=unit, eps=position_epsilon)
        self._sh = None if mesh.harmonics is None else mesh.harmonics.copy()
        self._harmonics = None
        if self._sh is not None:
            self._harmonics = adam(self._flat_harmonics, lr=1.0, eps=color_epsilon)
        brightest = 1 if mesh.harmonics is None else MAX_COLOR
        self._colors = adam(self._rgba, lr=1.0, bounds=(0, brightest), eps=color_epsilon)
        # Depends on the triangles alone, so that a resumed run finds the same boundary.
        self._boundary = boundary_vertices(mesh.faces, len(mesh.vertices)) if config.soft_edges else None
        self._exposures = None
        if self.exposures is not None:
            self._exposures = adam(self.exposures, lr=config.exposure_rate, eps=color_epsilon)
        self.solid: np.ndarray | None = None
        self.frozen: np.ndarray | None = None

    @property
    def vertices(self) -> np.ndarray:
        self._fetch()
        return self._vertices

    @property
    def triangles(self) -> Triangles:
        """The mesh as it is now."""
        return self.mesh.triangles._replace(
            vertices=self.vertices, colors=self.colors, harmonics=self.harmonics
        )

    @cached_property
    def across(self) -> np.ndarray:
        """``faces_across`` of the triangles."""
        return faces_across(self.mesh.faces)

    @property
    def colors(self) -> np.ndarray:
        self._fetch()
        return self._rgba

    @property
    def harmonics(self) -> np.ndarray | None:
        """(s, k, 3) float32; None for a mesh without."""
        self._fetch()
        return self._sh

    @property
    def _flat_harmonics(self) -> np.ndarray:
        """(s, 3 k) view of ``harmonics``."""
        assert self._sh is not None
        return self._sh.reshape(len(self._sh), -1)

    @classmethod
    def begin(
        cls,
        mesh: SplatMesh,
        views: int,
        config: FinetuneConfig,
        threads: int | None,
        *,
        cameras: Sequence[Camera] = (),
        frozen: np.ndarray | None = None,
        device: Device = "cpu",
    ) -> State:
        """The state before the first step, for ``views`` training views, with ``cameras``, and vertices that
        are ``frozen``."""
        mesh = replace(mesh, order=order_of(mesh, config))
        engine(device, threads).check(mesh=mesh)
        # Positions and colours change, these would not.
        mesh = replace(mesh, normals=None, plain_colors=None)
        if mesh.binding is not None:
            mesh = replace(mesh, vertices=mesh.binding.positions())
        if config.blending == "linear" and mesh.blending == "display":
            mesh = mesh.of_degree(0)  # harmonics are display colours
            colors = mesh.colors.copy()
            colors[:, :3] = np.clip(srgb_to_linear(colors[:, :3]), 0, 1)
            mesh = replace(mesh, colors=colors, blending="linear")
        elif config.blending == "display" and mesh.blending == "linear":
            raise ValueError("the mesh is to be blended in linear light: choose blending 'mesh' or 'linear'")
        exposures = None
        if config.exposure:
            exposures = np.tile(np.array([1, 1, 1, 0, 0, 0], np.float32), (views, 1))
        if mesh.binding is not None:
            sizes = weight_units(mesh, config.position_unit == "scene")
        else:
            sizes = vertex_sizes(mesh, cameras, 0.0 if config.cuts else config.position_pixels)
        state = cls(mesh, sizes, exposures, config, threads, device)
        state.frozen = frozen
        return state

    @classmethod
    def begin_opaque(cls, mesh: SplatMesh, config: FinetuneConfig, threads: int | None) -> State:
        """The state before the first step with the opaque triangles of ``mesh``, whose edges are visible."""
        return cls(mesh, vertex_sizes(mesh), None, config, threads)

    @classmethod
    def begin_hybrid(cls, mesh: SplatMesh, config: FinetuneConfig, threads: int | None) -> State:
        """The state before the first step with the opaque and blended triangles of ``mesh``."""
        state = cls.begin_opaque(mesh, config, threads)
        state.solid = mesh.vertices_of(solid_faces(mesh))
        return state

    @classmethod
    def resume(
        cls,
        arrays: dict[str, np.ndarray],
        blending: str,
        order: str,
        views: int,
        config: FinetuneConfig,
        threads: int | None,
        device: Device = "cpu",
    ) -> State:
        """The state in a checkpoint's arrays. FileFormatError if they do not fit each other."""
        mesh = stored_mesh(arrays, blending, order)
        engine(device, threads).check(mesh=mesh)
        with reading_arrays():
            sizes = _checked_shape(arrays["sizes"], (len(mesh.vertices),)).copy()
            exposures = _checked_shape(arrays["exposure.values"], (views, 6)) if config.exposure else None
            state = cls(mesh, sizes, exposures, config, threads, device)
            for name, adam in state._optimisers().items():
                part = {key: arrays[f"{name}.{key}"] for key in ("mean", "square", "steps")}
                adam.load_state(part)
            if arrays.get("solid", np.zeros(())):
                state.solid = mesh.vertices_of(solid_faces(mesh))
            if "frozen" in arrays:
                state.frozen = checked_array("frozen", arrays["frozen"], bool, (len(mesh.vertices),))
            state._session.resume(arrays)
        return state

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays that ``resume`` needs, by their names in a checkpoint."""
        self._fetch()
        arrays = mesh_arrays(self.result()) | {"sizes": self.sizes} | self._session.arrays()
        if self.exposures is not None:
            arrays["exposure.values"] = self.exposures
        for name, adam in self._optimisers().items():
            arrays |= {f"{name}.{key}": value for key, value in adam.state().items()}
        if self.solid is not None:
            arrays["solid"] = np.ones((), np.int32)
        if self.frozen is not None:
            arrays["frozen"] = self.frozen
        return arrays

    def result(self) -> SplatMesh:
        """The current mesh."""
        return replace(
            self.mesh,
            vertices=self.vertices.copy(),
            colors=self.colors.copy(),
            harmonics=None if self.harmonics is None else self.harmonics.copy(),
            binding=None if self.bound is None else self.bound.binding(),
        )

    def step(
        self, gradients: Gradients, color_rate: float, position_rate: float, view: int, *, edges: bool = False
    ) -> None:
        """One step of Adam along ``gradients`` for the vertices that the training view of index ``view``
        reached. ``edges``: they include the motion of edges, without which opaque triangles stay in place.
        """
        self._change()
        # Opaque vertices, and those of the colour behind them, have a gradient of their colour alone.
        reached = nonzero_rows(gradients.colors)
        if self.frozen is not None:
            reached &= ~self.frozen
        if self.solid is not None:
            gradients.colors[self.solid, 3] = 0
        opacity = self.colors[:, 3]
        transparent = None if self._boundary is None else self._boundary & (opacity == 0)
        self._colors.lr = color_rate
        self._colors.step(gradients.colors, reached)
        if self._harmonics is not None:
            np.minimum(opacity, 1, out=opacity)
            self._step_harmonics(gradients, color_rate)
        if self.config.opacity_decay:
            opacity[reached] *= np.float32(self._opacity_kept(color_rate))
        if transparent is not None:
            opacity[transparent] = 0
        if self.solid is not None:
            np.minimum(opacity, MAX_OPACITY, out=opacity, where=~self.solid)
        if position_rate > 0:
            self._positions.lr = position_rate
            if self.solid is not None and not edges:
                # Positions would follow the colours alone.
                self._positions.step(gradients.vertices, reached & ~self.solid)
            elif self.bound is None:
                self._positions.step(gradients.vertices, reached)
            else:
                # A vertex in a corner of its face stays there.
                movable = reached & (self.bound.weights < 1).all(axis=1)
                rows = np.flatnonzero(movable)
                before = self.bound.weights[rows]
                self._positions.step(self.bound.gradient(gradients.vertices, rows), movable)
                self.bound.project(before, rows, self.vertices)
        if self._exposures is not None and self.exposures is not None and gradients.exposure is not None:
            grad = np.zeros_like(self.exposures)
            grad[view] = gradients.exposure
            self._exposures.step(grad, np.array([view], np.int32))
            # A gain common to all images is equivalent to other mesh colours: the means stay fixed.
            mean = self.exposures.mean(axis=0, dtype=np.float64) - [1, 1, 1, 0, 0, 0]
            self.exposures -= mean.astype(np.float32)

    def _step_harmonics(self, gradients: Gradients, color_rate: float) -> None:
        """One step for the harmonics of splats that the view reached, at a rate that falls as that of colours
        does."""
        assert self._harmonics is not None
        assert gradients.harmonics is not None
        flat = gradients.harmonics.reshape(len(gradients.harmonics), -1)
        rate = self._harmonics_rate(color_rate)
        if rate > 0:
            reached = nonzero_rows(flat[:, :9])  # degree 1: where it is 0, so are all
            if self.frozen is not None:
                reached &= ~self._frozen_splats
            self._harmonics.lr = rate
            self._harmonics.step(flat, reached)

    def _opacity_kept(self, color_rate: float) -> float:
        """Share of its opacity that a vertex keeps that a step reaches. What it loses is in proportion to the
        rate: its balance with the gradients is the same in runs of any length."""
        return max(1 - self.config.opacity_decay * color_rate / self.config.color_rate, 0)

    def _harmonics_rate(self, color_rate: float) -> float:
        rate = self.config.harmonics_rate
        return (HARMONICS_RATE if rate is None else rate) * color_rate / self.config.color_rate

    @cached_property
    def _frozen_splats(self) -> np.ndarray:
        """(s,) bool: the splats with a frozen vertex."""
        assert self.frozen is not None
        splats = self.mesh.splats
        return np.logical_or.reduceat(self.frozen[self.mesh.faces].any(axis=1), splats.starts)

    @property
    def needs(self) -> set[Need]:
        """What a step of this state asks of who takes it."""
        of_state: dict[Need, bool] = {
            "base mesh": self.bound is not None,
            "exposure": self.exposures is not None,
            "linear light": self.mesh.blending != "display",
            "frozen": self.frozen is not None or self.solid is not None,
            "depth groups": self.mesh.depth_group is not None,
        }
        return {need for need, there in of_state.items() if there}

    def tape(self, camera: Camera, options: TapeOptions, factors: np.ndarray | None = None) -> Taped:
        """The mesh as it is now from ``camera``, opacities times ``factors`` (v,), with a backward pass."""
        colors = self.colors if factors is None else self.colors.copy()
        if factors is not None:
            colors[:, 3] *= factors
        return self._session.tape(self.triangles._replace(colors=colors), camera, options)

    def fused_steps(self, camera: Camera, needs: Collection[Need]) -> FusedSteps | None:
        """What takes fused steps with images of this camera, in ``fused_step``; None: only ``step`` does."""
        return self._session.fused_steps(camera, self.needs.union(needs))

    def fused_step(self, steps: FusedSteps, image: StepImage, loss: LossWeights, rates: Rates) -> Sums:
        """One step that ``steps`` take, with all that belongs to it. ``rates``: learning rates of colours and
        of positions.

        Returns the sums. If they or the gradients are not finite, nothing has changed.
        """
        config = self.config
        moving = (
            (self._colors, rates.colors),
            (self._positions, rates.positions),
            (self._harmonics, self._harmonics_rate(rates.colors)),
        )
        sizes = [0.0 if adam is None or rate <= 0 else adam.next_rate(rate) for adam, rate in moving]
        kept, betas = self._opacity_kept(rates.colors), (config.beta1, config.beta2)
        asked = StepRates(*loss[:3], sizes[0], sizes[1], sizes[2], kept, betas, epsilons(config))
        sums = steps.step(self._parameters, image.camera, image.options, image.target, image.mask, asked)
        if sums.finite:
            self._ahead = steps
            for (adam, _), size in zip(moving, sizes, strict=True):
                if adam is not None and size:
                    adam.steps += 1
        return sums

    @property
    def _parameters(self) -> Parameters:
        """The arrays as they are here."""
        return Parameters(
            self._vertices,
            self._rgba,
            Moments(self._positions.mean, self._positions.square),
            Moments(self._colors.mean, self._colors.square),
            self._positions.scale,
            self._boundary,
            self._sh,
            None if self._harmonics is None else Moments(self._harmonics.mean, self._harmonics.square),
        )

    def _fetch(self) -> None:
        """Brings the arrays up to the last step."""
        if self._ahead is not None:
            self._ahead.fetch(self._parameters)
            self._ahead = None

    def _change(self) -> None:
        """To be called before the arrays change."""
        self._fetch()
        self._session.release()

    def round_fans(self, corners: int, share: float) -> None:
        """Moves each fan of ``corners`` vertices, centre first, towards a flat ellipse, by a ``share`` of
        the distance; for meshes that consist of such fans, one after the other."""
        if self._ahead is not None:
            self._ahead.round_fans(corners, share)
            return
        self._change()
        round_fans(self._vertices.reshape(-1, corners, 3), share, self.threads)

    def squares(self) -> np.ndarray:
        """(v,) float32: about the sum of the squared gradient of a vertex's colour over the last
        1 / (1 - beta2) steps that reached it."""
        self._fetch()
        found: np.ndarray = self._colors.square[:, :3].max(axis=1) / np.float32(1 - self._colors.betas[1])
        return found

    def prune(self, keep: np.ndarray) -> State:
        """The state with only the triangles marked in ``keep`` (f,) bool, and the vertices they use."""
        if keep.all():
            return self
        self._fetch()
        return self.rebuild(self.result().take(keep), np.flatnonzero(self.mesh.vertices_of(keep)))

    def rebuild(self, mesh: SplatMesh, rows: np.ndarray, sizes: np.ndarray | None = None) -> State:
        """The state of ``mesh``, whose vertex i takes over what the optimisers know of vertex ``rows[i]``.

        Args:
            mesh: the new mesh, with its positions and colours.
            rows: (v,) indices of vertices of this state, in any order.
            sizes: (v,) float32 units of the new positions; by default those of ``rows``.
        """
        self._fetch()
        units = self.sizes[rows] if sizes is None else sizes
        result = State(mesh, units, self.exposures, self.config, self.threads, self.device)
        positions = result.vertices if result.bound is None else result.bound.weights
        result._positions = self._positions.select(positions, rows)
        result._colors = self._colors.select(result.colors, rows)
        if sizes is not None and result._positions.scale is not None:
            result._positions.scale = sizes.copy()
        if self._harmonics is not None and result.harmonics is not None:
            source = np.zeros(len(result.harmonics), np.int64)
            own, before = mesh.splats.of_vertex, self.mesh.splats.of_vertex
            used = own >= 0
            source[own[used]] = before[rows[used]]
            result._harmonics = self._harmonics.select(result._flat_harmonics, source)
        if self._exposures is not None:
            result._exposures = self._exposures.select(result.exposures, np.arange(len(self._exposures.mean)))
        if self.solid is not None:
            result.solid = self.solid[rows]
        if self.frozen is not None:
            result.frozen = self.frozen[rows]
        return result

    def restart(self, rows: np.ndarray) -> None:
        """Zeroes the first moments of the vertices ``rows``, after their values were replaced."""
        self._change()
        self._positions.restart(rows)
        self._colors.restart(rows)
        if self._harmonics is not None:
            self._harmonics.restart(np.unique(self.mesh.splats.of_vertex[rows]))

    def _optimisers(self) -> dict[str, RowAdam]:
        found = {"positions": self._positions, "colors": self._colors}
        found |= {} if self._harmonics is None else {"harmonics": self._harmonics}
        return found if self._exposures is None else found | {"exposure": self._exposures}


def _checked_shape(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
        raise ValueError(f"expected finite float32 of shape {shape}, got {array.dtype} of {array.shape}")
    return array
