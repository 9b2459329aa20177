"""Memory and cores that are available to this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

__all__ = ["available_cores", "available_memory", "resident_memory"]

_CGROUPS = Path("/sys/fs/cgroup")
_CGROUP_QUOTA = _CGROUPS / "cpu.max"
_PROC = Path("/proc")


def available_cores() -> int:
    """Cores that this process may use: its affinity, and the quota of its control group where there is one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = _CGROUP_QUOTA.read_text().split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, int(quota) // int(period)))


def available_memory() -> int:
    """Bytes that this process may take in addition to what it has.

    The least of what the kernel reckons available on the machine and of what is left in each control group, version 1
    or 2, that the process is in; files in a group's cache do not count as used.  Where the kernel tells nothing it is
    all memory.
    """
    return int(max(0, min([_machine_memory(), *(_group_memory(*group) for group in _memory_groups())])))


def resident_memory() -> int:
    """Bytes that this process uses now; where the kernel does not report it, the most that it has ever used."""
    try:
        return int((_PROC / "self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        import resource

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


def _machine_memory() -> int:
    """MemAvailable, or the size of the memory."""
    kilobytes = _table(_PROC / "meminfo").get("MemAvailable:")
    if kilobytes is not None:
        return kilobytes * 1024
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _memory_groups() -> Iterator[tuple[Path, str, str, str]]:
    """Yield (folder, file of the limit, file of the use, name of the cache's size) of each group of this process."""
    try:
        lines = (_PROC / "self/cgroup").read_text().split("\n")
    except OSError:
        return
    for line in filter(None, lines):
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            root, names = _CGROUPS, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = _CGROUPS / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        inner = Path(path.strip("/"))  # inside a container the path may be that of the world outside
        for folder in (inner, *inner.parents):
            yield root / folder, *names


def _group_memory(folder, limit, use, cache) -> float:
    """Bytes left in one group, infinite where it has no limit."""
    try:
        most, used = (folder / limit).read_text().strip(), int((folder / use).read_text())
    except (OSError, ValueError):
        return float("inf")
    if most == "max":
        return float("inf")
    return int(most) - used + _table(folder / "memory.stat").get(cache, 0)


def _table(path) -> dict[str, int]:
    """Lines 'name number …' of a kernel's file."""
    try:
        words = (line.split() for line in path.read_text().splitlines())
        return {word[0]: int(word[1]) for word in words if len(word) > 1}
    except (OSError, ValueError):
        return {}
