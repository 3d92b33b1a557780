"""Tasks on a Dask cluster: the same bits as in one process, and nothing is lost with a worker."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from _cities import SMALL, digest, write_city
from _photographs import write_photographs

from meshsplats import (
    __version__,
    convert,
    load_mesh,
    orbit,
    render_splats,
    save_mesh,
    stream_gaussians,
)
from meshsplats.cli import main
from meshsplats.cluster import ANY_PORT, Shared, Workers, _sent, _with_warnings, open_workers
from meshsplats.demo_scene import make_scene
from meshsplats.errors import ClusterError, DataWarning, FileFormatError, MissingDependencyError
from meshsplats.finetuning.memory import available_memory
from meshsplats.tiles import building, making
from meshsplats.tiles.building import build_tiles


@pytest.fixture(scope="module")
def cluster():
    """Two workers of one thread each."""
    distributed = pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=ANY_PORT) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def scheduler(cluster):
    """Their address."""
    return cluster.scheduler_address


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    return write_city(tmp_path_factory.mktemp("city"))


@pytest.fixture(scope="module")
def made_here(splats, tmp_path_factory):
    """The folder of the tiles that one process makes."""
    folder = tmp_path_factory.mktemp("here") / "tiles"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "BUCKET", 3000)
        build_tiles(stream_gaussians(splats), folder, SMALL)
    return folder


@pytest.fixture(autouse=True)
def small_buckets(monkeypatch):
    monkeypatch.setattr(building, "BUCKET", 3000)


def results(folder):
    """Hashes of every file but the records of the command line."""
    return {name: found for name, found in digest(folder).items() if "config" not in Path(name).name}


# ---- Functions that workers run


def squared(task):
    return task * task, os.getpid()


def memory(task):
    return available_memory()


def picky(task):
    if task == 3:
        raise FileFormatError("file 3: broken")
    warnings.warn(f"task {task} left something out", DataWarning, stacklevel=2)
    warnings.warn("not for users", DeprecationWarning, stacklevel=2)
    return task


def once(folder, task):
    """Ends its worker the first time, like the system when memory runs out."""
    try:
        os.close(os.open(folder / f"{task}", os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return task
    if task == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def deadly(task):
    os.kill(os.getpid(), signal.SIGKILL)


def made(folder):
    (folder / f"{os.getpid()}-{threading.get_ident()}-{time.monotonic_ns()}").touch()
    return [0]


def uses(shared, task):
    shared.get()[0] += 1
    return os.getpid()


# ---- Workers


@pytest.mark.slow
def test_a_cluster_gives_the_results_of_one_process(scheduler):
    tasks = list(range(20))
    here = dict(Workers().run(squared, tasks))
    with open_workers(scheduler) as workers:
        there = dict(workers.run(squared, tasks))
        assert "2 workers of tcp://" in repr(workers)
    assert {i: value for i, (value, _) in there.items()} == {i: value for i, (value, _) in here.items()}
    assert sorted(there) == tasks
    processes = {process for _, process in there.values()}
    assert len(processes) == 2
    assert os.getpid() not in processes


@pytest.mark.slow
def test_local_workers_share_the_processors(monkeypatch):
    """As many processes as keep all processors busy with the threads of each task."""
    pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    monkeypatch.setattr("meshsplats.cluster.processors", lambda: 5)
    with open_workers("local", 2) as workers:
        assert repr(workers).startswith("2 workers of tcp://127.0.0.1:")
        assert workers.threads == 2
    with open_workers(None) as workers:
        assert workers.threads is None


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 imports from the current folder first")
def test_local_workers_import_nothing_from_the_current_folder(monkeypatch, tmp_path):
    pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    (tmp_path / "pickle.py").write_text("open('ran', 'w').close(); from _pickle import *")
    monkeypatch.chdir(tmp_path)
    with open_workers("local", 64) as workers:
        assert list(workers.run(abs, [-3])) == [(0, 3)]
    assert not (tmp_path / "ran").exists()
    assert "PYTHONSAFEPATH" not in os.environ


def test_a_task_has_one_thread_unless_it_is_given_more(scheduler):
    with open_workers(scheduler) as workers:
        assert workers.threads == 1
    with open_workers(scheduler, 3) as workers:
        assert workers.threads == 3


def test_warnings_and_errors_of_tasks_reach_the_user(scheduler):
    with open_workers(scheduler) as workers:
        with pytest.warns(DataWarning) as caught:
            assert dict(workers.run(picky, [0, 1, 2])) == {0: 0, 1: 1, 2: 2}
        assert sorted(str(w.message) for w in caught) == [f"task {i} left something out" for i in range(3)]
        with pytest.raises(FileFormatError, match="file 3: broken"):
            dict(workers.run(picky, [3]))
        assert dict(workers.run(squared, [5]))[0][0] == 25  # after an error, too


def test_a_worker_of_another_version_is_refused():
    assert _sent(__version__, squared, 3)[0] == squared(3)
    with pytest.raises(ClusterError, match=rf"a worker has MeshSplats {__version__}, this .* of 0\.0\.9: "):
        _sent("0.0.9", squared, 3)


def test_tasks_in_threads_of_one_process_keep_their_warnings_apart():
    steps = threading.Barrier(2, timeout=60)

    def first(task):
        warnings.warn("of the first", DataWarning, stacklevel=1)
        steps.wait()
        warnings.warn("not for users", RuntimeWarning, stacklevel=1)
        return task

    def second(task):
        steps.wait()
        steps.wait()  # the first one has ended
        for i in range(2):
            warnings.warn(f"of the second: {i}", DataWarning, stacklevel=1)
        return task

    with warnings.catch_warnings(), ThreadPoolExecutor(1) as pool:
        warnings.simplefilter("always")
        warnings.simplefilter("error", DataWarning)
        shown = []
        warnings.showwarning = lambda message, *where, **more: shown.append(str(message))
        before = warnings.showwarning, list(warnings.filters)
        other = pool.submit(_with_warnings, second, 2)
        assert _with_warnings(first, 1) == (1, [(DataWarning, "of the first")])
        steps.wait()
        assert other.result() == (2, [(DataWarning, f"of the second: {i}") for i in range(2)])
        assert shown == ["not for users"]
        assert (warnings.showwarning, list(warnings.filters)) == before


@pytest.mark.slow
def test_tasks_share_the_memory_of_their_worker():
    distributed = pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, memory_limit="400MB", dashboard_address=ANY_PORT
    ) as cluster:
        with open_workers(cluster.scheduler_address) as workers:
            assert dict(workers.run(memory, [0])) == {0: 200_000_000}
        assert memory(0) != 200_000_000


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_the_tasks_of_a_killed_worker_run_again(scheduler, tmp_path):
    with open_workers(scheduler) as workers:
        found = dict(workers.run(partial(once, tmp_path), list(range(6))))
    assert found == {i: i for i in range(6)}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_task_that_kills_every_worker_ends_the_run(cluster, scheduler, monkeypatch):
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 1)  # three, usually: each start takes seconds
    with open_workers(scheduler) as workers:
        with pytest.raises(ClusterError, match="a task killed one worker after another"):
            dict(workers.run(deadly, [0]))
        assert dict(workers.run(squared, [2]))[0][0] == 4


def test_shared_objects_are_made_once_in_each_process(scheduler, tmp_path):
    shared = Shared(partial(made, tmp_path))
    with open_workers(scheduler) as workers:
        processes = set(dict(workers.run(partial(uses, shared), list(range(12)))).values())
        assert len(list(tmp_path.iterdir())) == len(processes)
        dict(workers.run(partial(uses, Shared(partial(made, tmp_path))), list(range(12))))
        assert len(list(tmp_path.iterdir())) > len(processes)  # another run makes its own
    here = Shared(partial(made, tmp_path / "nowhere"))
    with open_workers(None) as workers:
        held = here.hold([5])
        dict(workers.run(partial(uses, here), [0]))
    assert held == [6]


def test_addresses_that_are_refused(monkeypatch):
    pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    with pytest.raises(ValueError, match="must be 'local' or the address of a Dask scheduler"):
        open_workers("localhost").__enter__()
    monkeypatch.setattr("meshsplats.cluster.SECONDS", 1)
    with pytest.raises(OSError, match=r"tcp://127\.0\.0\.1:9"), open_workers("tcp://127.0.0.1:9"):
        pass


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r'pip install "meshsplats\[cluster\]"'):
        open_workers("local").__enter__()


# ---- Commands


@pytest.mark.slow
def test_tiles_of_a_cluster_have_the_same_bits(splats, made_here, scheduler, tmp_path, capsys):
    words = ["tiles", str(splats), "-o", str(tmp_path / "there"), "--max-triangles", "4096"]
    assert main([*words, "--cluster", scheduler]) == 0
    assert "cluster: 2 workers of tcp://" in capsys.readouterr().err
    assert results(tmp_path / "there") == results(made_here)
    assert not (tmp_path / "there.partial").exists()


def build_and_die(folder, build, cell):
    """Ends its worker once, in the middle of a cell, with a file that is written but not yet renamed."""
    if not (folder / "died").exists():
        (folder / "died").touch()

        def dying(temporary, path):
            # As a worker on another machine leaves it, whose processes we cannot know.
            Path(temporary).with_name(".0.1-00000000.0123456789abcdef.glb").write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)

        os.replace = dying
    return build(cell)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_tiles_outlive_a_killed_worker(splats, made_here, scheduler, tmp_path, monkeypatch):
    build = building.build_cell

    def deadly_build(tiles, cell):
        return build_and_die(tmp_path, partial(build, tiles), cell)

    monkeypatch.setattr(building, "build_cell", deadly_build)
    with open_workers(scheduler) as workers:
        build_tiles(stream_gaussians(splats), tmp_path / "there", SMALL, workers=workers)
    assert (tmp_path / "died").exists()
    assert results(tmp_path / "there") == results(made_here)


@pytest.mark.slow
def test_images_of_a_cluster_have_the_same_bits(splats, made_here, scheduler, tmp_path):
    words = ["render", str(splats), "--orbit", "3", "--width", "64", "--depth", "png", "--animation", "none"]
    assert main([*words, "-o", str(tmp_path / "here")]) == 0
    assert main([*words, "-o", str(tmp_path / "there"), "--cluster", scheduler]) == 0
    found = results(tmp_path / "there")
    assert found == results(tmp_path / "here")
    assert len([name for name in found if name.endswith(".png")]) == 6
    words[1] = str(made_here)
    assert main([*words, "-o", str(tmp_path / "here2")]) == 0
    assert main([*words, "-o", str(tmp_path / "there2"), "--cluster", scheduler]) == 0
    assert results(tmp_path / "there2") == results(tmp_path / "here2")


def test_scores_of_a_cluster_are_the_same(scheduler, tmp_path, capsys):
    cloud = make_scene(300)
    cameras = orbit(cloud, 3, width=32, height=32)
    for name in ("train", "truck"):
        data, models = tmp_path / "data", tmp_path / "models"
        data.mkdir(exist_ok=True)
        models.mkdir(exist_ok=True)
        images = [render_splats(cloud, camera).color for camera in cameras]
        write_photographs(data / name, cameras, images)
        save_mesh(convert(cloud), models / f"{name}.npz")
    words = ["evaluate", str(models), "--data", str(data), "--protocol", "tanks-and-temples", "--strips", "1"]
    assert main([*words, "-o", str(tmp_path / "here")]) == 0
    assert main([*words, "-o", str(tmp_path / "there"), "--cluster", scheduler]) == 0
    found = results(tmp_path / "there")
    assert found == results(tmp_path / "here")
    assert {"report.json", "train/report.json", "truck/report.json"} <= set(found)
    capsys.readouterr()
    words = [
        "evaluate",
        str(models / "train.npz"),
        "--data",
        str(data / "train"),
        "-o",
        str(tmp_path / "one"),
    ]
    assert main([*words, "--cluster", scheduler]) == 2
    assert "--cluster is for the scenes of --protocol" in capsys.readouterr().err


def test_a_configuration_file_names_no_cluster(splats, tmp_path, capsys):
    """It may come from a stranger, and a scheduler runs what it likes."""
    assert main(["render", str(splats), "-o", str(tmp_path / "a.png"), "--width", "16"]) == 0
    config = next(tmp_path.glob("*.toml"))
    assert "cluster" not in config.read_text().partition("[options]")[2].partition("[")[0]
    config.write_text(config.read_text().replace("[options]", '[options]\ncluster = "tcp://127.0.0.1:1"'))
    assert main(["render", str(splats), "-o", str(tmp_path / "b.png"), "--config", str(config)]) == 2
    assert "cluster" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_command_with_workers_is_resumed(splats, made_here, scheduler, tmp_path):
    process = subprocess.Popen([sys.executable, "-c", TILES, str(splats), str(tmp_path / "there")])
    made = tmp_path / "there.partial" / "tileset"
    while len(list(made.rglob("*.glb"))) < 4 and process.poll() is None:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "there").exists()
    with open_workers(scheduler) as workers:
        build_tiles(stream_gaussians(splats), tmp_path / "there", SMALL, workers=workers, resume=True)
    assert results(tmp_path / "there") == results(made_here)


# ---- Full disks, lost schedulers


TILES = """
import sys
from meshsplats import open_workers, stream_gaussians
from meshsplats.tiles import building, making
if __name__ == "__main__":
    building.BUCKET = 3000
    with open_workers("local") as workers:
        building.build_tiles(
            stream_gaussians(sys.argv[1]), sys.argv[2], building.TileOptions(max_triangles=4096),
            workers=workers,
        )
"""


LIMITED = """
import resource, signal, sys
from meshsplats import stream_gaussians
from meshsplats.tiles import building, making
building.BUCKET = 3000
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), -1))
try:
    building.build_tiles(
        stream_gaussians(sys.argv[1]), sys.argv[2], building.TileOptions(max_triangles=4096), resume=True
    )
except FileNotFoundError:
    building.build_tiles(
        stream_gaussians(sys.argv[1]), sys.argv[2], building.TileOptions(max_triangles=4096)
    )
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_tiles_go_on_after_files_that_could_not_be_written(splats, made_here, tmp_path):
    """Files of a limited size, as on a disk with little room: whole tiles only; all after a resumption."""
    # The splats on their way into tiles fit, tiles do not.
    largest = max(path.stat().st_size for path in made_here.rglob("*.glb"))
    words = [sys.executable, "-c", LIMITED, str(splats), str(tmp_path / "there")]
    found = subprocess.run([*words, str(largest - 1)], capture_output=True, text=True)
    assert found.returncode == 1
    assert "OSError" in found.stderr
    assert not (tmp_path / "there").exists()
    for path in (tmp_path / "there.partial" / "tileset").rglob("*.glb"):
        load_mesh(path)
    build_tiles(stream_gaussians(splats), tmp_path / "there", SMALL, resume=True)
    assert results(tmp_path / "there") == results(made_here)


@pytest.fixture
def small_disk(tmp_path):
    """A disk of two megabytes."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)]
    mount = shutil.which("mount") and subprocess.run(command, capture_output=True)
    if not mount or mount.returncode:
        pytest.skip("no right to mount a disk here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
def test_tiles_go_on_after_the_disk_of_a_worker_was_full(splats, made_here, scheduler, small_disk):
    with open_workers(scheduler) as workers, pytest.raises(OSError, match="no space left") as caught:
        build_tiles(stream_gaussians(splats), small_disk / "tiles", SMALL, workers=workers)
    assert caught.value.errno == errno.ENOSPC
    partial_tiles = small_disk / "tiles.partial" / "tileset"
    end = time.monotonic() + 20
    while any(partial_tiles.rglob(".*.glb")):  # the other worker still writes its tile, beside its place
        assert time.monotonic() < end
        time.sleep(0.01)
    for path in partial_tiles.rglob("*.glb"):
        load_mesh(path)
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    with open_workers(scheduler) as workers:
        build_tiles(stream_gaussians(splats), small_disk / "tiles", SMALL, workers=workers, resume=True)
    assert results(small_disk / "tiles") == results(made_here)


@pytest.mark.slow
def test_tiles_say_that_the_disk_is_full_after_the_tiles_of_a_cell(splats, small_disk, monkeypatch):
    keep = making.TileWriter.keep

    def on_a_full_disk(tiles, cell, nodes, merged):
        if merged.nbytes > 16384:  # more than a buffer takes
            size = os.statvfs(small_disk)
            (small_disk / "rest").write_bytes(bytes(size.f_bavail * size.f_frsize))
        keep(tiles, cell, nodes, merged)

    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    monkeypatch.setattr(making.TileWriter, "keep", on_a_full_disk)
    with pytest.raises(OSError, match="no space left") as caught:
        build_tiles(stream_gaussians(splats), small_disk / "tiles", SMALL)
    assert caught.value.errno == errno.ENOSPC


def slow_then(folder, task):
    (folder / str(task)).touch()
    time.sleep(0.2)
    return task


@pytest.mark.nightly
def test_a_lost_scheduler_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr("meshsplats.cluster.SECONDS", 4)  # for which the client looks for it
    distributed = pytest.importorskip("distributed", reason="Dask is not here: pip install distributed")
    import dask

    # Its worker is a thread, which starts sooner than a process.
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=ANY_PORT, processes=False, protocol="tcp://"
    )
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        open_workers(cluster.scheduler_address) as workers,
    ):
        results = workers.run(partial(slow_then, tmp_path), list(range(50)))
        next(results)
        cluster.close()
        with pytest.raises(ClusterError, match="the scheduler was lost"):
            list(results)
    assert len(list(tmp_path.iterdir())) < 50
