"""Fans as splats: for each fan the flat Gaussian whose own fan would be the nearest, and all of them fitted
to the photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.geometry import quaternions_of
from meshsplats.conversion.profiles import fit_profile
from meshsplats.conversion.recovery import THICKNESS
from meshsplats.datasets.views import Dataset, View
from meshsplats.finetuning.checkpoint import load_checkpoint
from meshsplats.finetuning.config import LEAST_MINUTES
from meshsplats.finetuning.gradients import Gradients
from meshsplats.finetuning.journal import CHECKPOINT
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.run import Progress, TrainingLoop, run_start
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import for_views
from meshsplats.rendering.engine import Need
from meshsplats.scene.gaussians import DILATION, SH_C0, GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training.config import TrainConfig, with_train_changes
from meshsplats.training.exposures import exposures_differ
from meshsplats.training.growth import corners_of, fan_count, select_fans
from meshsplats.training.initial import fans_of

FITTED_SIDES = 4
"""Triangles of the fan that stands for a splat while it is fitted. With the low-pass filter of splats, images
of such fans and of splats are 36 dB apart in a room of 100,000; with six sides 36, with two rings 40."""
FITTED_SHARE = 0.2
"""Share of a run in which they are fitted."""
COLOR_RATE, POSITION_RATE = 0.005, 0.03
"""Learning rates of the fit. Twice and four times those of colours lose 0.1 and 0.5 dB in such a room."""
HALVED = 0.5
"""Fans that become two splats, as a share of all. Of none, 0.2 dB less; of all, 0.1 in 60 steps."""


def splats_of_fans(mesh: SplatMesh) -> GaussianCloud:
    """Splats with the place, extent, colour and opacity of the fans of ``mesh``.

    A fan of s sides around a splat with covariance C has a rim with sum_j (r_j - c) (r_j - c)^T = s / 2 R^2
    C, where R is the radius of the rim in standard deviations; C is found from that of the rim. Positions and
    colours are means weighted by opacity, which falls linearly to the rim: half of the weight is the
    centre's. A fan has more freedom than an ellipse of one colour, so the splats look coarser than the mesh.

    Raises ValueError unless ``mesh`` is one of equal fans, centre first, as ``train`` makes them.
    """
    check_fans(mesh)
    corners, n = corners_of(mesh), fan_count(mesh)
    sides = corners - 1
    profile = fit_profile(sides, conserve=True)
    positions = mesh.vertices.reshape(n, corners, 3).astype(np.float64)
    colors = mesh.colors.reshape(n, corners, 4).astype(np.float64)
    center, rim = positions[:, 0], positions[:, 1:]
    middle = (center + rim.mean(axis=1)) / 2
    offset = rim - rim.mean(axis=1, keepdims=True)
    moments = np.einsum("nki,nkj->nij", offset, offset) * (2 / (sides * profile.radii[-1] ** 2))
    values, axes = np.linalg.eigh(moments)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    sigma = np.sqrt(np.maximum(values, 0))
    sigma[:, 1] = np.maximum(sigma[:, 1], 1e-3 * sigma[:, 2])
    sigma[:, 0] = THICKNESS * sigma[:, 1]
    rgb = (colors[:, 0, :3] + colors[:, 1:, :3].mean(axis=1)) / 2
    opacity = np.clip(colors[:, 0, 3] / profile.opacities[0], 0, 1)
    sh = (rgb[:, None] - 0.5) / SH_C0
    if mesh.harmonics is not None:
        sh = np.concatenate([sh, mesh.harmonics], axis=1)
    return GaussianCloud(middle, quaternions_of(axes), sigma, opacity, sh, up=mesh.up, origin=mesh.origin)


def check_fans(mesh: SplatMesh) -> None:
    """ValueError unless all splats of ``mesh`` are fans of one count of sides, one after the other, each with
    its centre first."""
    if mesh.face_splat is not None and len(mesh.faces):
        first = mesh.faces[mesh.face_splat == mesh.face_splat[0]]
        corners = int(first.max()) + 1
        n = len(mesh.vertices) // corners
        if len(mesh.vertices) == n * corners and len(mesh.faces) == n * len(first):
            expected = first + corners * np.arange(n)[:, None, None]
            if (first[:, 0] == 0).all() and (mesh.faces.reshape(n, -1, 3) == expected).all():
                return
    raise ValueError("not a mesh of equal fans: only the result of a training, unedited, becomes splats")


def fit_splats(
    mesh: SplatMesh,
    dataset: Dataset,
    config: TrainConfig,
    *,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> GaussianCloud:
    """``splats_of_fans`` of ``mesh``, fitted to the training views of ``dataset`` as splats are drawn: whole,
    by the distance of their centres, and with the low-pass filter of their viewers.

    Fans whose colours change most are halved before. Then each splat is trained as the fan that it would
    have, with that filter.

    Args:
        mesh: the result of ``train`` with ``config``.
        dataset: that of the training.
        config: the fit takes ``FITTED_SHARE`` of its length.
        run: resources; nothing is written. A folder is that of the training: exposures are fitted if they
            were there, and begin with those.
        on_progress: called after every step.

    Raises ValueError as ``splats_of_fans``, else as ``finetune``.
    """
    check_fans(mesh)
    run = run or RunOptions()
    exposures = None
    if run.folder is not None:
        exposures = _fitted_exposures(run.folder / CHECKPOINT, len(dataset.train))
        config = replace(config, exposure=exposures is not None)
    run = replace(run, folder=None, resume=False)
    config = for_views(_fitting(config, mesh, dataset, run.threads), dataset.train)
    halved = _halved(mesh, dataset.train, config)
    fans = fans_of(splats_of_fans(halved), FITTED_SIDES)
    fans = replace(fans, harmonics=halved.harmonics, order="splat", filter_px2=DILATION)
    fans = replace(fans, up=mesh.up, origin=mesh.origin)
    start = run_start(fans, dataset, config, run, None, kind=_FansOfSplats)
    if exposures is not None and start.state.exposures is not None:
        start.state.exposures[:] = exposures
    loop = TrainingLoop(start, start.clock(run), Blended(config), run, on_progress, plain=False)
    return splats_of_fans(loop.run())


def _fitted_exposures(checkpoint: Path, views: int) -> np.ndarray | None:
    """(views, 6) exposures of the training that ended with ``checkpoint``; None if it fitted none, or had no
    time for a step and left no checkpoint."""
    if not checkpoint.is_file():
        return None
    found = load_checkpoint(checkpoint).arrays.get("exposure.values")
    return None if found is None else checked_array("exposures", found, np.float32, (views, 6))


class _FansOfSplats(State):
    """Fans that remain those of splats: flat, elliptical, of one colour. A step moves all vertices of a fan
    along the gradient of its splat."""

    def step(
        self, gradients: Gradients, color_rate: float, position_rate: float, view: int, *, edges: bool = False
    ) -> None:
        corners = corners_of(self.mesh)
        colors = gradients.colors.reshape(-1, corners, 4)[..., :3]
        colors[...] = colors.sum(axis=1, keepdims=True)
        vertices = gradients.vertices.reshape(-1, corners, 3)
        np.einsum("ij,njk->nik", _affine(corners), vertices.copy(), out=vertices)
        super().step(gradients, color_rate, position_rate, view, edges=edges)
        self.round_fans(corners, 1.0)
        rgb = self.colors.reshape(-1, corners, 4)[..., :3]
        rgb[...] = rgb.mean(axis=1, keepdims=True)

    @property
    def needs(self) -> set[Need]:
        return super().needs | {"frozen"}  # fused steps of a GPU would not keep them together


@lru_cache
def _affine(corners: int) -> np.ndarray:
    """(corners, corners) float32: projects motions of the vertices of a fan, centre first, onto those that
    affine maps of a regular one make."""
    angle = 2 * np.pi * np.arange(corners - 1) / (corners - 1)
    rim = np.column_stack([np.ones(corners - 1), np.cos(angle), np.sin(angle)])
    basis = np.linalg.qr(np.vstack([[1, 0, 0], rim]))[0]
    return np.asarray(basis @ basis.T, np.float32)


def _fitting(config: TrainConfig, mesh: SplatMesh, dataset: Dataset, threads: int | None) -> TrainConfig:
    """The configuration of the fit after a training of ``mesh`` with ``config``."""
    views = dataset.train
    if config.exposure is None:
        config = replace(config, exposure=exposures_differ(mesh, views, threads))
    length: dict[str, float]
    if config.minutes is not None:
        length = {"minutes": max(LEAST_MINUTES, FITTED_SHARE * config.minutes)}
    else:
        length = {"steps": max(1, round(FITTED_SHARE * (config.total_steps(len(views)) or 0)))}
    return with_train_changes(
        config, order="splat", color_rate=COLOR_RATE, position_rate=POSITION_RATE, **length
    )


def _halved(mesh: SplatMesh, views: Sequence[View], config: TrainConfig) -> SplatMesh:
    """``mesh`` with ``HALVED`` of its fans in two: those whose colour changes most along them, weighted by
    what the nearest of ``views`` sees of them."""
    corners, n = corners_of(mesh), fan_count(mesh)
    positions = mesh.vertices.reshape(n, corners, 3).astype(np.float64)
    colors = mesh.colors.reshape(n, corners, 4).astype(np.float64)
    offset = positions - positions.mean(axis=1, keepdims=True)
    moments = np.einsum("nki,nkj->nij", offset, offset)
    squares, axes = np.linalg.eigh(moments)
    along = np.einsum("nki,ni->nk", offset, axes[:, :, 2])
    change = np.einsum("nk,nkc->nc", along, colors[..., :3])  # centred: offsets sum to 0
    change = np.linalg.norm(change, axis=1) / np.sqrt(np.maximum(squares[:, 2], 1e-30))
    areas = np.sqrt(np.maximum(squares[:, 1] * squares[:, 2], 0))
    nearest = np.full(n, np.inf)
    for view in views:
        np.minimum(nearest, np.square(positions[:, 0] - view.camera.center).sum(axis=1), out=nearest)
    weight = change * colors[:, 0, 3] * areas / np.maximum(nearest, 1e-30)
    rows = np.sort(np.argsort(-weight, kind="stable")[: int(HALVED * n)])
    state = State.begin(mesh, len(views), config, None)
    return select_fans(state, np.arange(n), rows).result()
