"""The page as a file: what it holds, what it may do, what hostile names cannot."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from _pages import cameras_fixture, cloud_fixture, mesh_fixture  # noqa: F401 - fixtures

import meshsplats as ms
from meshsplats.viewer import page as pages
from meshsplats.viewer.packing import pack_splats
from meshsplats.viewer.page import PageOptions, make_page, script
from meshsplats.viewer.unpacking import unpack_mesh
from meshsplats.webgpu import kernels

HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)">{{script}}<!--'


def block(text: str, name: str) -> str:
    found = re.search(rf'<script type="[\w/]+" id="{name}">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_mesh_and_the_settings_are_in_the_page(mesh, cameras):
    page = make_page(mesh, cameras=cameras, options=PageOptions(title="a vase", background=(1, 0.5, 0)))
    packed = base64.b64decode(block(page.html, "mesh"))
    assert packed == page.mesh.data
    assert len(unpack_mesh(packed).faces) == len(mesh.faces)
    settings = json.loads(block(page.html, "settings"))
    assert (settings["title"], settings["background"]) == ("a vase", "#ff8000")
    assert [camera["name"] for camera in settings["cameras"]] == [camera.name for camera in cameras]
    matrix = np.array(settings["cameras"][1]["matrix"]).reshape(3, 4)
    assert np.array_equal(matrix, cameras[1].world_to_camera[:3])


def test_the_kernels_are_in_the_page_word_for_word(mesh):
    text = json.loads(block(make_page(mesh).html, "kernels"))
    assert text["sources"]["lists"] == kernels.lists_source()
    assert text["sources"]["raster"] == kernels.raster_source(kernels.QUEUE)
    assert text["sources"]["again"] == kernels.raster_source(kernels.LONG_QUEUE)
    assert text["lists"] == kernels.list_steps()
    grouped = replace(mesh, depth_group=np.zeros(len(mesh.faces), np.int32))
    assert "GROUPS = true" in json.loads(block(make_page(grouped).html, "kernels"))["sources"]["raster"]
    by_splat = replace(grouped, order="splat")
    text = json.loads(block(make_page(by_splat, coarse=mesh.take(slice(60))).html, "kernels"))
    assert text["lists"] == kernels.list_steps("splat")
    for name, queue in (("raster", kernels.QUEUE), ("again", kernels.LONG_QUEUE)):
        assert text["sources"][name] == kernels.raster_source(queue, order="splat")


def test_both_levels_of_a_page_have_one_order(mesh):
    part = mesh.take(slice(60))
    for fine, coarse in ((replace(mesh, order="splat"), part), (mesh, replace(part, order="splat"))):
        text = make_page(fine, coarse=coarse).html
        orders = [unpack_mesh(base64.b64decode(block(text, name))).order for name in ("mesh", "coarse")]
        assert orders == [fine.order] * 2


def test_only_the_script_and_the_style_of_the_page_may_run(mesh):
    text = make_page(mesh, options=PageOptions(title="x")).html
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])  # type: ignore[index]
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == "'none'"
    assert "unsafe" not in policy
    for kind, tag in (("script-src", "script"), ("style-src", "style")):
        body = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert len(body) == 1
        digest = base64.b64encode(hashlib.sha256(body[0].encode()).digest()).decode()
        assert rules[kind] == f"'sha256-{digest}'"
    assert set(rules) == {"default-src", "script-src", "style-src", "img-src", "base-uri", "form-action"}


def test_the_page_names_no_address(mesh, cloud):
    text = make_page(mesh, splats=cloud).html
    assert re.findall(r"(?i)https?:|//[\w-]+\.\w|@import|url\(", text) == []
    assert set(re.findall(r'(?:src|href)="([^"]*)"', text)) == {"data:,", "#panel"}


def test_hostile_names_stay_text(mesh, cameras):
    named = [replace(camera, name=HOSTILE) for camera in cameras]
    text = make_page(mesh, cameras=named, options=PageOptions(title=HOSTILE)).html
    plain = make_page(mesh, cameras=cameras, options=PageOptions(title="x")).html
    for tag in ("<script", "</script", "<img", "<style", "<!--"):
        assert text.count(tag) == plain.count(tag)
    settings = json.loads(block(text, "settings"))
    assert settings["title"] == settings["cameras"][2]["name"] == HOSTILE
    assert html.escape(HOSTILE) in text


def test_names_of_files_that_are_not_utf8_are_titles(mesh):
    text = make_page(mesh, options=PageOptions(title=os.fsdecode(b"caf\xe9"))).html
    assert "<title>caf\ufffd</title>" in text
    assert text.encode("utf-8")


def test_long_names_and_many_cameras_are_limited(mesh, cameras, monkeypatch):
    monkeypatch.setattr(pages, "MOST_CAMERAS", 4)
    named = [replace(cameras[0], name=f"{i} " + "x" * 900) for i in range(9)]
    settings = json.loads(block(make_page(mesh, cameras=named).html, "settings"))
    assert [camera["name"].split()[0] for camera in settings["cameras"]] == ["0", "2", "4", "6"]
    assert {len(camera["name"]) for camera in settings["cameras"]} == {pages.LONGEST_NAME}


def test_modules_become_one_script_without_imports():
    text = script()
    assert not re.search(r"^\s*(import|export)\b", text, re.MULTILINE)
    assert text.startswith('"use strict";')
    for name in pages.MODULES:
        source = pages._read(name)
        for imported in re.findall(r'^import \{([^}]*)\} from "\./(\w+\.js)"', source, re.MULTILINE):
            names, module = imported
            assert pages.MODULES.index(module) < pages.MODULES.index(name)
            for each in names.split(","):
                assert re.search(
                    rf"^export (?:async )?(?:class|function|const) {each.strip()}\b",
                    pages._read(module),
                    re.M,
                )


def test_a_page_begins_before_the_subject_and_upright(mesh):
    settings = json.loads(block(make_page(replace(mesh, up=(0, 0, 1))).html, "settings"))
    assert settings["up"] == [0, 0, 1]
    matrix = np.array(settings["cameras"][0]["matrix"]).reshape(3, 4)
    assert matrix[1, 2] < -0.9
    center = matrix[:, :3] @ settings["center"] + matrix[:, 3]
    assert center[2] > settings["radius"]
    assert abs(center[0]) < 0.5 * center[2]


def test_the_first_view_is_as_wide_as_the_subject_while_it_turns():
    rng = np.random.default_rng(0)
    for size, least, most in (((0.3, 2, 0.1), 100, 300), ((0.1, 2, 2), 900, 1000)):
        points = (rng.random((3000, 3)) - 0.5) * size
        mesh = ms.SplatMesh(points, np.arange(3000).reshape(-1, 3), np.ones((3000, 4)))
        page = make_page(mesh, options=PageOptions(up=(0, 1, 0)))
        (view,) = json.loads(block(page.html, "settings"))["cameras"]
        assert least < view["width"] <= most
        assert (view["height"], view["cx"]) == (1000, view["width"] / 2)
        matrix = np.array(view["matrix"]).reshape(3, 4)
        for turn in np.radians(range(0, 360, 30)):
            c, s = np.cos(turn), np.sin(turn)
            seen = points @ [[c, 0, s], [0, 1, 0], [-s, 0, c]] @ matrix[:, :3].T + matrix[:, 3]
            assert (np.abs(view["fx"] * seen[:, 0] / seen[:, 2]) < view["width"] / 2).mean() > 0.99


def test_what_has_another_origin_is_at_its_place_in_the_page(mesh, cloud):
    part, far = mesh.take(slice(60)), (10.0, -20.0, 30.0)
    page = make_page(mesh, coarse=part.relative_to(far), splats=cloud.relative_to(far)).html
    coarse = unpack_mesh(base64.b64decode(block(page, "coarse")))
    assert np.abs(coarse.vertices.mean(axis=0) - part.vertices.mean(axis=0)).max() < 0.1
    wanted = pack_splats(cloud.relative_to(far).relative_to(mesh.origin))
    assert base64.b64decode(block(page, "splats")) == wanted


def test_the_background_of_a_page_is_rgb(mesh):
    with pytest.raises(ValueError, match=r"background must have shape \(3,\), got \(4,\)"):
        make_page(mesh, options=PageOptions(background=(1, 1, 1, 1)))


def test_a_mesh_without_triangles_makes_no_page():
    with pytest.raises(ValueError, match="no triangles"):
        make_page(ms.SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 4))))
