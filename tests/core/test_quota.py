"""Limits of processors by control groups, on file systems made up for it."""

from __future__ import annotations

import pytest

from meshsplats._core import library
from meshsplats._core.quota import processor_quota

V2 = "31 23 0:28 / /sys/fs/cgroup rw,relatime - cgroup2 cgroup2 rw,nsdelegate\n"
V1 = "32 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw,relatime shared:9 - cgroup cgroup rw,cpu,cpuacct\n"
OTHERS = "21 1 8:1 / / rw - ext4 /dev/sda1 rw\n22 21 0:5 / /odd rw - fuse  rw\n23 21 0:5 / /odder rw -\n"
HYBRID = "41 31 0:38 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw\n"


def system(folder, own, mounts, files):
    """A file system whose process is in the control groups ``own``."""
    everything = {"proc/self/cgroup": own, "proc/self/mountinfo": OTHERS + mounts, **files}
    for name, text in everything.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def v1(folder, quota, period=100_000):
    return {f"{folder}/cpu.cfs_quota_us": f"{quota}\n", f"{folder}/cpu.cfs_period_us": f"{period}\n"}


@pytest.mark.parametrize(
    ("own", "mounts", "files", "expected"),
    [
        ("0::/\n", V2, {"sys/fs/cgroup/cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", V2, {"sys/fs/cgroup/cpu.max": "150000 100000\n"}, 1.5),
        ("0::/\n", V2, {"sys/fs/cgroup/cpu.max": "max 100000\n"}, None),
        ("0::/\n", V2, {"sys/fs/cgroup/cpu.max": "nonsense\n"}, None),
        ("0::/\n", V2, {}, None),
        ("nonsense\n", V2, {"sys/fs/cgroup/cpu.max": "200000 100000\n"}, None),
        # That of a service, within a slice with less; and a limit of the group around it alone.
        (
            "0::/user.slice/job.service\n",
            V2,
            {
                "sys/fs/cgroup/user.slice/job.service/cpu.max": "800000 100000\n",
                "sys/fs/cgroup/user.slice/cpu.max": "300000 100000\n",
                "sys/fs/cgroup/other/cpu.max": "100000 100000\n",
            },
            3,
        ),
        ("0::/a/b\n", V2, {"sys/fs/cgroup/a/cpu.max": "300000 100000\n"}, 3),
        # Version 1: a container without a view of its own has its group mounted as the root.
        ("4:memory:/x\n1:cpu,cpuacct:/\n", V1, v1("sys/fs/cgroup/cpu,cpuacct", 250_000), 2.5),
        ("1:cpu,cpuacct:/\n", V1, v1("sys/fs/cgroup/cpu,cpuacct", -1), None),
        ("1:cpu,cpuacct:/a\n", V1, v1("sys/fs/cgroup/cpu,cpuacct/a", 50_000, 25_000), 2),
        (
            "1:cpu,cpuacct:/docker/1234\n",
            V1.replace(" / /sys", " /docker/1234 /sys"),
            v1("sys/fs/cgroup/cpu,cpuacct", 400_000),
            4,
        ),
        (
            "1:cpu,cpuacct:/docker/1234/job\n",
            V1.replace(" / /sys", " /docker/1234 /sys"),
            v1("sys/fs/cgroup/cpu,cpuacct", 400_000) | v1("sys/fs/cgroup/cpu,cpuacct/job", 300_000),
            3,
        ),
        # A process that was moved out of what it sees.
        ("0::/../elsewhere\n", V2, {"sys/fs/cgroup/cpu.max": "200000 100000\n"}, 2),
        # Both: the controller is of version 1.
        ("1:cpu,cpuacct:/a\n0::/a\n", V1 + HYBRID, v1("sys/fs/cgroup/cpu,cpuacct/a", 100_000), 1),
    ],
)
def test_the_least_limit_around_a_process_holds(tmp_path, own, mounts, files, expected):
    assert processor_quota(system(tmp_path, own, mounts, files)) == expected


def test_names_of_mounts_may_be_in_any_encoding(tmp_path):
    system(tmp_path, "0::/\n", V2, {"sys/fs/cgroup/cpu.max": "200000 100000\n"})
    with (tmp_path / "proc/self/mountinfo").open("ab") as file:
        file.write("24 21 8:2 / /media/Übung rw - vfat /dev/sdb1 rw\n".encode("latin-1"))
    assert processor_quota(tmp_path) == 2


def test_systems_without_control_groups_have_no_limit(tmp_path):
    assert processor_quota(tmp_path) is None


@pytest.mark.parametrize(("quota", "expected"), [(None, 16), (0.5, 1), (2.0, 2), (2.5, 3), (64.0, 16)])
def test_parts_of_a_processor_count_as_one(monkeypatch, quota, expected):
    monkeypatch.setattr(library.os, "sched_getaffinity", lambda process: range(16), raising=False)
    monkeypatch.setattr(library, "_quota", lambda: quota)
    assert library.processors() == expected
    assert library.thread_count(None) == expected
    assert library.thread_count(9) == 9
