"""Checkpoints: everything a fine-tuning needs to go on, in one safetensors file that is whole or not there.

Arrays are named ``mesh.*``, ``positions.*``, ``colors.*`` and ``exposure.*``; the file's metadata holds,
under ``meshsplats``, a JSON text with the step, the time used, the configuration, and what the run was made
of.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats.binding import Binding
from meshsplats.dataset import Dataset, DrawnSplats
from meshsplats.errors import FileFormatError, MissingDependencyError
from meshsplats.finetuning.config import FinetuneConfig
from meshsplats.formats.atomic import atomic_path
from meshsplats.mesh import SplatMesh

VERSION = 1
_KEY = "meshsplats"
_BINDING = ("base_vertices", "base_faces", "vertex_face", "weights", "layers")
_REQUIRED = ("version", "step", "seconds", "config", "mesh", "dataset", "losses")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A fine-tuning between two steps."""

    step: int
    """Steps made."""
    seconds: float
    """Time used for them."""
    config: dict[str, Any]
    """``FinetuneConfig.to_dict``."""
    mesh: str
    """``fingerprint`` of the mesh that the run began with."""
    dataset: str
    """``fingerprint`` of the views."""
    arrays: dict[str, np.ndarray]
    losses: tuple[float, ...] = ()
    """Of the steps since the last line of the metrics."""


def save_checkpoint(checkpoint: Checkpoint, path: str | Path) -> None:
    """Writes ``checkpoint``, in place of an older one of that name once it is whole."""
    tensors = _safetensors()
    names = ("step", "seconds", "config", "mesh", "dataset", "losses")
    header = {name: getattr(checkpoint, name) for name in names}
    arrays = {name: np.array(array, order="C") for name, array in checkpoint.arrays.items()}
    with atomic_path(path, needs=sum(array.nbytes for array in arrays.values())) as temporary:
        metadata = {_KEY: json.dumps({"version": VERSION, **header})}
        tensors.numpy.save_file(arrays, temporary, metadata=metadata)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """The checkpoint at ``path``. FileFormatError if it is broken, of another kind, or of a later version;
    FileNotFoundError if there is none."""
    tensors = _safetensors()
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}: leave out --resume to begin anew")
    try:
        with tensors.safe_open(path, framework="numpy") as file:
            text = (file.metadata() or {}).get(_KEY)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no iterator)
    except OSError:
        raise
    except Exception as error:  # the reader's errors are of several kinds
        raise FileFormatError(f"{path}: not a checkpoint ({error})") from error
    try:
        header = json.loads(text or "")
    except ValueError:
        header = None
    if not isinstance(header, dict) or any(name not in header for name in _REQUIRED):
        raise FileFormatError(f"{path}: a safetensors file, but not a checkpoint of meshsplats")
    if header["version"] != VERSION:
        raise FileFormatError(
            f"{path}: a checkpoint of version {header['version']}, this program reads version {VERSION}"
        )
    step, seconds, config, losses = (header[name] for name in ("step", "seconds", "config", "losses"))
    if (
        not isinstance(step, int)
        or step < 0
        or not isinstance(seconds, (int, float))
        or not isinstance(config, dict)
        or not isinstance(losses, list)
        or not all(isinstance(loss, float) for loss in losses)
    ):
        raise FileFormatError(f"{path}: broken: step {step!r}, seconds {seconds!r}")
    made_of = str(header["mesh"]), str(header["dataset"])
    return Checkpoint(step, float(seconds), config, *made_of, arrays, tuple(losses))


def check_same_run(found: Checkpoint, config: FinetuneConfig, mesh: str, dataset: str) -> None:
    """ValueError, which says what differs, if ``found`` is not of the run with this configuration, mesh and
    data set (as fingerprints)."""
    wanted = config.to_dict()
    names = [name for name in wanted if found.config.get(name) != wanted[name]]
    if names:
        told = ", ".join(f"{name} was {found.config.get(name)!r} and is {wanted[name]!r}" for name in names)
        raise ValueError(
            f"the checkpoint is of another configuration: {told}; give the same options as before"
        )
    if found.mesh != mesh:
        raise ValueError(
            "the checkpoint began with another mesh: give the same input, and the same options of reading it,"
            " converting it, and of the views, for which it was made"
        )
    if found.dataset != dataset:
        raise ValueError(
            "the checkpoint was made with other views or pictures of other splats, or by an earlier"
            " meshsplats: give the same data set or splats and the same options of the views"
        )


def mesh_arrays(mesh: SplatMesh) -> dict[str, np.ndarray]:
    """The arrays of a mesh under the names that a checkpoint has for them."""
    arrays = {
        "mesh.vertices": mesh.vertices,
        "mesh.faces": mesh.faces,
        "mesh.colors": mesh.colors,
        "mesh.up": mesh.up,
    }
    for name in ("face_splat", "depth_group"):
        if getattr(mesh, name) is not None:
            arrays[f"mesh.{name}"] = getattr(mesh, name)
    if mesh.binding is not None:
        arrays |= {f"mesh.binding.{name}": getattr(mesh.binding, name) for name in _BINDING}
        arrays["mesh.binding.lift"] = np.array(mesh.binding.lift)
    return arrays | {f"mesh.attribute.{name}": value for name, value in mesh.attributes.items()}


def stored_mesh(arrays: dict[str, np.ndarray], blending: str) -> SplatMesh:
    """The mesh in a checkpoint's arrays. FileFormatError if something is missing or does not fit."""
    prefix = "mesh.attribute."
    try:
        binding = None
        if "mesh.binding.lift" in arrays:
            parts = {name: arrays[f"mesh.binding.{name}"] for name in _BINDING}
            binding = Binding(**parts, lift=float(arrays["mesh.binding.lift"]))
        return SplatMesh(
            arrays["mesh.vertices"],
            arrays["mesh.faces"],
            arrays["mesh.colors"],
            face_splat=arrays.get("mesh.face_splat"),
            depth_group=arrays.get("mesh.depth_group"),
            up=arrays["mesh.up"],
            blending=blending,  # type: ignore[arg-type]
            attributes={n[len(prefix) :]: a for n, a in arrays.items() if n.startswith(prefix)},
            binding=binding,
        )
    except KeyError as error:
        raise FileFormatError(f"the checkpoint lacks {error}") from None
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"the checkpoint's mesh is broken: {error}") from None


def mesh_fingerprint(mesh: SplatMesh) -> str:
    """Changes with every bit of positions, triangles, colours, binding and blending."""
    digest = hashlib.sha256(mesh.blending.encode())
    arrays = [mesh.vertices, mesh.faces, mesh.colors]
    if mesh.binding is not None:
        arrays += [getattr(mesh.binding, name) for name in _BINDING]
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(array.data)
    return digest.hexdigest()


def dataset_fingerprint(dataset: Dataset) -> str:
    """Changes with the cameras, names and backgrounds of the views, the splats that they are drawn from and
    how, and which are held out; pictures are not looked at."""
    digest = hashlib.sha256(repr((len(dataset.train), len(dataset.test))).encode())
    for view in dataset.views:
        camera = view.camera
        lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.width, camera.height)
        digest.update(repr((view.name, lens, view.background)).encode())
        digest.update(camera.world_to_camera.tobytes())
    drawn = [view.source for view in dataset.views if isinstance(view.source, DrawnSplats)]
    for source in drawn:
        degree = source.cloud.sh_degree if source.sh_degree is None else source.sh_degree
        digest.update(repr((degree, source.samples, source.cloud.kernel)).encode())
    for splats in {id(source.cloud): source.cloud for source in drawn}.values():
        for array in (splats.means, splats.quaternions, splats.scales, splats.opacities, splats.sh):
            digest.update(repr(array.shape).encode())
            digest.update(array.data)
    return digest.hexdigest()


def _safetensors():
    try:
        import safetensors
        import safetensors.numpy
    except ImportError as error:
        raise MissingDependencyError(
            "checkpoints need safetensors: pip install 'meshsplats[finetune]'"
        ) from error
    return safetensors
