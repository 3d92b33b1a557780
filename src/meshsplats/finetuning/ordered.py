"""finetune_ordered: optimises a mesh through the order in which a file lists its triangles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.kinds import need
from meshsplats.cameras.framing import scene_bounds
from meshsplats.datasets.views import Dataset
from meshsplats.finetuning.config import FinetuneConfig, with_changes
from meshsplats.finetuning.journal import claimed
from meshsplats.finetuning.run import Progress, ready_loop
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.rendering.ordering import VIEWS, default_views
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.mesh import SplatMesh

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.finetuning.config import FinetuneChanges


class OrderedMesh(NamedTuple):
    """A mesh for viewers that do not sort: ``save_mesh(mesh, "scene.glb", order=order)``."""

    mesh: SplatMesh
    order: DrawOrder


def ordering_views(mesh: SplatMesh, dataset: Dataset) -> list[Camera]:
    """Views that the order of ``mesh`` is solved for before it is trained on ``dataset``: training views and,
    unless these look from within the scene or were found in a place, as many from all sides. Around an object
    in its surroundings, none trains from below; of a room, such views show the backs of walls."""
    cameras = [view.camera for view in dataset.train]
    if dataset.placed or (not dataset.around and _are_within(cameras, mesh)):
        return [*subsample(cameras, VIEWS)]
    return [*subsample(cameras, VIEWS // 2), *subsample(default_views(mesh), VIEWS // 2)]


def _are_within(cameras: Sequence[Camera], mesh: SplatMesh) -> bool:
    """Whether most cameras are nearer to the middle of the scene than nine tenths of it are."""
    bounds = scene_bounds(mesh)
    distances = [np.linalg.norm(camera.center - bounds.center) for camera in cameras]
    return bool(np.median(distances) < bounds.radius)


def finetune_ordered(
    mesh: SplatMesh,
    listing: DrawOrder,
    dataset: Dataset,
    config: FinetuneConfig | None = None,
    *,
    run: RunOptions | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **changes: Unpack[FinetuneChanges],
) -> OrderedMesh:
    """Optimises ``mesh`` as ``finetune`` does, drawn as web viewers and engines draw a `.glb` with an order:
    each triangle at its place in the list, where the side that it shows has it.

    Args:
        mesh: the mesh, with display blending and without a filter. Its colours are the plain ones, which do
            not depend on the view: viewers know no others.
        listing: the order, of ``drawing_order(mesh)``. It stays, but for triangles that are pruned.
        dataset, config, run, on_progress, changes: as in ``finetune``; ``order`` is 'file'.

    Raises as ``finetune``, and ValueError for the order of another mesh.
    """
    need(DrawOrder, listing=listing)
    need(SplatMesh, mesh=mesh)
    need(FinetuneConfig, config=config, optional=True)
    listing.listed(mesh.faces)
    changes["order"] = "file"
    config = with_changes(config or FinetuneConfig(), **changes)
    with claimed(run):
        loop = ready_loop(mesh.plain, dataset, config, run, listing=listing, on_progress=on_progress)
        tuned = loop.run()
    assert loop.phase.listing is not None
    return OrderedMesh(tuned, loop.phase.listing)
