"""MeshSplats as a renderer of MeshSplatBench: meshes of any file that ``load_mesh`` reads.

Register it with an entry point of the group ``msbench.adapters``, or import it before a command runs. A mesh
of ``finetune --opacity cutoff`` or ``save_mesh(alpha="opaque")`` is for the tier of plain engines: ``cutoff``
draws it as a depth buffer does.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from msbench.core.registry import register
from msbench.primitives.mesh_triangle import IndexedMeshTriangle
from msbench.renderers.base import RendererAdapter, RenderOutput

import meshsplats as ms

_SH_C0 = 0.28209479177387814


@register("meshsplats")
class MeshSplatsAdapter(RendererAdapter):
    """``samples``: of a pixel, a side; ``cutoff``: what is as opaque is drawn solid; None: blended."""

    def __init__(self, samples: int = 2, cutoff: float | None = None) -> None:
        self.samples, self.cutoff = samples, cutoff
        self.mesh: ms.SplatMesh | None = None
        self._checkpoint_path: str | None = None

    @property
    def name(self) -> str:
        return "meshsplats"

    def load_checkpoint(self, path: str) -> None:
        self.mesh, self._checkpoint_path = ms.load_mesh(path, origin=(0, 0, 0)), path

    def load_scene(self, dataset_path: str, split: str = "test") -> None:
        """Nothing: cameras come with each call of ``render``."""

    def model_stats(self) -> dict[str, Any]:
        mesh = self._loaded()
        size = os.path.getsize(self._checkpoint_path or "") / 2**20
        return {
            "primitive_count": len(mesh.faces),
            "vertex_count": len(mesh.vertices),
            "checkpoint_size_mb": size,
        }

    def render(self, cameras, *, mode: str = "eval") -> RenderOutput:
        if mode == "train":
            raise NotImplementedError("meshsplats.rasterize has gradients; this adapter draws only")
        images = [self._image(cameras, i) for i in range(len(cameras.viewmats))]
        rgb, alpha = (torch.from_numpy(np.stack(parts)) for parts in zip(*images, strict=True))
        if len(images) == 1:
            rgb, alpha = rgb[0], alpha[0]
        return RenderOutput(rgb=rgb, alpha=alpha, extras={"background_color": [0.0, 0.0, 0.0]})

    def to_primitive(self) -> IndexedMeshTriangle:
        mesh = self._loaded()
        vertices, faces = (
            torch.from_numpy(mesh.vertices.copy()),
            torch.from_numpy(mesh.faces.astype(np.int64)),
        )
        opacity = torch.from_numpy(mesh.colors[mesh.faces, 3].mean(axis=1))
        base = torch.from_numpy((mesh.plain.colors[:, :3] - 0.5) / np.float32(_SH_C0))
        return IndexedMeshTriangle(vertices, faces, opacity=opacity, sh_coeffs=base)

    def _image(self, cameras, i: int) -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 3) on black, and (h, w) alpha."""
        k = cameras.Ks[i].double().cpu().numpy()
        view = cameras.viewmats[i].double().cpu().numpy()
        size = int(cameras.width), int(cameras.height)
        camera = ms.Camera(view, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *size)
        drawn = ms.render(
            self._loaded(), camera, background=(0, 0, 0), samples=self.samples, cutoff=self.cutoff
        )
        return np.clip(drawn.color, 0, 1), drawn.alpha

    def _loaded(self) -> ms.SplatMesh:
        if self.mesh is None:
            raise RuntimeError("no mesh yet: load_checkpoint reads one")
        return self.mesh
