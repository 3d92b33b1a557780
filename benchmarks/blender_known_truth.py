"""Lit splats against the surface they were taken from, lit the same way, in Cycles.

    blender-env/bin/python benchmarks/blender_known_truth.py --data ../shared/data

Splats are sampled on Spot, a textured cow (Keenan Crane, public domain; meshes/spot_textured/spot in the data
folder): clean, noisy, with floaters and holes, and fine-tuned against the texture. They are drawn on the
ground under sun and sky, as ``meshsplats blender --lit`` draws them and, for comparison, with a plain diffuse
material. The table comes below Blender's own output; -o writes a strip of the images. Shadow overlap is
intersection over union of those pixels of the ground that are darker than 0.8 of the bare ground.

``--frames 40`` draws an orbit of that many frames instead, a degree apart, denoised, and prints how much a
pixel of the cow flickers: the RMS of half the difference between a frame and the mean of its neighbours, in
8-bit levels, of the textured mesh, of fine-tuned splats lit, and of the same unlit.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import Report, arguments
from PIL import Image

from meshsplats import Dataset, GaussianCloud, SplatMesh, View, convert, dome, finetune, orbit, render
from meshsplats.blender import LightOptions, SceneOptions, subject
from meshsplats.blender.linear import linear_colors
from meshsplats.datasets.views import ViewImage
from meshsplats.evaluation.metrics import psnr
from meshsplats.images.writing import save_image, strip
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.scene.gaussians import SH_C0

UP = np.array([0.0, 1.0, 0.0], np.float32)
SPLATS = 20_000
FINE = 3
"""Times that each triangle of the surface is split in four, for its images."""
STEPS = 300
KINDS = ("clean", "noisy", "faulty", "clean, fine-tuned", "noisy, fine-tuned", "faulty, fine-tuned")


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), texture coordinates (t, 2), and the indices of both at the corners (f, 3) of the
    triangles."""
    points, coordinates, corners = [], [], []
    for line in path.read_text().splitlines():
        kind, *values = line.split() or [""]
        if kind == "v":
            points.append([float(x) for x in values])
        elif kind == "vt":
            coordinates.append([float(x) for x in values])
        elif kind == "f":
            corners.append([[int(x) - 1 for x in corner.split("/")[:2]] for corner in values])
    indices = np.array(corners)
    return np.array(points), np.array(coordinates), indices[:, :, 0], indices[:, :, 1]


def sample(obj, texture: np.ndarray, kind: str) -> GaussianCloud:
    """Flat splats in the surface. In a "noisy" kind they are tilted by 20 degrees at random, moved by a third
    of their spacing, and of all opacities from 0.3 on. A "faulty" one has holes of two spacings, too, a
    twentieth of the splats, and as many faint grey floaters around."""
    noisy = "noisy" in kind or "faulty" in kind
    points, coordinates, faces, texture_faces = obj
    rng = np.random.default_rng(0)
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(cross, axis=1)
    # Even steps of area along the triangles, and a golden sequence across them.
    step = (np.arange(SPLATS) + 0.5) / SPLATS * area.sum()
    face = np.searchsorted(np.cumsum(area), step).clip(0, len(faces) - 1)
    root, other = np.sqrt(rng.random(SPLATS)), (np.arange(SPLATS) * 0.6180339887) % 1
    shares = np.stack([1 - root, root * (1 - other), root * other], axis=1)[:, :, None]
    vertex_normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(vertex_normals, faces[:, k], cross)
    normals = (vertex_normals[faces[face]] * shares).sum(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    means = (points[faces[face]] * shares).sum(axis=1)
    u, v = (coordinates[texture_faces[face]] * shares).sum(axis=1).T
    height, width = texture.shape[:2]
    colors = texture[((1 - v) * height).astype(int) % height, (u * width).astype(int) % width] / 255
    spacing = np.sqrt(area.sum() / SPLATS)
    opacities = np.full(SPLATS, 0.95)
    if noisy:
        means = means + normals * (spacing / 3 * rng.normal(size=(SPLATS, 1)))
        normals = normals + np.tan(np.radians(20)) / np.sqrt(2) * rng.normal(size=(SPLATS, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        opacities = rng.uniform(0.3, 1, SPLATS)
    # The rotation from +z to the normal: (1 + z, z x normal), normalised.
    quaternions = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(SPLATS)], axis=1)
    quaternions[normals[:, 2] < -0.999999] = [0, 1, 0, 0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    sigma = np.tile(spacing * np.array([0.75, 0.75, 0.03]), (SPLATS, 1))
    if "faulty" in kind:
        middles = means[rng.choice(SPLATS, SPLATS // 260, replace=False)]
        gone = np.zeros(SPLATS, bool)
        for middle in middles:
            gone |= np.square(means - middle).sum(axis=1) < (2 * spacing) ** 2
        means[gone] = rng.uniform(1.3 * points.min(axis=0), 1.3 * points.max(axis=0), (gone.sum(), 3))
        opacities[gone], colors[gone] = rng.uniform(0.02, 0.3, gone.sum()), 0.5
        sigma[gone] = spacing
    return GaussianCloud(means, quaternions, sigma, opacities, ((colors - 0.5) / SH_C0)[:, None])


def fine_tuned(mesh: SplatMesh, obj, texture: np.ndarray) -> SplatMesh:
    """The splats of ``mesh`` trained on unlit images of the textured surface, as those of captures are."""
    points, coordinates, faces, texture_faces = obj
    corners = np.concatenate([points[faces], coordinates[texture_faces]], axis=2)
    for _ in range(FINE):  # each triangle becomes four
        a, b, c = corners.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate(
            [np.stack(four, axis=1) for four in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    height, width = texture.shape[:2]
    u, v = corners[..., 3], corners[..., 4]
    colors = texture[((1 - v) * height).astype(int) % height, (u * width).astype(int) % width] / 255
    rgba = np.concatenate([colors, np.ones_like(colors[..., :1])], axis=2).reshape(-1, 4)
    surface = SplatMesh(
        corners[..., :3].reshape(-1, 3).astype(np.float32),
        np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        rgba.astype(np.float32),
    )
    views = []
    for camera in dome(mesh, 48, whole=True, up=UP, width=400, height=400):
        drawn = render(surface, camera, background=(0, 0, 0), samples=2)
        views.append(View(camera, ViewImage(drawn.color, drawn.alpha)))
    return replace(finetune(mesh, Dataset(views), steps=STEPS), up=UP)


def add_truth(obj, texture: Path, like) -> None:
    """The textured mesh, smooth, where the splat object ``like`` is."""
    from meshsplats.blender.inside import meshes, versions
    from meshsplats.blender.inside.host import bpy

    points, coordinates, faces, texture_faces = obj
    data = meshes.make_plain("Truth", points, faces)
    data.update(calc_edges=True)
    layer = data.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", coordinates[texture_faces].astype(np.float32).ravel())
    data.shade_smooth()
    material = bpy.data.materials.new("Truth")
    tree = versions.node_tree(material)
    texture_node, surface, out = (
        tree.nodes.new(f"ShaderNode{kind}") for kind in ("TexImage", "BsdfDiffuse", "OutputMaterial")
    )
    texture_node.image = bpy.data.images.load(str(texture))
    tree.links.new(texture_node.outputs["Color"], surface.inputs["Color"])
    tree.links.new(surface.outputs[0], out.inputs["Surface"])
    data.materials.append(material)
    target = bpy.data.objects.new("Ground truth", data)
    target.matrix_world = like.matrix_world
    bpy.context.scene.collection.objects.link(target)


def shot(scene) -> np.ndarray:
    """The linear image of the camera of a Blender scene."""
    from meshsplats.blender.inside import rendering

    with tempfile.TemporaryDirectory() as scratch:
        rendering.render_to(scene, Path(scratch) / "image.exr")
        return rendering.read_pixels(Path(scratch) / "image.exr")[..., :3]


def display(image: np.ndarray) -> np.ndarray:
    return linear_to_srgb(np.clip(image, 0, 1))


def flicker(
    report: Report, obj, texture: np.ndarray, folder: Path, asked: argparse.Namespace, options: SceneOptions
) -> None:
    from meshsplats.blender.inside import scene, stage

    mesh = fine_tuned(replace(convert(sample(obj, texture, "clean"), mode="flat"), up=UP), obj, texture)
    size = {"width": asked.width, "height": asked.width * 3 // 4, "distance": 1.3}
    views = [orbit(mesh, 1, elevation=25, azimuth=215 + i, **size)[0] for i in range(asked.frames)]
    layers, limit = subject.count(mesh, views[:1], options)
    arrays, facts = subject.prepare(mesh, views, options, layers)
    drawn = {}
    for name in ("textured mesh", "splats, --lit"):
        made = scene.build(scene.Subject(**arrays, **facts), views, options, limit, edges=False)
        if name == "textured mesh":
            made.obj.hide_render = True
            for child in made.obj.children:
                child.hide_render = True
            add_truth(obj, folder / "spot_texture.png", made.obj)
        frames = []
        for i, (view, camera) in enumerate(zip(views, made.cameras, strict=True)):
            made.scene.frame_set(i)
            stage.aim(made.scene, view, camera)
            frames.append(display(shot(made.scene)))
        drawn[name] = np.stack(frames)
    drawn["splats, unlit"] = np.stack([render(mesh, view, samples=4).color for view in views])
    cow = np.stack([render(mesh, view).alpha > 0.98 for view in views])
    inside = cow[1:-1] & cow[:-2] & cow[2:]
    report.table("", "flicker of the cow")
    for name, frames in drawn.items():
        change = (frames[1:-1] - (frames[:-2] + frames[2:]) / 2) / 2
        report.row(name, f"{255 * np.sqrt(np.square(change[inside]).mean()):.2f}")
    if asked.output is not None:
        shown = [frames[0] for frames in drawn.values()]
        save_image(asked.output, strip(shown, list(drawn)))


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--samples", type=int, default=48)
    parser.add_argument("-o", "--output", type=Path, help="image of all: a .png")
    parser.add_argument("--frames", type=int, help="draw an orbit and print flicker")
    asked = parser.parse_args()
    folder = asked.data / "meshes" / "spot_textured" / "spot"
    obj = read_obj(folder / "spot_triangulated.obj")
    texture = np.asarray(Image.open(folder / "spot_texture.png").convert("RGB"))
    light = LightOptions(sun=(130, 40))
    with Report(asked) as report:
        if asked.frames:
            options = SceneOptions(light=light, samples=asked.samples, denoise=True)
            flicker(report, obj, texture, folder, asked, options)
        else:
            compare(report, obj, texture, folder, asked, SceneOptions(light=light, samples=asked.samples))


def compare(
    report: Report, obj, texture: np.ndarray, folder: Path, asked: argparse.Namespace, options: SceneOptions
) -> None:
    from meshsplats.blender.inside import scene
    from meshsplats.blender.inside.host import bpy

    height = asked.width * 3 // 4
    view = None
    shown, captions = [], []
    rows = []
    target = ground = None
    for kind in KINDS:
        mesh = replace(convert(sample(obj, texture, kind), mode="flat"), up=UP)
        if "tuned" in kind:
            mesh = fine_tuned(mesh, obj, texture)
        if view is None:
            view = orbit(mesh, 1, elevation=25, azimuth=215, width=asked.width, height=height, distance=1.3)[
                0
            ]
        layers, limit = subject.count(mesh, [view], options)
        arrays, facts = subject.prepare(mesh, [view], options, layers)
        if target is None:
            bare = replace(scene.Subject(**arrays, **facts), surface_vertices=None)
            made = scene.build(bare, [view], options, limit, edges=False)
            made.obj.hide_render = True
            ground = shot(made.scene)
            add_truth(obj, folder / "spot_texture.png", made.obj)
            target = shot(made.scene)
            shown.append(display(target))
            captions.append("textured mesh")
        covered = render(mesh, view).alpha
        floor = (covered < 0.02) & (ground.mean(axis=2) > 0.05)
        shade = (target.mean(axis=2) < 0.8 * ground.mean(axis=2)) & floor
        for material in ("plain diffuse", "--lit"):
            taken = scene.Subject(**arrays, **facts)
            if material == "plain diffuse":
                plain = linear_colors(mesh, steps=0)
                taken = replace(
                    taken,
                    colors=plain,
                    normals=None,
                    faces=mesh.faces,
                    self_shadow=0.0,
                    surface_vertices=None,
                )
            drawn = shot(scene.build(taken, [view], options, limit, edges=False).scene)
            dark = (drawn.mean(axis=2) < 0.8 * ground.mean(axis=2)) & floor
            cow = covered > 0.98
            rows.append(
                (
                    kind,
                    material,
                    f"{psnr(display(drawn), display(target)):.1f} dB",
                    f"{psnr(display(drawn), display(target), mask=cow):.1f} dB",
                    f"{(dark & shade).sum() / max((dark | shade).sum(), 1):.2f}",
                    f"{drawn[cow].mean() / target[cow].mean():.2f}",
                )
            )
            shown.append(display(drawn))
            captions.append(f"{kind}, {material}")
    report.say(f"Blender {bpy.app.version_string}, {asked.width} x {height}, {asked.samples} samples")
    report.table(
        "splats", "material", "PSNR, image", "PSNR, cow alone", "shadow overlap", "light, of the mesh's"
    )
    for row in rows:
        report.row(*row)
    if asked.output is not None:
        save_image(asked.output, strip(shown, captions))


if __name__ == "__main__":
    main()
