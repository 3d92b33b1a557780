"""Any ray tracer renders a splat mesh: here Mitsuba 3, with sun, sky and ground.

python examples/mitsuba/render.py [splats.ply | mesh.npz] [-o image.exr] [--width 320] [--samples 64]

Without a file: the demo scene. Writes example-output/mitsuba.exr (linear light) and a .png. Needs mitsuba
(pip install mitsuba). The variant scalar_rgb runs everywhere; llvm_ad_rgb is several times quicker where a
recent LLVM library is installed.

A ray tracer needs the linear colour of each vertex as reflectance, its opacity as a mask, and shadow rays
that pass through translucent layers, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

import meshsplats as ms
from meshsplats.cameras.framing import front_axes, scene_bounds
from meshsplats.demo_scene import make_scene
from meshsplats.scene.colors import srgb_to_linear

SUN, SUN_STRENGTH, SUN_SIZE, SKY, GROUND = (-50.0, 45.0), 2.5, 2.0, 0.35, 0.6
"""As in meshsplats.blender.LightOptions: azimuth and elevation, W/m^2, degrees, radiance; reflectance."""


def make_shape(mesh: ms.SplatMesh) -> mi.Mesh:
    """``mesh`` as a Mitsuba shape: a diffuse surface of its colours, masked by its opacities."""
    colors = mesh.colors[:, :3] if mesh.blending == "linear" else srgb_to_linear(mesh.colors[:, :3])
    surface = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    material = {
        "type": "mask",
        "opacity": {"type": "mesh_attribute", "name": "vertex_opacity"},
        "bsdf": {"type": "twosided", "bsdf": surface},
    }
    settings = mi.Properties()
    settings["bsdf"] = mi.load_dict(material)
    settings["face_normals"] = True
    shape = mi.Mesh("splats", len(mesh.vertices), len(mesh.faces), settings)
    shape.add_attribute("vertex_color", 3, np.ascontiguousarray(colors, np.float32).ravel())
    shape.add_attribute("vertex_opacity", 1, np.ascontiguousarray(mesh.colors[:, 3], np.float32))
    values = mi.traverse(shape)
    values["vertex_positions"] = mesh.vertices.ravel()
    values["faces"] = mesh.faces.ravel().astype(np.uint32)
    values.update()
    return shape


def make_sensor(camera: ms.Camera, samples: int, points: np.ndarray) -> dict:
    """``camera`` for Mitsuba, whose cameras have x to the left and y up. Any principal point will do."""
    to_world = np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))),
        "principal_point_offset_x": camera.cx / camera.width - 0.5,
        "principal_point_offset_y": camera.cy / camera.height - 0.5,
        "near_clip": camera.near_plane(points),
        "far_clip": 1e7 * camera.near_plane(points),
        "to_world": mi.ScalarTransform4f(to_world),
        "sampler": {"type": "independent", "sample_count": samples},
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }


def make_scene_of(
    mesh: ms.SplatMesh, camera: ms.Camera, samples: int, floor: float | None = None
) -> mi.Scene:
    """``mesh`` under sun and sky on a ground ``floor`` scene units up (by default its own lowest part)."""
    if camera.fx != camera.fy:
        raise ValueError("Mitsuba's cameras have square pixels: fx and fy must be the same")
    right, up, forward = front_axes(mesh.up.astype(np.float64))
    azimuth, elevation = np.radians(SUN)
    level = np.sin(azimuth) * right - np.cos(azimuth) * forward
    to_sun = np.cos(elevation) * level + np.sin(elevation) * up
    bounds = scene_bounds(mesh)
    height = float((mesh.vertices @ up).min()) if floor is None else floor
    foot = bounds.center + (height - bounds.center @ up) * up
    # A rectangle in Mitsuba spans -1 to 1 in x and y and faces z.
    ground = np.eye(4)
    ground[:3, :3] = 100 * bounds.radius * np.stack([right, -forward, up], axis=1)
    ground[:3, 3] = foot
    # The sun: a bright cone of the sky, of the same irradiance as a far disc.
    half = np.radians(SUN_SIZE / 2)
    far = 1000 * bounds.radius
    disc = np.eye(4)
    across = np.cross(to_sun, up)
    across /= np.linalg.norm(across)
    size = far * np.tan(half)
    disc[:3, :3] = np.stack([size * across, size * np.cross(-to_sun, across), -to_sun], axis=1)
    disc[:3, 3] = bounds.center + far * to_sun
    radiance = SUN_STRENGTH / (np.pi * np.sin(half) ** 2)
    return mi.load_dict(
        {
            "type": "scene",
            # volpath traces shadow rays through layers, which path takes for opaque.
            "integrator": {"type": "volpath", "max_depth": 4, "rr_depth": 1000},
            "sensor": make_sensor(camera, samples, mesh.vertices),
            "splats": make_shape(mesh),
            "ground": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f(ground),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": GROUND}},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY}},
            "sun": {
                "type": "disk",
                "to_world": mi.ScalarTransform4f(disc),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": float(radiance)}},
            },
        }
    )


def main() -> None:
    arguments = argparse.ArgumentParser(description="Draws splats, or a mesh made of them, with Mitsuba 3.")
    arguments.add_argument("input", nargs="?", help="a splat file or a mesh; the demo scene without one")
    arguments.add_argument("-o", "--output", type=Path, default=Path("example-output/mitsuba.exr"))
    arguments.add_argument("--width", type=int, default=320)
    arguments.add_argument("--samples", type=int, default=64)
    arguments.add_argument("--variant", default="scalar_rgb", help="a variant of Mitsuba")
    asked = arguments.parse_args()
    mi.set_variant(asked.variant)
    asked.output.parent.mkdir(exist_ok=True)
    if asked.input is None:
        mesh = ms.convert(make_scene(), mode="flat")
    elif Path(asked.input).suffix in (".npz", ".glb"):
        mesh = ms.load_mesh(asked.input)
    else:
        mesh = ms.convert(ms.load_gaussians(asked.input), mode="flat")
    height = asked.width * 3 // 4
    camera = ms.orbit(mesh, 1, elevation=20, width=asked.width, height=height, distance=1.3)[0]
    image = mi.render(make_scene_of(mesh, camera, asked.samples))
    mi.util.write_bitmap(str(asked.output), image)
    shown = asked.output.with_suffix(".png")
    mi.util.write_bitmap(str(shown), image)
    print(f"{asked.output}, {shown}: {len(mesh.faces):,} triangles by Mitsuba {mi.__version__}")


if __name__ == "__main__":
    main()
