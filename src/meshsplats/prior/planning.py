"""Mesh priors of files: how splats are laid on a base, what they are trained on, and their poses."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.kinds import as_path
from meshsplats._common.words import natural_key
from meshsplats.cameras.framing import guess_up
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.views import Dataset
from meshsplats.errors import AnimationWarning, DataWarning, OptionsError
from meshsplats.finetuning.checkpoint import Checkpoint, as_begun
from meshsplats.finetuning.config import FinetuneConfig, worthwhile_views
from meshsplats.finetuning.plans import Plan, Trained, over_background
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.finetuning.setup import Display
from meshsplats.finetuning.targets import Targets
from meshsplats.formats.base_meshes import load_base
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.mesh_formats import keeps, written_mesh_suffixes
from meshsplats.formats.meshes import save_mesh
from meshsplats.formats.outputs import check_mesh_suffix, check_outputs
from meshsplats.formats.usd.reader import usd_frames
from meshsplats.prior.agreement import warn_of_contradictions
from meshsplats.prior.laying import bind
from meshsplats.prior.matching import exchanged_axes, in_words
from meshsplats.prior.model import MeshPrior, load_prior
from meshsplats.prior.options import LayingOptions
from meshsplats.prior.training import train_prior
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class PriorTraining:
    """A training of splats on the base mesh ``source``, to the file ``output``."""

    source: Path
    output: Path
    laying: LayingOptions
    target: Targets
    splats: Path | None
    """Splats whose images are the targets; None: photographs."""
    reading: SceneReading
    say: Callable[[str], object]
    """Gets lines about the run."""
    threads: int | None = None

    def check(self) -> None:
        """OptionsError for options that contradict each other or have no effect, and for an output that
        cannot be moved with its base."""
        if not keeps(self.output, "binding"):
            known = " or ".join(s for s in written_mesh_suffixes() if keeps(f"mesh{s}", "binding"))
            raise OptionsError(
                f"``output`` must end in {known}, which keep the binding, got {self.output.name!r}"
            )
        if self.splats is not None and self.target.data is not None:
            raise OptionsError("give ``data`` or ``splats``, not both")
        if self.splats is None and self.target.data is None:
            raise OptionsError("give photographs with ``data``, or splats with ``splats``, as targets")
        self.laying.check()

    def plan(self, config: FinetuneConfig, earlier: Checkpoint | None) -> Plan:
        """Reads the files and prepares the run. ``earlier``: checkpoint of a run that is resumed."""
        base = self.laying.load_base(self.source)
        dataset = self._dataset(base, config, earlier)
        up = guess_up(_grey_mesh(base), [view.upright for view in dataset.train])
        laying = self.laying
        prior = bind(
            replace(base, up=up),
            triangles=laying.triangles,
            by_area=laying.by_area,
            layers=laying.layers,
            spacing=laying.spacing,
            colors=laying.colors,
            views=dataset.train,
            threads=self.threads,
        )
        background = None
        if self.target.data is not None:
            dataset, background = over_background(
                dataset, prior.mesh, config, self.source, self.threads, whole=False, say=self.say
            )
        summary = f"{len(base.faces):,} faces carry {len(prior.mesh.faces):,} triangles"

        def optimise(run: RunOptions, show: Display) -> Trained:
            trained = train_prior(prior, dataset, config, run=run, on_progress=show)
            counts = {"base_faces": len(trained.base_faces), "triangles": len(trained.mesh.faces)}
            made = f"{counts['triangles']:,} triangles on {counts['base_faces']:,} faces"
            return Trained(trained.in_file(self.output), trained.mesh, counts, made)

        return Plan(prior.mesh, dataset, summary, background, optimise)

    def _dataset(self, base: BaseMesh, config: FinetuneConfig, earlier: Checkpoint | None) -> Dataset:
        background = config.behind_splats
        if self.splats is None:
            return self.target.make(_grey_mesh(base), self.source, background, self.threads)
        cloud = self.reading.load(self.splats, base.origin, threads=self.threads)
        warn_of_contradictions(base, cloud, self.source, self.splats)
        views = worthwhile_views(as_begun(config, earlier))
        return self.target.make(cloud, self.splats, background, self.threads, views)


def _grey_mesh(base: BaseMesh) -> SplatMesh:
    grey = np.full((len(base.vertices), 4), 0.5, np.float32)
    return SplatMesh(base.vertices, base.faces, grey, up=base.up, origin=base.origin)


def pose_files(output: Path, count: int) -> list[Path]:
    """The files of so many poses: ``output``, or numbered ones beside it, ``edited_0001.glb`` and so on."""
    if count == 1:
        return [output]
    width = max(4, len(str(count)))
    return [output.with_name(f"{output.stem}_{i:0{width}d}{output.suffix}") for i in range(1, count + 1)]


def by_number(bases: Sequence[Path]) -> list[Path]:
    """The frames ``bases`` in natural order (2 before 10) where a shell has sorted them by their letters; any
    other order stays."""
    return (
        sorted(bases, key=lambda path: natural_key(str(path))) if list(bases) == sorted(bases) else [*bases]
    )


def save_poses(
    source: str | os.PathLike[str],
    bases: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    lift: float | None = None,
    place: Callable[[SplatMesh], SplatMesh] = lambda mesh: mesh,
    force: bool = False,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] = lambda poses, count: poses,
) -> dict[Path, Path]:
    """Writes the splats of the prior in the file ``source`` on each of the edited ``bases``, and of those
    that are USD files with an animation, on each of its time samples.

    Returns ``pose_files`` of ``output``, each with the base that it shows.

    Args:
        lift: distance between layers, scene units. By default that of the prior; for coplanar layers 0 in
            .npz, and ``MeshPrior.export_lift`` in other formats.
        place: makes of a mesh the one that is written.
        force: replace files that are there.
        progress: shows the progress of poses, of which there are so many, and passes them on.

    Where the first of the bases is that of the prior with other axes or units, a DataWarning says so. Axes
    that bring the prior's ``up`` to what the file states are exchanged again.

    Raises, before anything is written, what ``check_outputs`` raises, and ValueError for a base whose
    vertices are not those of the prior (``MeshPrior.vertices_of``).
    """
    source, output = as_path("source", source), as_path("output", output)
    edited = [as_path(f"bases[{i}]", base) for i, base in enumerate(bases)]
    check_mesh_suffix(output)
    check_outputs(pose_files(output, len(edited)), force, inputs=[source, *edited])
    prior = load_prior(source)
    loaded = [(path, base) for path in edited for base in _frames(path, prior.mesh.origin)]
    shown = [path for path, _ in loaded]
    targets = pose_files(output, len(loaded))
    check_outputs(targets, force, inputs=[source, *edited])
    poses = []
    for path, base in loaded:
        try:
            poses.append(prior.vertices_of(base))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    poses = _upright(prior, shown, [base for _, base in loaded], poses)
    if lift is None and output.suffix.lower() != ".npz" and not prior.lift:
        lift = prior.export_lift
    for pose, target in progress(zip(poses, targets, strict=True), len(targets)):
        mesh = place(prior.pose(pose, lift=lift))
        # Formats without a place for the binding would warn of it.
        save_mesh(mesh if keeps(target, "binding") else replace(mesh, binding=None), target)
    return dict(zip(targets, shown, strict=True))


def _frames(path: Path, origin: np.ndarray) -> list[BaseMesh]:
    """The base in a file, relative to ``origin``; of a USD file with an animation, at each of its times."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        base = load_base(path, textures=False, origin=origin)
    moving = [each for each in caught if issubclass(each.category, AnimationWarning)]
    for each in caught:
        if each not in moving:
            warnings.warn(each.message, stacklevel=4)
    if not moving:
        with Content(path) as content:
            if content.container in ("glb", "json") and GltfDocument(path).items("animations"):
                message = f"{path}: holds an animation, of which only the pose without it was read"
                message += ": export it as .usdc, or each frame as a file of its own"
                warnings.warn(message, DataWarning, stacklevel=4)
        return [base]
    return [replace(base, vertices=vertices) for vertices in usd_frames(path, base.origin)]


def _upright(
    prior: MeshPrior, paths: Sequence[Path], bases: Sequence[BaseMesh], poses: list[np.ndarray]
) -> list[np.ndarray]:
    """``poses``, (n, 3) each, of the ``bases`` in the files ``paths``, with their axes as in the prior."""
    if not poses:
        return poses
    turn, scale = exchanged_axes(prior.base_vertices, poses[0])
    stated = bases[0].up
    # Poses move what is up, files do not: together with the stated one, the turn cannot be meant.
    undone = bool(np.abs(turn @ prior.mesh.up - stated).max() < 1e-3) and not np.allclose(turn, np.eye(3))
    advice = "unless you have turned or scaled it so, export it with the axes and units of its import"
    if undone:
        poses = [p @ turn if np.array_equal(b.up, stated) else p for p, b in zip(poses, bases, strict=True)]
        advice = "as another axis points up in the file, too, it is turned back"
        advice += ", but not scaled: export it with the units of its import" if scale != 1 else ""
    if said := in_words(turn, scale):
        warnings.warn(f"{paths[0]}: {said}: {advice}", DataWarning, stacklevel=3)
    return poses
