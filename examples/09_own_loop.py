"""A loop of your own: mesh and camera poses optimised, and pruned, with the renderer as a torch operator.

python examples/09_own_loop.py [steps]      Needs torch. Writes into example-output/.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning.adam import RowAdam
from meshsplats.rendering.autograd import rasterize

out = Path("example-output")
out.mkdir(exist_ok=True)
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 48

# Images of splats with their cameras, and the initial mesh.
cloud = make_scene()
data = ms.splat_dataset(cloud, train=12, test=4, width=96, sh_degree=0)
mesh = ms.convert(cloud, mode="flat", cameras=[view.camera for view in data.train])

# The camera poses are only roughly known: each is perturbed by a twist of six parameters.
turns = torch.zeros(6, 4, 4, dtype=torch.float64)
for k, (i, j) in enumerate([(2, 1), (0, 2), (1, 0)]):
    turns[k, i, j], turns[k, j, i] = 1, -1
    turns[3 + k, k, 3] = 1
true = torch.from_numpy(np.stack([view.camera.world_to_camera for view in data.train]))
noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.01, (len(data.train), 6)))
known = torch.linalg.matrix_exp(torch.einsum("bk,kij->bij", noise, turns)) @ true
twists = torch.zeros(len(data.train), 6, dtype=torch.float64, requires_grad=True)


def poses() -> torch.Tensor:
    return torch.linalg.matrix_exp(torch.einsum("bk,kij->bij", twists, turns)) @ known


def degrees_off() -> float:
    turned = poses().detach()[:, :3, :3] @ true[:, :3, :3].transpose(1, 2)
    cosines = (turned.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return float(torch.rad2deg(torch.arccos(cosines.clamp(-1, 1))).mean())


def loss_of(raster, view: ms.View) -> torch.Tensor:
    """Charbonnier loss of the colours, and L1 of the silhouettes."""
    color, alpha = torch.from_numpy(view.image), torch.from_numpy(view.alpha)
    near = torch.sqrt((raster.color - color).square() + 1e-4).mean()
    return near + 0.2 * (raster.alpha - alpha).abs().mean()


def leaves(of: ms.SplatMesh) -> list[torch.Tensor]:
    return [torch.from_numpy(array.copy()).requires_grad_() for array in (of.vertices, of.colors)]


def visible_pixels(vertices: torch.Tensor, colors: torch.Tensor) -> np.ndarray:
    """(v,) visible pixels of each vertex over all views: the gradient of the images of another attribute."""
    attribute = torch.zeros(len(vertices), 1, requires_grad=True)
    pixels = torch.zeros(len(vertices))
    with torch.no_grad():
        now = poses().float()
    for view, pose in zip(data.train, now, strict=True):
        values = torch.cat([colors.detach(), attribute], dim=1)
        options = {"world_to_camera": pose, "face_splat": mesh.face_splat}
        drawn = rasterize(vertices.detach(), mesh.faces, values, view.camera, **options)
        pixels += torch.autograd.grad(drawn.attributes.sum(), attribute)[0][:, 0]
    return pixels.numpy()


vertices, colors = leaves(mesh)
# Adam on the rows with gradients in a view, and torch's own for the cameras.
moving = RowAdam(vertices, lr=2e-4, betas=(0.5, 0.9), eps=1e-15)
painting = RowAdam(colors, lr=0.02, betas=(0.5, 0.9), eps=1e-15, bounds=(0, 1))
aiming = torch.optim.Adam([twists], lr=1e-3)
before, first, triangles = ms.evaluate(mesh, data).methods[0].mean("psnr"), degrees_off(), len(mesh.faces)
for step in range(steps):
    index = step % len(data.train)
    view = data.train[index]
    pose = poses()[index].float()
    raster = rasterize(
        vertices, mesh.faces, colors, view.camera, world_to_camera=pose, face_splat=mesh.face_splat
    )
    loss = loss_of(raster, view)
    moves, paints, twists.grad = torch.autograd.grad(loss, [vertices, colors, twists])
    reached = paints[:, 3] != 0
    moving.step(moves, reached)
    painting.step(paints, reached)
    aiming.step()
    if step == steps // 2:
        # Prune triangles that are hardly visible, and their vertices in the optimisers.
        mesh = replace(mesh, vertices=vertices.detach().numpy(), colors=colors.detach().numpy())
        keep = visible_pixels(vertices, colors)[mesh.faces].sum(axis=1) > 0.2
        rows = np.flatnonzero(mesh.vertices_of(keep))
        mesh = mesh.take(keep)
        vertices, colors = leaves(mesh)
        moving, painting = moving.select(vertices, rows), painting.select(colors, rows)

mesh = replace(mesh, vertices=vertices.detach().numpy(), colors=colors.detach().numpy())
after = ms.evaluate(mesh, data).methods[0].mean("psnr")
ms.save_mesh(mesh, out / "own_loop.npz")
print(f"cameras: off by {first:.2f} degrees, after {steps} steps by {degrees_off():.2f}")
print(f"held out: {before:.1f} -> {after:.1f} dB, {triangles:,} -> {len(mesh.faces):,} triangles")
print(out / "own_loop.npz")
