"""Images and scenes of splat meshes by Blender: exact, or lit with shadows, mirrors and glass.

Blender runs as a process of its own, as the module bpy of this environment or as an installed program.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats._common.lazy import lazy_names
from meshsplats.blender.levels import LevelMeshes
from meshsplats.blender.options import MAX_LAYERS, Engine, Ground, LightOptions, SceneOptions
from meshsplats.errors import DataWarning
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.blender.launch import BlenderError, Job, Progress
    from meshsplats.blender.plan import Schedule

__all__ = [
    "BlenderError",
    "Engine",
    "Ground",
    "LevelMeshes",
    "LightOptions",
    "Progress",
    "SceneOptions",
    "draw",
]


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__, {"meshsplats.blender.launch": ("BlenderError", "Progress")})


def draw(
    mesh: SplatMesh | LevelMeshes,
    cameras: Sequence[Camera],
    *,
    images: Sequence[str | os.PathLike[str]] = (),
    blend: str | os.PathLike[str] | None = None,
    options: SceneOptions | None = None,
    executable: str | os.PathLike[str] | None = None,
    announce: Callable[[dict[str, Any]], object] | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> dict[str, Any]:
    """Has Blender render ``mesh`` from ``cameras``, or save the scene, or both; existing files are replaced.

    Unlit (``options.light`` None), Cycles renders what ``meshsplats.render`` does: an .exr holds
    ``Rendering.color``, in the space of the mesh's colours, a .png display values (those of a mesh with
    linear ``blending`` are sRGB-encoded). A mesh with a filter gets it baked for all cameras at once
    (``bake_filter``). Lit, colours are converted to linear light; an .exr holds that, a .png shows it through
    Blender's view transform Standard (sRGB).

    Args:
        mesh: what to render; a chain of levels of detail for a .blend, in which one is visible at a time.
        cameras: at least one for images; in a .blend, each is a camera and a frame of the timeline.
        images: .png (8 bits) or .exr (32 bits) to write, one per camera.
        blend: Blender file to write: mesh, material, cameras, light, world, in named collections.
        options: unlit in Cycles by default.
        executable: an installed Blender, 4.2 or newer; the module bpy of this environment by default.
        announce: called once before Blender starts, with the size of the work: ``{"triangles", "layers",
            "bounce_limit", "samples" per pixel, "pixels" of all images, "mean_layers" of a pixel,
            "harmonics": terms of view-dependent colours}``.
        progress: called whenever Blender reports progress.

    Returns:
        ``{"blender": its version, "build_seconds": float, "image_seconds": [float, ...], "layers": most
        layers behind each other, "bounce_limit": int}``, and as ``build_processor_seconds`` and
        ``image_processor_seconds`` the processor time of all threads.

    Raises:
        ValueError: options out of range, another suffix, images that do not match the cameras, an empty
        mesh, images of a chain.
        MissingDependencyError: neither bpy nor an executable, or no OpenGL libraries for EEVEE.
        OSError: a folder is not writable; raised before the work.
        BlenderError: Blender failed; the message quotes it.

    Warns with a DataWarning if more layers lie behind each other than Blender can follow (1024).
    """
    from meshsplats.blender import launch

    options = options or SceneOptions()
    options.check()
    targets = [Path(path) for path in images]
    for path in targets:
        if path.suffix.lower() not in (".png", ".exr"):
            raise ValueError(f"{path.name!r}: Blender's images end in .png or .exr")
    if blend is not None and Path(blend).suffix.lower() != ".blend":
        raise ValueError(f"{Path(blend).name!r}: a Blender file ends in .blend")
    if targets and len(targets) != len(cameras):
        raise ValueError(f"{len(targets)} images for {len(cameras)} cameras: expected one per camera")
    chain = mesh if isinstance(mesh, LevelMeshes) else LevelMeshes("Splats", (mesh,), (0,))
    if targets and len(chain.meshes) > 1:
        raise ValueError("a chain of levels of detail makes a .blend; for images, give one mesh of it")
    if any(len(level.faces) == 0 for level in chain.meshes):
        raise ValueError("the mesh has no triangles: there is nothing to draw")
    _check_folders([*targets, *([] if blend is None else [Path(blend)])])
    with launch.begun(
        options,
        images=targets,
        blend=None if blend is None else Path(blend),
        executable=None if executable is None else Path(executable),
    ) as job:
        return _drawn(job, chain, cameras, len(targets), options, announce, progress)


def _drawn(
    job: Job,
    chain: LevelMeshes,
    cameras: Sequence[Camera],
    images: int,
    options: SceneOptions,
    announce: Callable[[dict[str, Any]], object] | None,
    progress: Callable[[Progress], object] | None,
) -> dict[str, Any]:
    from meshsplats.blender import launch, plan, subject

    meshes = [_without_filter(level, cameras) for level in chain.meshes]
    counted = [subject.count(level, cameras, options) for level in meshes]
    layers, limit = max(counted)
    finest = meshes[0]
    cameras = [camera.with_near_plane(finest.vertices) for camera in cameras]
    if layers > MAX_LAYERS:
        _warn(meshes[counted.index((layers, limit))], cameras, layers, options)
    tell: Callable[[Progress], object] | None = None
    if announce is not None or progress is not None:
        samples = options.samples if options.light is not None else options.samples**2
        mean, mean_square = subject.layer_means(finest, cameras, options.threads)
        ahead = {
            "triangles": len(finest.faces),
            "layers": layers,
            "bounce_limit": limit,
            "samples": samples,
            "pixels": sum(camera.width * camera.height for camera in cameras[:images]),
            "mean_layers": mean,
            "mean_square_layers": mean_square,
            "harmonics": 0 if finest.harmonics is None else finest.harmonics.shape[1],
        }
        if announce is not None:
            announce(ahead)
        if progress is not None:
            tell = partial(_tell, plan.Schedule(ahead, options), progress)

    def begin(phase: str) -> None:
        if tell is not None:
            tell(launch.Progress(0, images, 0.0, phase, None))

    subjects = []
    for level, size in zip(meshes, chain.screen_sizes, strict=True):
        arrays, facts = subject.prepare(level, cameras, options, layers, begin)
        subjects.append((arrays, facts | {"name": chain.name, "screen_size": size}))
    result = job.run(subjects, cameras, limit=limit, progress=tell)
    return result | {"layers": layers, "bounce_limit": limit}


def _tell(schedule: Schedule, progress: Callable[[Progress], object], at: Progress) -> None:
    progress(schedule.with_time(at))


def _without_filter(mesh: SplatMesh, cameras: Sequence[Camera]) -> SplatMesh:
    if not mesh.filter_px2:
        return mesh
    from meshsplats.conversion import bake_filter

    return bake_filter(mesh, cameras)


def _check_folders(paths: Iterable[Path]) -> None:
    """Raises OSError for a folder in which no file can be created; permissions alone do not show that."""
    for folder in {path.absolute().parent for path in paths}:
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise type(error)(
                error.errno, f"cannot write in the folder: {error.strerror}", str(folder)
            ) from None


def _warn(mesh: SplatMesh, cameras: Sequence[Camera], layers: int, options: SceneOptions) -> None:
    if options.engine == "eevee":  # counts no bounces
        return
    from meshsplats.blender.layers import hidden_by_limit

    shares = [hidden_by_limit(mesh, camera, threads=options.threads) for camera in cameras[:8]]
    share = float(np.max(shares)) if shares else 0.0
    if share < 5e-5:  # would read 0.00 %
        return
    warnings.warn(
        f"up to {layers} transparent triangles overlap, and Cycles has at most {MAX_LAYERS} transparent"
        f" bounces: deeper ones are black ({share:.2%} of the pixels of a view are affected); use fewer"
        " triangles (--max-triangles on conversion) or a smaller part",
        DataWarning,
        stacklevel=4,
    )
