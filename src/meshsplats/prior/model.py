"""MeshPrior: splats on a base mesh, that go where the base goes."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from meshsplats._arrays import checked_array
from meshsplats.base_mesh import BaseMesh
from meshsplats.mesh import SplatMesh

LIFT = 2e-5
"""Distance between two layers in exported meshes, as a share of the diagonal of the base's box: enough for
the float32 positions that ray tracers and engines compute with, too little to be seen."""


@dataclass(frozen=True, eq=False)
class MeshPrior:
    """A splat mesh whose vertices are bound to the faces of a base mesh.

    Moving the base moves the splats: ``pose`` computes them from new positions of the base's vertices, with
    no training. ``save_mesh(prior.mesh, path)`` keeps the binding in `.npz` and `.glb`; ``load_prior`` reads
    it back.
    """

    mesh: SplatMesh
    """As the base stands in ``mesh.binding``, with the base's normals as shading normals."""

    def __post_init__(self) -> None:
        if self.mesh.binding is None:
            raise ValueError(
                "the mesh is bound to no base; bind() makes a mesh prior, which .npz and .glb files keep"
            )

    @property
    def base_vertices(self) -> np.ndarray:
        """(n, 3) float32 positions of the base that the mesh is posed by."""
        assert self.mesh.binding is not None
        return self.mesh.binding.base_vertices

    @property
    def base_faces(self) -> np.ndarray:
        """(m, 3) int32 vertex numbers of the base."""
        assert self.mesh.binding is not None
        return self.mesh.binding.base_faces

    @property
    def lift(self) -> float:
        """Scene units from one layer to the next, below 0 inwards; 0: all lie in the base."""
        assert self.mesh.binding is not None
        return self.mesh.binding.lift

    @property
    def export_lift(self) -> float:
        """Scene units between two layers that exported meshes are given where the prior's own layers are
        coplanar: ``LIFT`` times the diagonal of the box round the base."""
        binding = self.mesh.binding
        assert binding is not None
        if binding.lift or not binding.layers.any():
            return binding.lift
        used = binding.base_vertices[binding.base_faces].reshape(-1, 3).astype(np.float64)
        return LIFT * float(np.linalg.norm(np.ptp(used, axis=0)))

    def pose(self, vertices: np.ndarray | None = None, *, lift: float | None = None) -> SplatMesh:
        """The splats on the base with its vertices at (n, 3) ``vertices``, the stored ones by default.

        Every vertex is the weighted sum of the new corners of its face, which layers above 0 have moved by
        ``lift`` (scene units) a layer along the new base's normals. By default that is the prior's own,
        scaled as the base is: by the square root of the ratio of its areas. Where it is 0, layers are
        coplanar, which this project's renderer draws in their order (``depth_group``); for other programs
        use ``export_lift``. Shading normals are the new base's. The binding in the result has the new base.

        Raises ValueError for another number of vertices, and for positions that are not finite.
        """
        binding = self.mesh.binding
        assert binding is not None
        places = binding.base_vertices
        if vertices is not None:
            places = checked_array("vertices", vertices, np.float32, (None, 3))
            if len(places) != len(binding.base_vertices):
                raise ValueError(
                    f"the base has {len(binding.base_vertices):,} vertices, got positions of {len(places):,}"
                )
        moved = binding.moved(places, binding.lift if lift is None else lift)
        if lift is None and binding.lift and binding.area > 0:
            moved = binding.moved(places, binding.lift * (moved.area / binding.area) ** 0.5)
        return replace(self.mesh, vertices=moved.positions(), normals=moved.normals(), binding=moved)

    def check_topology(self, base: BaseMesh) -> None:
        """ValueError that says what differs unless ``base`` has the same vertices in the same triangles."""
        wanted, found = self.base_faces, base.faces
        counts = (len(self.base_vertices), len(wanted)), (len(base.vertices), len(found))
        advice = "move its vertices only, and export them in their order, as .obj and .ply do"
        if counts[0] != counts[1]:
            raise ValueError(
                f"the edited base has {counts[1][0]:,} vertices and {counts[1][1]:,} triangles, the splats"
                f" are bound to one of {counts[0][0]:,} and {counts[0][1]:,}: {advice}"
            )
        differ = (wanted != found).any(axis=1)
        if differ.any():
            first = int(differ.argmax())
            raise ValueError(
                f"the edited base has other triangles ({int(differ.sum()):,} of {len(found):,}; the first is"
                f" number {first}, {found[first].tolist()} instead of {wanted[first].tolist()}): {advice}"
            )


def load_prior(path: str | os.PathLike[str]) -> MeshPrior:
    """The mesh prior in a `.npz` or `.glb` file.

    Raises what ``load_mesh`` raises, and ValueError for a mesh that is bound to no base.
    """
    from meshsplats.formats.meshes import load_mesh

    mesh = load_mesh(path)
    if mesh.binding is None:
        raise ValueError(
            f"{path}: the mesh is bound to no base; files that meshsplats prior wrote as .npz or .glb are"
        )
    return MeshPrior(mesh)
