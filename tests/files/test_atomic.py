"""Files appear whole or not at all."""

import ctypes
import os
import stat
import sys
import time
from functools import partial

import pytest
from _local import make_link

from meshsplats._files import atomic
from meshsplats._files.atomic import (
    atomic_path,
    patiently,
    refuse_existing,
    replace_folder,
    temporary_beside,
    write_bytes,
)

as_root = hasattr(os, "geteuid") and os.geteuid() == 0
posix = pytest.mark.skipif(sys.platform == "win32", reason="permissions of POSIX")


def test_a_finished_file_replaces_the_old_one(tmp_path):
    target = tmp_path / "mesh.glb"
    target.write_bytes(b"old")
    with atomic_path(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".")
        assert temporary.suffix == ".glb"
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["mesh.glb"]


@pytest.fixture(name="opened")
def opened_fixture(monkeypatch):
    """Windows where another program has a file open for so many attempts to replace it."""
    attempts = []

    def refused(real):
        def call(source, *to):
            if attempts:
                attempts.pop()
                raise PermissionError(13, "Access is denied", str(source), 5, *map(str, to))
            real(source, *to)

        return call

    monkeypatch.setattr(sys, "platform", "win32")
    for name in ("rename", "replace", "unlink"):
        monkeypatch.setattr(os, name, refused(getattr(os, name)))
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    return attempts


def test_a_file_that_another_program_has_open_for_a_moment_is_replaced(tmp_path, opened):
    target = tmp_path / "mesh.glb"
    target.write_bytes(b"old")
    opened += [None] * 5
    write_bytes(target, b"new")
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["mesh.glb"]


@pytest.mark.parametrize("old", [True, False])
def test_a_folder_that_another_program_has_open_for_a_moment_is_moved(tmp_path, opened, old):
    for folder in ["new", "site"][: 1 + old]:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tile").write_text(folder)
    opened += [None] * 5
    replace_folder(tmp_path / "new", tmp_path / "site", lambda name: name == "tile")
    assert [path.name for path in tmp_path.iterdir()] == ["site"]
    assert (tmp_path / "site" / "tile").read_text() == "new"


def test_what_another_program_has_open_for_a_moment_is_removed(tmp_path, opened):
    path = tmp_path / "records"
    path.touch()
    opened += [None] * 6
    patiently(lambda: os.unlink(path))
    assert not path.exists()
    opened += [None] * 7
    with pytest.raises(PermissionError):
        patiently(lambda: os.unlink(path))


def test_permissions_are_not_waited_for_on_other_systems(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(time, "sleep", None)

    def refused():
        raise PermissionError

    with pytest.raises(PermissionError):
        patiently(refused)


def test_a_result_is_kept_beside_a_file_that_another_program_has_open(tmp_path, opened):
    """Not named by its temporary name, which nobody knows."""
    target = tmp_path / "mesh.glb"
    target.write_bytes(b"old")
    for kept in ("mesh.new.glb", "mesh.new1.glb"):
        opened += [None] * 7
        with pytest.raises(PermissionError, match=f"so the new one is {kept}") as found:
            write_bytes(target, kept.encode())
        assert found.value.filename == str(target)
        assert (tmp_path / kept).read_bytes() == kept.encode()
    assert target.read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == ["mesh.glb", "mesh.new.glb", "mesh.new1.glb"]


class Windows:
    """What the kernel of Windows says about a process, and how many handles of it are open."""

    def __init__(self, handle, state=0):
        self.handle, self.state, self.open, self.asked = handle, state, 0, []
        self.OpenProcess = partial(self._open)  # takes attributes, as functions of ctypes do

    def _open(self, access, inherit, process):
        self.open += self.handle is not None
        self.asked.append((access, inherit, process.value))
        return self.handle

    def WaitForSingleObject(self, handle, milliseconds):
        assert (handle.value, milliseconds) == (self.handle, 0)
        return self.state

    def CloseHandle(self, handle):
        assert handle.value == self.handle
        self.open -= 1


@pytest.mark.parametrize(
    ("kernel", "error", "alive"),
    [
        (Windows(1 << 40, state=0x102), 0, True),
        (Windows(1 << 40, state=0), 0, False),  # another program still holds a handle of it
        (Windows(None), 87, False),
        (Windows(None), 5, True),  # another user's
    ],
)
def test_processes_of_windows(monkeypatch, kernel, error, alive):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "WinDLL", lambda name, use_last_error: kernel, raising=False)
    monkeypatch.setattr(ctypes, "get_last_error", lambda: error, raising=False)
    monkeypatch.setattr(os, "kill", None)
    assert atomic._alive(4242) == alive
    assert kernel.asked == [(0x100000, False, 4242)]
    assert kernel.open == 0


def test_what_killed_processes_of_windows_left_is_removed(tmp_path, monkeypatch):
    left = temporary_beside(tmp_path / "mesh.glb")
    left.touch()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(atomic, "_alive", lambda process: process != os.getpid())
    monkeypatch.setattr(atomic, "_swept", set())
    with atomic_path(tmp_path / "a.glb"):
        assert not left.exists()


def _write_and_raise(path, error):
    path.write_bytes(b"half of the n")
    raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "mesh.glb"
    target.write_bytes(b"old")
    with pytest.raises(error), atomic_path(target) as temporary:
        _write_and_raise(temporary, error)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["mesh.glb"]


def test_a_failure_without_an_old_file_leaves_nothing(tmp_path):
    with pytest.raises(ValueError), atomic_path(tmp_path / "mesh.glb"):
        raise ValueError
    assert os.listdir(tmp_path) == []


@posix
@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_follows_the_umask(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with atomic_path(tmp_path / "a.npz"):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.npz").stat().st_mode) == mode


def test_a_folder_takes_the_place_of_one_that_a_killed_run_has_moved(tmp_path):
    for folder, name in ((".site.old", "mine"), (".site.old", "old"), ("site", "old"), ("new", "new")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_text(folder)
    replace_folder(tmp_path / "new", tmp_path / "site", lambda name: name in ("old", "new"))
    assert {path.name: path.read_text() for path in (tmp_path / "site").iterdir()} == {
        "mine": ".site.old",
        "new": "new",
    }
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@posix
def test_a_folder_takes_the_place_of_a_link_again_and_again(tmp_path):
    (tmp_path / "disk").mkdir()
    for name in ("old", "mine"):
        (tmp_path / "disk" / name).touch()
    (tmp_path / "site").symlink_to(tmp_path / "disk")
    for _ in range(2):
        (tmp_path / "new").mkdir()
        replace_folder(tmp_path / "new", tmp_path / "site", lambda name: name == "old")
        assert [path.name for path in (tmp_path / "site").iterdir()] == ["mine"]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "site"]


@posix
def test_a_replaced_file_keeps_its_permissions(tmp_path):
    target = tmp_path / "a.npz"
    target.write_bytes(b"")
    target.chmod(0o640)
    with atomic_path(target):
        pass
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    target, link = tmp_path / "real" / "a.npz", tmp_path / "link.npz"
    make_link(link, target)
    with atomic_path(link) as temporary:
        temporary.write_bytes(b"x")
    assert link.is_symlink()
    assert target.read_bytes() == b"x"


def test_long_names_are_fine(tmp_path):
    target = tmp_path / ("n" * 250 + ".ply")
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"x")
    assert target.read_bytes() == b"x"


def test_places_where_no_file_can_be(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(FileNotFoundError, match=r"create the folder .*missing first.*a\.glb"):
        atomic_path(tmp_path / "missing" / "a.glb").__enter__()
    with pytest.raises(NotADirectoryError, match="file is not a folder"):
        atomic_path(tmp_path / "file" / "a.glb").__enter__()
    with pytest.raises(IsADirectoryError, match="this is a folder"):
        atomic_path(tmp_path).__enter__()
    with pytest.raises(IsADirectoryError):
        atomic_path("/").__enter__()
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="no /dev/null on this system")
def test_devices_are_not_replaced():
    with pytest.raises(OSError, match="not a regular file"):
        atomic_path("/dev/null").__enter__()
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@posix
@pytest.mark.skipif(as_root, reason="root may write everywhere")
def test_protected_places(tmp_path):
    target = tmp_path / "a.glb"
    target.write_bytes(b"old")
    target.chmod(0o444)
    with pytest.raises(PermissionError, match="write-protected"):
        atomic_path(target).__enter__()
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(PermissionError, match="no permission to write in the folder"):
            atomic_path(tmp_path / "b.glb").__enter__()
    finally:
        tmp_path.chmod(0o755)


def test_existing_outputs_are_refused_unless_forced(tmp_path):
    old, new = tmp_path / "old.glb", tmp_path / "new.glb"
    old.write_bytes(b"")
    with pytest.raises(FileExistsError, match=r"``force``.*old\.glb"):
        refuse_existing([new, old], force=False)
    with pytest.raises(FileExistsError, match="and 1 more"):
        refuse_existing([old, tmp_path], force=False)
    refuse_existing([new, old], force=True)
    refuse_existing([new], force=False)
