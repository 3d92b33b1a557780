"""How many processors the control groups of this process allow: the limit of a container or a service."""

from __future__ import annotations

import posixpath
from pathlib import Path


def processor_quota(system: Path = Path("/")) -> float | None:
    """Processors whose time this process may use, by its control groups, of version 1 or 2, and all those
    around them; None without a limit. ``system``: the root of the file system.

    Where a runtime such as Docker limits processors (``--cpus``), the process may still run on all of them
    (``sched_getaffinity``), but is stopped for the rest of each period in which it has used up its time.
    """
    try:
        groups: dict[str, str] = {}
        for line in _lines(system / "proc/self/cgroup"):
            _, controllers, path = line.split(":", 2)
            groups |= dict.fromkeys(controllers.split(","), path)  # version 2 names no controller
        mounts = _lines(system / "proc/self/mountinfo")
    except (OSError, ValueError):
        return None
    found = []
    for line in mounts:
        place, _, kind = line.partition(" - ")
        version, _, options = kind.partition(" ")
        if version not in ("cgroup", "cgroup2"):
            continue
        controller = "cpu" if version == "cgroup" else ""
        if controller and controller not in options.split()[-1].split(","):
            continue
        root, point = place.split()[3:5]
        names = posixpath.relpath(groups.get(controller, root), root).split("/")
        if names[0] in (".", ".."):  # the group itself is mounted here, or one around it
            names = []
        folder = system / point.lstrip("/")
        for depth in range(len(names) + 1):
            quota = _quota(folder.joinpath(*names[:depth]))
            found += [] if quota is None else [quota]
    return min(found, default=None)


def _lines(file: Path) -> list[str]:
    """Of a file with names that may be in any encoding."""
    return file.read_text(encoding="utf-8", errors="surrogateescape").splitlines()


def _quota(group: Path) -> float | None:
    """The limit of the control group whose files are in the folder ``group``."""
    try:
        try:
            quota, period = (group / "cpu.max").read_text().split()  # "max 100000" without a limit
        except FileNotFoundError:
            quota = (group / "cpu.cfs_quota_us").read_text()  # -1 without a limit
            period = (group / "cpu.cfs_period_us").read_text()
        return int(quota) / int(period) if int(quota) > 0 and int(period) > 0 else None
    except (OSError, ValueError):
        return None
