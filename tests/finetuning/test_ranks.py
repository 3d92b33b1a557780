"""Batches of several views, and ranks that share them."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest

from meshsplats import finetune, load_mesh, make_config, save_gaussians, splat_dataset
from meshsplats.cli import main, toml, training
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DivergenceError
from meshsplats.finetuning import RunOptions, starting_mesh
from meshsplats.finetuning import ranks as ranks_module
from meshsplats.finetuning import step as steps
from meshsplats.finetuning.config import learning_rates
from meshsplats.finetuning.ranks import ALONE, Part, Ranks, is_started_by_torchrun
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step, view_of_place, view_of_step

QUIET = RunOptions(threads=1, report_every=0)


@pytest.fixture(scope="module")
def scene():
    cloud = make_scene(300)
    dataset = splat_dataset(cloud, train=9, test=0, width=40)
    return starting_mesh(cloud, [view.camera for view in dataset.train]), dataset


# ---- Batches


@pytest.mark.parametrize(("batch", "views"), [(1, 7), (2, 8), (2, 9), (3, 8), (8, 8)])
def test_every_view_comes_once_before_any_comes_again(batch, views):
    config = make_config(batch=batch)
    for place in range(batch):
        own = list(range(place, views, batch))
        for epoch in range(3):
            numbers = range(epoch * len(own), (epoch + 1) * len(own))
            assert sorted(view_of_place(config, k, place, views) for k in numbers) == own


def test_a_batch_of_one_is_the_order_of_steps():
    config = make_config(seed=3)
    for k in range(20):
        assert view_of_place(config, k, 0, 7) == view_of_step(config, k, 7)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_ranks_share_the_places_of_a_batch(count):
    for batch in (count, 2 * count, 3):
        places = []
        for index in range(count):
            ranks = Ranks()
            ranks.index, ranks.count = index, count
            places += ranks.share(batch)
        assert places == list(range(batch))


def test_a_batch_is_a_step_along_the_sum_of_its_gradients(scene, monkeypatch):
    """With the learning rates of one view times the square root of the batch."""
    mesh, dataset = scene
    config = make_config(steps=30, batch=3)
    state = State.begin(mesh, 9, config, 1)
    single = [
        steps.view_gradients(state, dataset.train, view_of_place(config, 2, place, 9), 6 + place, 0.2)
        for place in range(3)
    ]
    taken = []
    monkeypatch.setattr(state, "step", lambda *arguments, **more: taken.append(arguments))
    loss = make_step(state, dataset.train, 6, 0.2, batch=3)
    assert loss == pytest.approx(np.mean([found.loss for found in single]))
    gradients, color_rate, position_rate, _ = taken[0]
    for name in ("vertices", "colors"):
        expected = sum(getattr(found.gradients, name) for found in single)
        np.testing.assert_array_equal(getattr(gradients, name), expected)
    rates = learning_rates(config, 6, 0.2)
    np.testing.assert_allclose([color_rate, position_rate], np.sqrt(3) * np.array(rates))


def test_a_batch_counts_as_that_many_steps(scene, tmp_path):
    mesh, dataset = scene
    run = RunOptions(folder=tmp_path / "run", threads=1, report_every=5, preview_every=0)
    seen = []
    finetune(
        mesh, dataset, make_config(steps=11, batch=2), run=run, on_progress=lambda p: seen.append(p.step)
    )
    assert seen == [2, 4, 6, 8, 10, 11, 11]
    lines = [json.loads(line)["step"] for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    assert lines == [0, 6, 10, 11]


def test_batches_that_are_refused(scene):
    mesh, dataset = scene
    with pytest.raises(ValueError, match="a batch of several views is not for exposure"):
        make_config(batch=2, exposure=True)
    with pytest.raises(ValueError, match="a batch of several views is not for exposure"):
        make_config(batch=2, opacity="cutoff")
    with pytest.raises(ValueError, match="a batch of 10 needs as many training views, there are 9"):
        finetune(mesh, dataset, make_config(steps=5, batch=10))
    two = Ranks()
    two.count = 2
    run = RunOptions(ranks=two)
    with pytest.raises(ValueError, match="a batch of 3 cannot be shared by 2 ranks"):
        finetune(mesh, dataset, make_config(steps=5, batch=3), run=run)
    with pytest.raises(ValueError, match="minutes is not for several ranks"):
        finetune(mesh, dataset, make_config(minutes=1, batch=2), run=run)


def test_a_view_that_diverges_on_another_rank_is_named(scene):
    mesh, dataset = scene

    class Failed(Ranks):
        count = 2

        def total(self, part):
            assert part.views == 1
            return part._replace(failed=2)

    state = State.begin(mesh, 9, make_config(steps=10, batch=2), 1)
    before = state.colors.copy()
    name = dataset.train[view_of_place(state.config, 0, 1, 9)].name
    with pytest.raises(DivergenceError, match=f"view '{name}'"):
        make_step(state, dataset.train, 0, 0.0, batch=2, ranks=Failed())
    np.testing.assert_array_equal(state.colors, before)


def test_ranks_without_a_view_to_count_take_no_step(scene):
    mesh, dataset = scene

    class Empty(Ranks):
        count = 2

        def total(self, part):
            return part._replace(loss=0.0, views=0)

    state = State.begin(mesh, 9, make_config(steps=10, batch=2), 1)
    before = state.colors.copy()
    assert make_step(state, dataset.train, 0, 0.0, batch=2, ranks=Empty()) is None
    np.testing.assert_array_equal(state.colors, before)


def test_torchrun_is_known_by_what_it_sets():
    assert not is_started_by_torchrun({})
    assert not is_started_by_torchrun({"WORLD_SIZE": "4"})  # of another program
    assert not is_started_by_torchrun({"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "1"})
    assert is_started_by_torchrun({"TORCHELASTIC_RUN_ID": "x", "WORLD_SIZE": "2"})
    assert ALONE.any(True)
    assert not ALONE.any(False)


# ---- Exchange


class InThreads:
    """Stands in for torch.distributed, in one of several threads."""

    def __init__(self, index: int, slots: list, barrier: threading.Barrier) -> None:
        self.index, self.slots, self.barrier = index, slots, barrier

    def get_rank(self):
        return self.index

    def get_world_size(self):
        return len(self.slots)

    def all_gather(self, out, array):
        self.slots[self.index] = array
        self.barrier.wait()
        for into, found in zip(out, self.slots, strict=True):
            into[:] = found
        self.barrier.wait()

    def broadcast(self, array, sender):
        if self.index == sender:
            self.slots[sender] = array
        self.barrier.wait()
        array[:] = self.slots[sender]
        self.barrier.wait()


def exchanged(parts, monkeypatch):
    """The total of each rank, of these ``parts``."""
    monkeypatch.setattr(ranks_module, "_tensor", lambda array: array)
    slots, barrier = [None] * len(parts), threading.Barrier(len(parts), timeout=60)
    ranks = [ranks_module._TorchRanks(InThreads(i, slots, barrier)) for i in range(len(parts))]
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(lambda rank, part: rank.total(part), ranks, parts))


def part_of(seed):
    """Gradients of vertices: of the opacity alone, of the colour alone, of the position alone, or none."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, 6, 60)
    vertices = rng.normal(size=(60, 3)).astype(np.float32) * (kind >= 3)[:, None]
    colors = rng.normal(size=(60, 4)).astype(np.float32)
    colors[:, 3] *= kind % 3 != 1
    colors[:, :3] *= (kind % 3 == 1)[:, None]
    colors[kind >= 4] = 0
    return Part(vertices, colors, float(rng.random()), 1, 0, 1000 - seed)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_all_ranks_have_the_sum_in_their_order(count, monkeypatch):
    """Whichever of its gradients a vertex has."""
    parts = [part_of(seed) for seed in range(count)]
    vertices, colors = (np.zeros((60, width), np.float32) for width in (3, 4))
    for part in parts:
        vertices, colors = vertices + part.vertices, colors + part.colors
    loss = sum(part.loss for part in parts)
    for found in exchanged(parts, monkeypatch):
        np.testing.assert_array_equal(found.vertices, vertices)
        np.testing.assert_array_equal(found.colors, colors)
        assert found[2:] == (pytest.approx(loss), count, 0, 1001 - count)


def test_all_ranks_know_the_first_view_that_failed(monkeypatch):
    parts = [part_of(seed)._replace(failed=failed) for seed, failed in enumerate((0, 4, 6))]
    assert [found.failed for found in exchanged(parts, monkeypatch)] == [4, 4, 4]


# ---- Records


def test_the_batch_of_ranks_is_recorded(splats, tmp_path, monkeypatch, capsys):
    """So that --config repeats it in one process, and a run resumed by other ranks says why not."""
    out = tmp_path / "mesh.npz"
    ranks = Ranks()
    monkeypatch.setattr(training, "joined_ranks", lambda threads: nullcontext((ranks, threads)))
    ranks.count = 2
    assert main(["finetune", str(splats), "-o", str(out), *WORDS]) == 0
    config = toml.load(tmp_path / "mesh.npz.config.toml")
    assert config["options"]["batch"] == config["resolved"]["batch"] == 2
    ranks.count = 3
    assert main(["finetune", str(splats), "-o", str(out), *WORDS, "--resume", "--force"]) != 0
    assert "--batch was 2 and is 3" in capsys.readouterr().err


# ---- Processes


def torchrun(*words, ranks=2):
    pytest.importorskip("torch", reason="torch is not here: pip install torch")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(ranks)]
    command += ["--master-addr", "127.0.0.1", "--master-port", str(port), "-m", "meshsplats"]
    return subprocess.Popen(
        [*command, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    path = tmp_path_factory.mktemp("ranks") / "scene.ply"
    save_gaussians(make_scene(300), path)
    return path


WORDS = ["--steps", "24", "--views", "9", "--width", "40", "--held-out", "2", "--threads", "1"]
LONG = ["--steps", "200", *WORDS[2:]]
"""Of a run that is to be killed on the way."""


@pytest.fixture(scope="module")
def batch_of_two(splats, tmp_path_factory):
    out = tmp_path_factory.mktemp("single") / "mesh.npz"
    assert main(["finetune", str(splats), "-o", str(out), *WORDS, "--batch", "2"]) == 0
    return load_mesh(out)


def equal(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("vertices", "colors", "faces"))


def test_two_ranks_give_the_bits_of_a_batch_of_two(splats, batch_of_two, tmp_path):
    out = tmp_path / "mesh.npz"
    process = torchrun("finetune", splats, "-o", out, *WORDS)
    printed, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert equal(load_mesh(out), batch_of_two)
    assert printed.count("24 steps in") == 1  # the first rank alone speaks
    assert errors.count("training views") == 1
    lines = (tmp_path / "mesh.npz.run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [0, 24]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_run_with_a_killed_rank_is_resumed(splats, tmp_path):
    out = tmp_path / "mesh.npz"
    process = torchrun("finetune", splats, "-o", out, *LONG)
    checkpoint = tmp_path / "mesh.npz.run" / "checkpoint.safetensors"
    until = time.monotonic() + 120
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    children = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, text=True, check=True
    )
    ranks = [int(word) for word in children.stdout.split()]
    assert len(ranks) == 2
    os.kill(ranks[-1], signal.SIGKILL)
    process.communicate(timeout=300)
    assert process.returncode != 0
    assert not out.exists()
    again = torchrun("finetune", splats, "-o", out, *LONG, "--resume")
    _, errors = again.communicate(timeout=300)
    assert again.returncode == 0, errors
    single = tmp_path / "single.npz"
    assert main(["finetune", str(splats), "-o", str(single), *LONG, "--batch", "2"]) == 0
    assert equal(load_mesh(out), load_mesh(single))


def test_what_torchrun_is_not_for(splats, tmp_path):
    process = torchrun("finetune", splats, "-o", tmp_path / "mesh.npz", *WORDS, "--cell-splats", "100")
    _, errors = process.communicate(timeout=300)
    assert process.returncode != 0
    assert "--cell-splats is for --cluster, not for torchrun" in errors
    assert list(tmp_path.iterdir()) == []
