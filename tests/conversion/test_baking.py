"""The filter of a mesh as a part of its triangles."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from _rendering import assert_close, camera, splats
from test_fan_filter import covariance, fans

from meshsplats import (
    DataWarning,
    SplatMesh,
    bake_filter,
    convert,
    load_mesh,
    orbit,
    plain_colors_of,
    render,
    save_mesh,
)
from meshsplats.cli import main
from meshsplats.demo_scene import make_scene


def one_splat(mode: str, quaternion=(1, 0, 0, 0), **options) -> SplatMesh:
    cloud = replace(
        splats(0, 1, degree=0, opacity=0.01),
        means=np.array([[0.5, 0.2, 60.0]], np.float32),
        quaternions=np.array([quaternion], np.float32),
        scales=np.array([[1.2, 0.5, 0.45]], np.float32),
    )
    return convert(cloud, footprint="filter", mode=mode, shrink_faint=False, min_opacity=0, **options)


@pytest.mark.parametrize("mode", ["flat", "crossed", "3d"])
@pytest.mark.parametrize("turn", [(1, 0, 0, 0), (1, 1, 0, 0)])
def test_each_axis_grows_by_the_pixel(mode, turn):
    """Seen along an axis, from where it was baked for: the variances on the image grow by the filter's."""
    if mode == "flat" and turn[1]:
        turn = (1, 0, 0, 1)  # not edge on
    view = camera(160, 160, fx=600.0, fy=600.0)
    mesh = one_splat(mode, np.array(turn) / np.linalg.norm(turn))
    _, before = covariance(render(mesh, view, samples=4, filter_px2=0).alpha)
    for s in (4.0, 60.0):
        for given in ({"cameras": [view]}, {"pixel": 60 / 600}):
            baked = bake_filter(mesh, filter_px2=s, **given)
            _, after = covariance(render(baked, view, samples=4).alpha)
            np.testing.assert_allclose(after, before + s * np.eye(2), atol=0.03 * (s + before.max()))


def test_as_the_renderer_filters():
    """One view of one size: the baked mesh looks there as the filter draws it. Flat splats alone differ, seen
    edge on, where they have no side to be made wider."""
    mesh, view = fans(2, 40, "3d", sizes=(0.05, 0.3), z=6.0), camera(60, 50)
    baked = bake_filter(mesh, [view])
    assert baked.filter_px2 == 0
    drawn, plain = render(mesh, view), render(mesh, view, filter_px2=0)
    far, near = (np.abs(image.color - drawn.color).mean() for image in (plain, render(baked, view)))
    assert near < 0.3 * far
    assert_close(render(baked, view), render(baked, view, filter_px2=0), flips=0)


def test_flat_splats_stay_flat():
    cloud = replace(splats(3, 1, degree=0), quaternions=np.array([[1, 0, 0, 0]], np.float32))
    mesh = convert(cloud, footprint="filter", mode="flat", min_opacity=0)
    baked = bake_filter(mesh, pixel=5.0)
    flat = np.argmin(np.ptp(mesh.vertices, axis=0))
    assert np.ptp(baked.vertices[:, flat]) < 1e-5
    assert np.ptp(baked.vertices, axis=0).max() > 3 * np.ptp(mesh.vertices, axis=0).max()


def test_by_default_for_images_of_the_whole():
    mesh = fans(4, 300, sizes=(0.001, 0.01))
    views = orbit(mesh, 6, width=1000, height=1000)
    assert bake_filter(mesh).vertices.tobytes() == bake_filter(mesh, views).vertices.tobytes()


def test_what_is_kept_and_what_is_refused():
    mesh = replace(fans(5, 20), attributes={"a": np.arange(20 * 9.0)})
    baked = bake_filter(mesh, pixel=0.1)
    assert baked.faces is mesh.faces
    assert baked.colors is mesh.colors
    assert baked.attributes["a"] is mesh.attributes["a"]
    plain = replace(mesh, filter_px2=0)
    assert bake_filter(plain, pixel=0.1).vertices.tobytes() == plain.vertices.tobytes()
    stray = replace(mesh, faces=mesh.faces[8:], face_splat=mesh.face_splat[8:])
    assert (bake_filter(stray, pixel=0.1).vertices[:9] == mesh.vertices[:9]).all()
    with pytest.raises(ValueError, match="not both"):
        bake_filter(mesh, [camera()], pixel=0.1)
    for pixel in (0, -1, float("nan")):
        with pytest.raises(ValueError, match="pixel must be a size"):
            bake_filter(mesh, pixel=pixel)
    away = camera(world_to_camera=np.diag([1.0, -1, -1, 1]))
    with pytest.raises(ValueError, match="none of the 1 cameras sees any splat"):
        bake_filter(replace(mesh, vertices=mesh.vertices + np.float32([0, 0, 50])), [away])
    faces = mesh.faces.copy()
    faces[-1, 0] = faces[0, 0]
    with pytest.raises(ValueError, match="two splats share a vertex"):
        bake_filter(replace(mesh, faces=faces), pixel=0.1)


def test_splats_without_area_or_opacity_stay_finite():
    mesh = fans(6, 20)
    vertices = mesh.vertices.copy()
    vertices[:9] = vertices[0]
    vertices[9:18] = vertices[9] + np.arange(9)[:, None] * np.float32([1, 2, 3])
    hostile = replace(mesh, vertices=vertices, colors=mesh.colors * np.float32([1, 1, 1, 0]))
    assert np.isfinite(bake_filter(hostile, pixel=0.1).vertices).all()


def test_command(tmp_path, capsys):
    mesh = fans(4, 200, sizes=(0.001, 0.01))
    save_mesh(mesh, tmp_path / "m.npz")
    out = tmp_path / "baked.glb"
    assert main(["bake", str(tmp_path / "m.npz"), "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["filter_px2"] == 0.3
    baked = load_mesh(out)  # without a warning
    assert baked.filter_px2 == 0
    views = orbit(mesh, 6, width=1000, height=1000)
    np.testing.assert_array_equal(baked.vertices, bake_filter(mesh, views).vertices)
    assert main(["bake", str(out), "-o", str(tmp_path / "again.glb")]) == 1
    assert "there is nothing to bake" in capsys.readouterr().err
    more = ["--filter-px2", "1", "--orbit", "3", "--width", "200"]
    assert main(["bake", str(out), "-o", str(tmp_path / "again.ply"), *more]) == 0
    assert "1 px^2 for 3 views of 200 x 200" in capsys.readouterr().out


def test_blender_gets_it_baked(tmp_path, monkeypatch):
    """For the cameras of its images; the programs that draw triangles as they are get warned otherwise."""
    from meshsplats import blender
    from meshsplats.blender import launch

    mesh, view = fans(7, 30, z=6.0), camera(40, 40)
    jobs = []
    job = SimpleNamespace(run=lambda arrays, *_, **__: jobs.append(arrays) or {})
    monkeypatch.setattr(launch, "begun", lambda *_, **__: nullcontext(job))
    blender.draw(mesh, [view], images=[tmp_path / "p.png"])
    np.testing.assert_array_equal(jobs[0][0][0]["vertices"], bake_filter(mesh, [view]).vertices)
    with pytest.warns(DataWarning, match="bake_filter"):
        save_mesh(mesh, tmp_path / "m.glb")


def test_command_for_colours(tmp_path, capsys):
    mesh = convert(make_scene(800), footprint="filter")
    save_mesh(mesh, tmp_path / "m.npz")
    views = ["--orbit", "2", "--width", "50"]
    assert main(["bake", str(tmp_path / "m.npz"), "-o", str(tmp_path / "b.npz"), "--colors", *views]) == 0
    assert "a filter of 0.3 px^2 and colours of degree 3" in capsys.readouterr().out
    baked = load_mesh(tmp_path / "b.npz")
    assert (baked.harmonics, baked.plain_colors, baked.filter_px2) == (None, None, 0)
    np.testing.assert_array_equal(
        baked.colors[:, :3], plain_colors_of(mesh, orbit(mesh, 2, width=50, height=50))
    )
    again = ["bake", str(tmp_path / "b.npz"), "-o", str(tmp_path / "c.npz")]
    assert main([*again, "--colors"]) == 1
    assert "leave out --colors" in capsys.readouterr().err
    # Without the option colours stay as they are, and are all there is to bake without a filter.
    assert main(["bake", str(tmp_path / "m.npz"), "-o", str(tmp_path / "c.npz"), *views]) == 0
    np.testing.assert_array_equal(load_mesh(tmp_path / "c.npz").harmonics, mesh.harmonics)
    assert main(["bake", str(tmp_path / "c.npz"), "-o", str(tmp_path / "d.npz"), *views]) == 1
    assert "--colors bakes its colours" in capsys.readouterr().err
    assert main(["bake", str(tmp_path / "c.npz"), "-o", str(tmp_path / "d.npz"), "--colors", *views]) == 0
    np.testing.assert_array_equal(
        load_mesh(tmp_path / "d.npz").vertices, load_mesh(tmp_path / "c.npz").vertices
    )
