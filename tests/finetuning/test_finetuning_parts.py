"""The parts of a fine-tuning that do not need the renderer: configuration, sizes, checkpoints,
memory."""

from __future__ import annotations

import ctypes
import json
import math
import runpy
import signal
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from meshsplats.cameras.placing import outside_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import messages
from meshsplats.conversion import ConversionOptions, convert
from meshsplats.datasets.splat_targets import splat_dataset, splat_views
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import FileFormatError
from meshsplats.finetuning import initial, interruption, memory
from meshsplats.finetuning.config import PRESETS, FinetuneConfig, is_long, learning_rates, make_config
from meshsplats.finetuning.initial import (
    boundary_vertices,
    for_photographs,
    starting_mesh,
    starting_sides,
    vertex_sizes,
)
from meshsplats.finetuning.interruption import StopSignals
from meshsplats.finetuning.journal import METRICS, Journal
from meshsplats.finetuning.on_splats import tuned_as_configured
from meshsplats.finetuning.run_options import RunOptions
from meshsplats.rendering import ordering, render_splats
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import DILATION
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training import train_config

ROOT = Path(__file__).parents[2]


# ---- Configuration


def test_presets_are_pinned():
    """What the paper's text and its code say; a change here is a change of meaning."""
    paper = PRESETS["paper"]
    assert paper.position_rate == pytest.approx(math.exp(-3) * paper.color_rate)
    assert paper.prune_opacity == pytest.approx(math.exp(-4))
    assert (paper.epochs, paper.steps, paper.minutes) == (15, None, None)
    assert (paper.ssim_weight, paper.l2_weight, paper.prune_epochs) == (0.4, 0, 10)
    assert (paper.color_step_decay, paper.final_share) == (0.999, 1)
    assert (paper.background, paper.position_unit, paper.exposure) == ("white", "scene", False)
    assert (paper.beta1, paper.beta2, paper.epsilon) == (0.9, 0.999, 1e-8)
    assert paper.soft_edges is False
    assert PRESETS["default"] == FinetuneConfig()


def test_a_length_takes_the_place_of_the_presets():
    assert make_config("paper", steps=7).total_steps(100) == 7
    assert make_config("paper").total_steps(100) == 1500
    assert make_config("paper", epochs=0.5).total_steps(9) == 4
    assert make_config("default", minutes=2).total_steps(9) is None
    assert is_long(make_config(minutes=10), 1)
    assert not is_long(make_config(minutes=9.9), 9000)
    assert is_long(make_config(epochs=20), 100)
    assert not is_long(make_config(epochs=20), 99)
    assert not is_long(make_config("paper", minutes=60), 100)
    assert not is_long(make_config(minutes=60, opacity="cutoff"), 100)
    assert make_config("paper").prune_interval(30) == 300
    assert make_config("default", prune_epochs=0).prune_interval(30) == 0


def test_rates_fall_over_the_length_and_by_step():
    config = make_config(
        color_rate=0.1, position_rate=0.2, final_share=0.01, color_step_decay=0.5, rate_steps=0
    )
    assert learning_rates(config, 0, 0) == pytest.approx((0.1, 0.2))
    assert learning_rates(config, 0, 0.5) == pytest.approx((0.01, 0.02))
    assert learning_rates(config, 3, 1) == pytest.approx((0.1 * 0.01 / 8, 0.002))


def test_long_runs_move_positions_less_and_end_lower():
    config = make_config(steps=1000, color_rate=0.1, position_rate=0.2, final_share=0.04, rate_steps=250)
    assert learning_rates(config, 0, 0) == pytest.approx((0.1, 0.2))
    # Four times as many steps: half the rate, and half the share at the end.
    assert learning_rates(config, 500, 0.5) == pytest.approx((0.1 * 0.02**0.5, 0.1 * 0.02**0.5))
    assert learning_rates(config, 999, 0.999) == pytest.approx((0.1 * 0.02, 0.1 * 0.02), rel=0.01)
    for step in (100, 250):  # short runs, and those that do not care
        assert learning_rates(config, step, 1) == pytest.approx((0.1 * 0.04, 0.2 * 0.04))
        assert learning_rates(replace(config, rate_steps=0), 4 * step, 1) == pytest.approx(
            (0.1 * 0.04, 0.2 * 0.04)
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color_rate": 0}, "color_rate must be a number"),
        ({"color_rate": float("nan")}, "color_rate"),
        ({"beta2": 1.0}, "beta2"),
        ({"steps": 2.5}, "steps must be a whole number"),
        ({"steps": 3, "minutes": 1}, "steps and minutes"),
        ({"background": "grey"}, "background must be one of mixed, random, white, black"),
        ({"blending": "srgb"}, "blending must be one of"),
        ({"position_unit": "pixel"}, "position_unit must be one of"),
        ({"exposure": 1}, "exposure must be True or False"),
        ({"samples": True}, "samples"),
    ],
)
def test_values_out_of_range(changes, message):
    with pytest.raises(ValueError, match=message):
        make_config(**changes)


def test_numbers_of_numpy_become_those_of_python():
    config = make_config(steps=np.int64(3), ssim_weight=np.float32(0.25), seed=np.int32(3), dropout=None)
    assert config == make_config(steps=3, ssim_weight=0.25, seed=3, dropout=None)
    assert FinetuneConfig(**json.loads(json.dumps(config.to_dict()))) == config
    assert type(train_config(minutes=np.float64(2), max_splats=np.array(9)).max_splats) is int
    with pytest.raises(ValueError, match="steps must be a whole number"):
        make_config(steps=np.float32(2.5))


def test_names_that_do_not_exist():
    with pytest.raises(ValueError, match="preset must be one of default, paper"):
        make_config("best")
    with pytest.raises(TypeError, match="did you mean 'color_rate'"):
        make_config(colour_rate=1)
    with pytest.raises(ValueError, match="none of them"):
        FinetuneConfig(steps=None)


# ---- Sizes


def test_sizes_follow_the_scale_of_each_splat():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = SplatMesh(
        np.concatenate([corners, corners * 4, corners * 2, corners[:1]]),
        np.arange(9).reshape(3, 3),
        np.ones((10, 4)),
        face_splat=[0, 1, 1],
    )
    sizes = vertex_sizes(mesh)
    assert np.allclose(sizes[:3], 1)
    assert np.allclose(sizes[3:9], 3)  # one splat: the mean of 4 and 2
    assert sizes[9] == 1  # no triangle: the smallest there is
    alone = vertex_sizes(replace(mesh, face_splat=None))
    assert np.allclose(alone, [1, 1, 1, 4, 4, 4, 2, 2, 2, 1])
    assert np.allclose(vertex_sizes(replace(mesh, vertices=mesh.vertices * 7)), 7 * sizes)
    flat = SplatMesh(np.zeros((3, 3)), [[0, 1, 2]], np.ones((3, 4)))
    assert (vertex_sizes(flat) == 0).all()


def test_sizes_are_limited_to_pixels_of_the_images_that_see_a_splat():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    far, behind = corners * 4 + [0, 0, 8], corners * 5 - [0, 0, 8]
    mesh = SplatMesh(
        np.concatenate([corners / 4 + [0, 0, 2], far, behind]), np.arange(9).reshape(3, 3), np.ones((9, 4))
    )
    camera = Camera(width=64, height=64, fx=32, fy=32, cx=32, cy=32, world_to_camera=np.eye(4))
    whole = vertex_sizes(mesh)
    assert np.allclose(whole, np.repeat([0.25, 4, 5], 3))
    # A pixel is as large as the distance over the focal length.
    limited = vertex_sizes(mesh, [camera], 8)
    assert np.allclose(limited, np.repeat([0.25, 8 * 8 / 32, 5], 3), rtol=1e-6)
    assert np.array_equal(vertex_sizes(mesh, [camera], 0), whole)
    assert np.array_equal(vertex_sizes(mesh, [], 8), whole)


def test_sizes_of_a_real_mesh_are_those_of_its_splats():
    cloud = make_scene(200)
    mesh = convert(cloud)
    sizes = vertex_sizes(mesh)
    first = mesh.faces[np.searchsorted(mesh.face_splat, np.arange(200)), 0]
    spread = np.log(sizes[first] / np.sort(cloud.scales, axis=1)[:, 1])
    assert spread.std() < 0.5


def test_open_edges_are_those_of_one_triangle():
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]], np.int32)
    assert not boundary_vertices(tetrahedron, 4).any()
    assert boundary_vertices(tetrahedron[:1], 4).tolist() == [True, True, True, False]
    assert not boundary_vertices(np.zeros((0, 3), np.int32), 0).any()
    mesh = convert(make_scene(200), mode="flat")
    rims = boundary_vertices(mesh.faces, len(mesh.vertices))
    assert np.array_equal(np.flatnonzero(~rims), np.arange(200) * 9)  # all but the centres
    shuffled = np.roll(mesh.faces[::-1], 1, axis=1)
    assert np.array_equal(boundary_vertices(shuffled, len(mesh.vertices)), rims)


# ---- The start


def test_triangles_of_a_splat_suit_the_run(monkeypatch):
    cloud = make_scene(200)
    cameras = orbit(cloud, 3, width=40, height=40)

    def each(**changes) -> int:
        mesh = starting_mesh(cloud, cameras, config=make_config(**changes))
        return round(len(mesh.faces) / len(cloud))

    assert each(steps=1) == each(steps=1999) == 16
    assert each(steps=2000) == each(minutes=10) == 32
    assert each(steps=2000, opacity="cutoff") == 8
    monkeypatch.setattr(initial, "MANY_TRIANGLES", 2000)
    assert (each(steps=1999), each(steps=2000)) == (10, 32)
    monkeypatch.setattr(initial, "LONG_TRIANGLES", 4000)
    assert (each(steps=1999), each(steps=2000)) == (10, 20)
    assert starting_sides(10**6, None, 1) == starting_sides(10**6, make_config(minutes=60), 1) == 5


@pytest.mark.parametrize(("most", "triangles"), [(1600, 8), (1599, 7), (1000, 5), (10, 5)])
def test_splats_of_large_clouds_begin_with_fewer_triangles(monkeypatch, most, triangles):
    monkeypatch.setattr(initial, "MANY_TRIANGLES", most)
    cloud = make_scene(200)
    cameras = orbit(cloud, 3, width=40, height=40)
    mesh = starting_mesh(cloud, cameras)
    assert triangles * 190 < len(mesh.faces) <= triangles * 200
    assert len(starting_mesh(cloud, cameras, sides=6).faces) > 6 * 190
    assert len(starting_mesh(cloud, cameras, look="splats").faces) > 8 * 190
    assert len(starting_mesh(cloud, cameras, max_splats=50).faces) <= 8 * 50
    limited = starting_mesh(cloud, cameras, max_triangles=900)
    assert np.array_equal(
        limited.vertices,
        convert(cloud, cameras=cameras, max_triangles=900, detail="cameras", mode="flat").vertices,
    )


def test_each_preset_begins_with_its_conversion():
    cloud = make_scene(200)
    cameras = orbit(cloud, 3, width=40, height=40)
    mesh = starting_mesh(cloud, cameras)
    assert 8 * 190 < len(mesh.faces) <= 8 * 200
    bare = dict(cameras=cameras)
    assert np.array_equal(mesh.vertices, convert(cloud, detail="cameras", **bare).vertices)
    even = starting_mesh(cloud, cameras, detail="even")
    assert np.array_equal(even.vertices, convert(cloud, mode="flat", **bare).vertices)
    filtered = starting_mesh(cloud, cameras, look="splats", detail="even")
    bare["footprint"] = "none"
    assert np.array_equal(filtered.vertices, convert(cloud, mode="flat", **bare).vertices)
    assert (even.filter_px2, filtered.filter_px2) == (0, pytest.approx(0.3))
    assert 4 * 190 < len(starting_mesh(cloud, cameras, mode="flat", sides=4).faces) <= 4 * 200
    assert 3 * 190 < len(starting_mesh(cloud, cameras, sides=3).faces) <= 3 * 200
    assert len(starting_mesh(cloud, cameras, rings=2).faces) == 24 * 200
    assert len(starting_mesh(cloud, cameras, mode="3d", sides=4).faces) == 12 * 200
    paper = convert(cloud, preset="paper")
    assert np.array_equal(starting_mesh(cloud, cameras, preset="paper").vertices, paper.vertices)


# ---- Memory


def dataset(count: int, side: int = 8) -> Dataset:
    camera = Camera(np.eye(4), side, side, side / 2, side / 2, side, side)
    image = ViewImage(np.zeros((side, side, 3), np.uint8))
    return Dataset(tuple(View(replace(camera, name=f"v{i}"), image) for i in range(count)))


def test_memory_is_refused_with_advice(monkeypatch):
    mesh = convert(make_scene(200))
    data = dataset(2)
    needed = memory.estimate_memory(mesh, data)
    monkeypatch.setattr(memory, "available_memory", lambda: needed)
    assert memory.check_memory(mesh, data) == needed
    monkeypatch.setattr(memory, "available_memory", lambda: needed - 1)
    with pytest.raises(MemoryError, match=r"needs about .* are free: .*``max_splats``.*``downscale``"):
        memory.check_memory(mesh, data)
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    memory.check_memory(mesh, data)


def test_memory_for_the_order_of_a_file_is_refused_with_advice(monkeypatch):
    mesh = convert(make_scene(200))
    needed = ordering.ordering_bytes(mesh)
    assert 0 < needed < ordering.ordering_bytes(convert(make_scene(400))) < 1.5e9
    monkeypatch.setattr(memory, "available_memory", lambda: needed)
    memory.check_order_memory(mesh)
    monkeypatch.setattr(memory, "available_memory", lambda: needed - 1)
    with pytest.raises(MemoryError, match=r"ordering .* triangles needs about .*``max_splats``.*``order``"):
        tuned_as_configured(mesh, dataset(2), make_config(order="file"), RunOptions(), Mock())


@pytest.mark.parametrize(
    ("folder", "limit", "used", "cached"),
    [
        ("", "memory.max", "memory.current", "inactive_file"),
        ("memory/", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ],
)
def test_what_a_container_keeps_of_files_is_free(tmp_path, folder, limit, used, cached):
    """Of control groups of either version."""
    group = tmp_path / "sys/fs/cgroup" / folder
    group.mkdir(parents=True)
    assert memory.available_memory(tmp_path) is None
    (group / limit).write_text("4000000\n")
    (group / used).write_text("3500000\n")
    assert memory.available_memory(tmp_path) == 500_000
    (group / "memory.stat").write_text(f"anon 500000\n{cached} 2800000\nactive_file 100000\n")
    assert memory.available_memory(tmp_path) == 3_300_000
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    2000 kB\n")
    assert memory.available_memory(tmp_path) == 2000 << 10


@pytest.mark.parametrize(("physical", "commit", "free"), [(8, 3, 3), (2, 5, 2)])
def test_memory_that_windows_tells(physical, commit, free):
    """MEMORYSTATUSEX: 64 bytes, its own length in the first four; available physical memory at byte 16, what
    may still be committed at 32."""

    def status(place):
        raw = (ctypes.c_char * 64).from_address(ctypes.addressof(place._obj))
        assert struct.unpack_from("<I", raw) == (64,)
        struct.pack_into("<QQQQ", raw, 8, 16, physical, 20, commit)
        return 1

    assert memory._of_windows(SimpleNamespace(GlobalMemoryStatusEx=status)) == free
    assert memory._of_windows(SimpleNamespace(GlobalMemoryStatusEx=lambda _: 0)) is None


def test_splats_that_targets_are_drawn_from_count():
    mesh, cloud = convert(make_scene(200)), make_scene(4000)
    views = splat_views(cloud, [view.camera for view in dataset(2).train])
    arrays = (cloud.means, cloud.quaternions, cloud.scales, cloud.opacities, cloud.sh)
    images = 2 * 8 * 8 * (16 - 3)  # means and points, float16 with alpha, in place of bytes
    more = memory.estimate_memory(mesh, Dataset(views)) - memory.estimate_memory(mesh, dataset(2))
    assert more == sum(array.nbytes for array in arrays) + images


def test_memory_grows_with_what_there_is():
    mesh, data = convert(make_scene(200)), dataset(2)
    base = memory.estimate_memory(mesh, data)
    assert memory.estimate_memory(convert(make_scene(400)), data) > base
    assert memory.estimate_memory(mesh, dataset(2, 64)) > base
    assert memory.estimate_memory(mesh, dataset(9)) - base == 7 * 8 * 8 * 3
    assert memory.estimate_memory(mesh, dataset(9), cache_bytes=0) == base - 2 * 8 * 8 * 3
    assert memory.available_memory() is None or memory.available_memory() > 0


# ---- Checkpoints and the journal


def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {"mesh.vertices": rng.random((4, 3), np.float32), "mesh.faces": np.arange(3, dtype=np.int32)[None]}


def checkpoint(step: int = 3):
    from meshsplats.finetuning.checkpoint import Checkpoint

    return Checkpoint(
        step, 1.5, FinetuneConfig().to_dict(), "mesh", "views", arrays(), (0.25, 1 / 3), {"steps": 7}
    )


def test_checkpoints_come_back_to_the_last_bit(tmp_path):
    from meshsplats.finetuning.checkpoint import load_checkpoint, save_checkpoint

    saved = checkpoint()
    save_checkpoint(saved, tmp_path / "c.safetensors")
    found = load_checkpoint(tmp_path / "c.safetensors")
    assert (found.step, found.seconds, found.mesh, found.dataset) == (3, 1.5, "mesh", "views")
    assert (found.config, found.losses) == (saved.config, saved.losses)
    assert all((found.arrays[name] == array).all() for name, array in saved.arrays.items())
    header = load_checkpoint(tmp_path / "c.safetensors", only_header=True)
    assert (header.step, header.planned, header.arrays) == (3, {"steps": 7}, {})
    assert [p.name for p in tmp_path.iterdir()] == ["c.safetensors"]


def test_the_schedule_of_a_run_by_minutes_leaves_out_what_came_before(tmp_path):
    """As a long search for cameras; a run that goes on is where it was."""
    from meshsplats.finetuning.checkpoint import load_checkpoint, save_checkpoint
    from meshsplats.finetuning.clock import Clock

    config = FinetuneConfig(steps=None, minutes=10)
    clock = Clock(config, 5, seconds=270, setup_seconds=270)
    assert clock.fraction < 0.01
    assert clock.seconds_left == pytest.approx(330, abs=5)  # the whole command still ends in time
    halfway = Clock(config, 5, step=7, seconds=435, setup_seconds=270)
    assert halfway.fraction == pytest.approx(0.5, abs=0.01)
    assert Clock(config, 5, seconds=600).done
    save_checkpoint(replace(checkpoint(), setup_seconds=1.25), tmp_path / "c.safetensors")
    assert load_checkpoint(tmp_path / "c.safetensors").setup_seconds == 1.25
    content = (tmp_path / "c.safetensors").read_bytes()
    part = b', \\"setup_seconds\\": 1.25'
    (tmp_path / "c.safetensors").write_bytes(content.replace(part, b" " * len(part)))  # by an earlier version
    earlier = load_checkpoint(tmp_path / "c.safetensors")
    assert earlier.setup_seconds == 0
    assert Clock(config, 5, step=7, seconds=300, setup_seconds=0).fraction == pytest.approx(0.5, abs=0.01)
    (tmp_path / "c.safetensors").write_bytes(content.replace(b": 1.25", b": 9.25"))  # more than all seconds
    with pytest.raises(FileFormatError, match="broken: step"):
        load_checkpoint(tmp_path / "c.safetensors")


def test_broken_checkpoints_are_refused(tmp_path):
    from meshsplats.finetuning.checkpoint import load_checkpoint, planned_length, save_checkpoint

    path = tmp_path / "c.safetensors"
    save_checkpoint(checkpoint(), path)
    whole = path.read_bytes()
    for cut in (0, 5, 40, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileFormatError, match="not a safetensors file"):
            load_checkpoint(path)
    path.write_bytes(whole.replace(b'\\"version\\": 1', b'\\"version\\": 7'))
    with pytest.raises(FileFormatError, match="version 7"):
        load_checkpoint(path)
    for before, after in ((b'\\"step\\": 3', b'\\"step\\":-3'), (b'\\"steps\\": 7', b'\\"seeds\\": 7')):
        path.write_bytes(whole.replace(before, after))
        with pytest.raises(FileFormatError, match="broken: step"):
            load_checkpoint(path)
    path.write_bytes(whole.replace(b', \\"planned\\": {\\"steps\\": 7}', b" " * 29))
    found = load_checkpoint(path)
    assert found.planned is None  # by an earlier version
    assert planned_length(found) == {"epochs": None, "steps": 1000, "minutes": None}
    from meshsplats.formats.safetensors import save_safetensors

    save_safetensors(path, arrays(), {})
    with pytest.raises(FileFormatError, match="not a checkpoint of meshsplats"):
        load_checkpoint(path)
    with pytest.raises(FileNotFoundError, match="leave out ``resume``"):
        load_checkpoint(tmp_path / "none")


def test_a_checkpoint_of_another_run_says_what_differs():
    from meshsplats.finetuning.checkpoint import check_same_run

    found = checkpoint()
    check_same_run(found, FinetuneConfig(), "mesh", "views")
    check_same_run(found, FinetuneConfig(steps=None, minutes=5), "mesh", "views")  # it may be made longer
    with pytest.raises(ValueError, match=r"seed was 0 and is 5"):
        check_same_run(found, FinetuneConfig(seed=5), "mesh", "views")
    with pytest.raises(ValueError, match="another mesh"):
        check_same_run(found, FinetuneConfig(), "other", "views")
    with pytest.raises(ValueError, match="other views"):
        check_same_run(found, FinetuneConfig(), "mesh", "other")


def test_fingerprints_change_with_what_they_are_of():
    from meshsplats.finetuning.checkpoint import dataset_fingerprint, mesh_fingerprint

    mesh = convert(make_scene(200))
    moved = mesh.vertices.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], np.float32(9))
    assert mesh_fingerprint(mesh) == mesh_fingerprint(replace(mesh))
    assert mesh_fingerprint(mesh) != mesh_fingerprint(replace(mesh, vertices=moved))
    data = dataset(3)
    assert dataset_fingerprint(data) == dataset_fingerprint(dataset(3))
    assert dataset_fingerprint(data) != dataset_fingerprint(dataset(2))
    assert dataset_fingerprint(data) != dataset_fingerprint(data.over((0, 0, 0)))


def test_resuming_drops_what_came_after_the_checkpoint(tmp_path):
    def refuse(found):
        raise ValueError("no")

    journal = Journal(tmp_path / "run")
    journal.begin({"seed": 0})
    for step in (0, 3, 6):
        journal.log_metrics(step, loss=0.5)
    image = np.zeros((6, 6, 3), np.float32)
    journal.save_preview(2, image, image)
    journal.save_preview(4, image, image)
    journal.save(checkpoint(3))
    with open(tmp_path / "run" / METRICS, "ab") as file:
        file.write(b'{"step": 8, "note": "\xff"}\n' + b"[" * 100_000 + b"\n")
        file.write(b'{"step": 7, "lo')  # a kill in the middle of a line
    with pytest.raises(ValueError, match="no"):
        journal.resume({}, refuse)
    assert len(journal.metrics()) == 3
    assert journal.resume({"seed": 1}, lambda found: None).step == 3
    assert [line["step"] for line in journal.metrics()] == [0, 3]
    assert [p.name for p in (tmp_path / "run" / "previews").iterdir()] == ["step_0000002.png"]
    assert json.loads((tmp_path / "run" / "config.json").read_text()) == {"seed": 1}
    journal.begin({"seed": 2})
    assert journal.metrics() == []
    assert not journal.checkpoint_path.exists()
    assert not list((tmp_path / "run" / "previews").iterdir())


def test_the_folder_above_a_run_is_not_made(tmp_path):
    with pytest.raises(FileNotFoundError):
        Journal(tmp_path / "no" / "run").begin({})


# ---- Signals


def test_the_first_signal_is_kept_and_the_second_interrupts():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopSignals() as stop:
        assert stop.received is None
        signal.raise_signal(signal.SIGTERM)
        assert stop.received == signal.SIGTERM
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
@pytest.mark.parametrize("before", [signal.SIG_DFL, signal.SIG_IGN])
def test_a_lost_terminal_stops_a_run_unless_that_is_ignored(before):
    kept = signal.signal(signal.SIGHUP, before)
    try:
        with StopSignals() as stop:
            if before == signal.SIG_IGN:
                assert signal.getsignal(signal.SIGHUP) == before
            else:
                assert callable(signal.getsignal(signal.SIGHUP))
                signal.raise_signal(signal.SIGHUP)
            assert stop.received == (signal.SIGHUP if before == signal.SIG_DFL else None)
        assert signal.getsignal(signal.SIGHUP) == before
    finally:
        signal.signal(signal.SIGHUP, kept)


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="a signal of POSIX stands in for that of Windows")
def test_ctrl_break_stops_a_run_on_windows(monkeypatch):
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    with runpy.run_path(interruption.__file__)["StopSignals"]() as stop:
        assert callable(signal.getsignal(signal.SIGUSR1))
        signal.raise_signal(signal.SIGUSR1)
        assert stop.received == signal.SIGUSR1
    assert runpy.run_path(messages.__file__)["ENDINGS"][signal.SIGUSR1] == "ended by SIGBREAK"


def test_a_handler_of_a_program_around_python_stays(monkeypatch):
    """Blender's own of SIGINT, which Python could not put back."""
    before, known = signal.getsignal(signal.SIGINT), signal.getsignal
    monkeypatch.setattr(
        signal, "getsignal", lambda number: None if number == signal.SIGINT else known(number)
    )
    with StopSignals() as stop:
        assert known(signal.SIGINT) == before
        signal.raise_signal(signal.SIGTERM)
    assert stop.received == signal.SIGTERM


def test_splats_begin_as_wide_as_in_the_photographs():
    """Those of 3DGS were widened in them, unless the photographs were larger then."""
    cloud = replace(make_scene(300), scales=make_scene(300).scales * np.float32(0.3))
    assert cloud.kernel == "3dgs"

    def photographs(size, dilation):
        views = []
        for camera in outside_cameras(cloud, 3, width=size, height=size):
            drawn = render_splats(cloud, camera, background=(1, 1, 1), samples=2, dilation=dilation)
            views.append(View(camera, ViewImage(drawn.color), background=(1.0, 1.0, 1.0)))
        return views

    options = ConversionOptions()
    assert for_photographs(options, cloud, photographs(48, 0.3)).footprint_px2 == DILATION
    smaller = photographs(48, 0.3 / 16)
    assert for_photographs(options, cloud, smaller) == options
    for other in (ConversionOptions(footprint_px2=0.1), ConversionOptions(footprint="none")):
        assert for_photographs(other, cloud, photographs(48, 0.3)) == other
    drawn = splat_dataset(cloud, train=2, test=1, width=32, placement="object").train
    assert for_photographs(options, cloud, drawn) == options
    assert for_photographs(options, replace(cloud, kernel="antialiased"), photographs(48, 0.3)) == options
    assert for_photographs(options, cloud, ()) == options
