"""Checkpoints: everything needed to resume a fine-tuning, in one safetensors file that is written atomically.

Arrays are named ``mesh.*``, ``positions.*``, ``colors.*``, ``exposure.*`` and ``usage.*``. The entry
``meshsplats`` of the file's metadata is a JSON text with the step, the time used, the configuration, and
fingerprints of the inputs.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.datasets.splat_targets import RenderedSplats
from meshsplats.datasets.views import Dataset
from meshsplats.errors import FileFormatError, OtherRunError
from meshsplats.finetuning.config import LENGTHS, FinetuneConfig, with_changes
from meshsplats.finetuning.loss import DEFAULT
from meshsplats.formats.safetensors import load_safetensors, save_safetensors
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh

VERSION = 1
_KEY = "meshsplats"
LONGEST = 1e10
"""Seconds that a run may have taken: three centuries."""
_REQUIRED = ("version", "step", "seconds", "config", "mesh", "dataset", "losses")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of a fine-tuning between two steps."""

    step: int
    """Number of steps taken."""
    seconds: float
    """Time used for them."""
    config: dict[str, Any]
    """``FinetuneConfig.to_dict``."""
    mesh: str
    """``mesh_fingerprint`` of the initial mesh."""
    dataset: str
    """``dataset_fingerprint`` of the views."""
    arrays: dict[str, np.ndarray]
    """Arrays of ``State``, by name."""
    losses: tuple[float, ...] = ()
    """Losses of the steps since the last line of the metrics."""
    planned: dict[str, Any] | None = None
    """The length that the run began with (``LENGTHS``), if it was made longer since; None: that of
    ``config``."""
    loss: str = DEFAULT
    """``loss_name`` of the run's. The name only: what it computes cannot be compared."""
    setup_seconds: float = 0.0
    """``Clock.setup_seconds``; 0 in checkpoints of earlier versions."""


def save_checkpoint(checkpoint: Checkpoint, path: str | Path) -> None:
    """Writes ``checkpoint`` to ``path``, atomically replacing an earlier one."""
    names = ("step", "seconds", "config", "mesh", "dataset", "losses", "planned", "loss", "setup_seconds")
    header = {name: getattr(checkpoint, name) for name in names}
    save_safetensors(path, checkpoint.arrays, {_KEY: json.dumps({"version": VERSION, **header})})


def load_checkpoint(path: str | Path, *, only_header: bool = False) -> Checkpoint:
    """Loads the checkpoint at ``path``; with ``only_header`` without its arrays.

    Raises FileNotFoundError if there is none, FileFormatError if it is broken, of another kind, or of a later
    version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}: leave out ``resume`` to begin anew")
    arrays, texts = load_safetensors(path, only_texts=only_header)
    try:
        header = json.loads(texts.get(_KEY, ""))
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or any(name not in header for name in _REQUIRED):
        raise FileFormatError(f"{path}: a safetensors file, but not a checkpoint of meshsplats")
    if header["version"] != VERSION:
        raise FileFormatError(
            f"{path}: a checkpoint of version {header['version']}, this program reads version {VERSION}"
        )
    step, seconds, config, losses = (header[name] for name in ("step", "seconds", "config", "losses"))
    planned, loss, setup = header.get("planned"), header.get("loss", DEFAULT), header.get("setup_seconds", 0)
    if (
        not isinstance(step, int)
        or step < 0
        or not isinstance(seconds, (int, float))
        or not 0 <= seconds < LONGEST
        or not isinstance(setup, (int, float))
        or not 0 <= setup <= seconds
        or not isinstance(config, dict)
        or not isinstance(losses, list)
        or not all(isinstance(loss, float) for loss in losses)
        or not isinstance(loss, str)
        or not (planned is None or (isinstance(planned, dict) and set(planned) <= set(LENGTHS)))
    ):
        raise FileFormatError(f"{path}: broken: step {step!r}, seconds {seconds!r}")
    fingerprints = str(header["mesh"]), str(header["dataset"])
    return Checkpoint(
        step, float(seconds), config, *fingerprints, arrays, tuple(losses), planned, loss, float(setup)
    )


def planned_length(checkpoint: Checkpoint) -> dict[str, Any]:
    """The length that the run of ``checkpoint`` began with, by the names in ``LENGTHS``."""
    if checkpoint.planned is not None:
        return checkpoint.planned
    return {name: checkpoint.config.get(name) for name in LENGTHS}


def as_begun(config: FinetuneConfig, earlier: Checkpoint | None) -> FinetuneConfig:
    """``config`` with the length that the run began with: one that is made longer keeps its views and its
    starting mesh."""
    return config if earlier is None else with_changes(config, **planned_length(earlier))


def check_same_run(
    found: Checkpoint, config: FinetuneConfig, mesh: str, dataset: str, loss: str = DEFAULT
) -> None:
    """Raises OtherRunError unless ``found`` has this configuration, these fingerprints of its inputs, and a
    loss of this name.

    The length may differ, so that a run can be extended.
    """
    current = config.to_dict()
    names = [name for name in current if name not in LENGTHS and found.config.get(name) != current[name]]
    if names:
        changes = ", ".join(
            f"{name} was {found.config.get(name)!r} and is {current[name]!r}" for name in names
        )
        raise OtherRunError(
            f"the checkpoint is of another configuration: {changes}; give the same options as before"
        )
    if found.loss != loss:
        raise OtherRunError(
            f"the checkpoint was made with the loss {found.loss}, this run has {loss}: give the same loss"
        )
    if found.mesh != mesh:
        raise OtherRunError(
            "the checkpoint began with another mesh: give the same input, and the same options of reading it,"
            " converting it, and of the views, for which it was made"
        )
    if found.dataset != dataset:
        raise OtherRunError(
            "the checkpoint was made with other views or images of other splats, or by an earlier"
            " meshsplats: give the same data set or splats and the same options of the views"
        )


@contextlib.contextmanager
def reading_arrays() -> Iterator[None]:
    """Turns what is wrong with a checkpoint's arrays into a FileFormatError."""
    try:
        yield
    except KeyError as error:
        raise FileFormatError(f"the checkpoint lacks {error}") from None
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"the checkpoint is broken: {error}") from None


def mesh_arrays(mesh: SplatMesh) -> dict[str, np.ndarray]:
    """The arrays of a mesh, by their names in a checkpoint."""
    arrays = mesh.arrays() | {"filter_px2": np.array(mesh.filter_px2)}
    return {f"mesh.{name}": a for name, a in arrays.items() if name not in ("blending", "order", "normals")}


def stored_mesh(arrays: dict[str, np.ndarray], blending: str, order: str) -> SplatMesh:
    """The mesh in a checkpoint's arrays. FileFormatError if an array is missing or does not fit."""
    own = {name.removeprefix("mesh."): a for name, a in arrays.items() if name.startswith("mesh.")}
    try:
        return SplatMesh.from_arrays(own | {"blending": np.array(blending), "order": np.array(order)})
    except KeyError as error:
        raise FileFormatError(f"the checkpoint lacks 'mesh.{error.args[0]}'") from None
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"the checkpoint's mesh is broken: {error}") from None


def mesh_fingerprint(mesh: SplatMesh, frozen: np.ndarray | None = None) -> str:
    """Hash of the positions, triangles, colours, harmonics, binding, blending, filter and order of ``mesh``,
    and of the mask of its ``frozen`` vertices."""
    digest = hashlib.sha256(mesh.blending.encode())
    if mesh.filter_px2:
        digest.update(repr(mesh.filter_px2).encode())
    if mesh.order != "fragment":
        digest.update(mesh.order.encode())
    if mesh.origin.any():
        digest.update(mesh.origin.tobytes())
    arrays = [mesh.vertices, mesh.faces, mesh.colors]
    if mesh.binding is not None:
        arrays += mesh.binding.given_fields().values()
    if mesh.harmonics is not None:
        arrays.append(mesh.harmonics)
    if frozen is not None:
        arrays.append(frozen)
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(array.data)
    return digest.hexdigest()


def dataset_fingerprint(dataset: Dataset) -> str:
    """Hash of the cameras, names and backgrounds of the views, the split, and the splats that images are
    rendered from, with their options. Image files are not read."""
    digest = hashlib.sha256(repr((len(dataset.train), len(dataset.test))).encode())
    if dataset.origin.any():
        digest.update(dataset.origin.tobytes())
    for view in dataset.views:
        camera = view.camera
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.width, camera.height)
        digest.update(repr((view.name, lens, view.background)).encode())
        digest.update(camera.world_to_camera.tobytes())
    rendered = [view.source for view in dataset.views if isinstance(view.source, RenderedSplats)]
    for source in rendered:
        degree = source.cloud.sh_degree if source.sh_degree is None else source.sh_degree
        digest.update(repr((source.look, degree, source.samples, source.cloud.kernel)).encode())
    for splats in {id(source.cloud): source.cloud for source in rendered}.values():
        _add_splats(digest, splats)
    return digest.hexdigest()


def cloud_digest(cloud: GaussianCloud) -> str:
    """Hash of all splats of ``cloud``."""
    digest = hashlib.sha256(cloud.kernel.encode())
    _add_splats(digest, cloud)
    return digest.hexdigest()


def _add_splats(digest: hashlib._Hash, splats: GaussianCloud) -> None:
    if splats.origin.any():
        digest.update(splats.origin.tobytes())
    for array in (splats.means, splats.quaternions, splats.scales, splats.opacities, splats.sh):
        digest.update(repr(array.shape).encode())
        digest.update(array.data)
