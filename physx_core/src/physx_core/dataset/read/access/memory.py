"""Determines how much memory this process may still allocate."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from pathlib import Path

_PROC = Path("/proc")
_CGROUPS = Path("/sys/fs/cgroup")
_SHARE = 0.5


def available_memory() -> int:
    """Return the number of bytes of memory this process may still allocate.

    Memory that only caches files counts as free. In addition to the machine's memory, the process's
    control groups (version 1 or 2) and address-space limit (``ulimit -v``) apply.
    """
    bounds = [_machine(), *_control_groups()]
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        pages = (_PROC / "self/statm").read_text(encoding="ascii").split()[0]
        bounds.append(limit - int(pages) * resource.getpagesize())
    return max(0, min(bounds))


def memory_budget() -> int:
    """Return the number of bytes of memory that rows may take now."""
    return int(_SHARE * available_memory())


def _machine() -> int:
    try:
        lines = _entries((_PROC / "meminfo").read_text(encoding="ascii").replace(":", " "))
        return lines["MemAvailable"] * 1024
    except (OSError, KeyError):  # not Linux
        return os.sysconf("SC_PHYS_PAGES") * resource.getpagesize()


def _control_groups() -> Iterator[int]:
    """Yield the number of bytes left in each limited control group of this process."""
    try:
        lines = (_PROC / "self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            root, limit, usage, prefix = _CGROUPS, "memory.max", "memory.current", ""
        elif "memory" in controllers.split(","):
            root, prefix = _CGROUPS / "memory", "total_"
            limit, usage = "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        inner = root / path.lstrip("/")
        for folder in (inner, *inner.parents):
            if folder.is_relative_to(root) and (folder / limit).is_file():
                yield from _left(folder, limit, usage, prefix)


def _left(folder: Path, limit: str, usage: str, prefix: str) -> Iterator[int]:
    most = (folder / limit).read_text(encoding="ascii").strip()
    if not most.isdigit():  # "max"
        return
    try:
        used = int((folder / usage).read_text(encoding="ascii"))
        lines = _entries((folder / "memory.stat").read_text(encoding="ascii"))
    except OSError:  # the outermost group has no usage
        yield int(most)
        return
    cached = sum(lines.get(f"{prefix}{kind}_file", 0) for kind in ("active", "inactive"))
    yield int(most) - max(0, used - cached)


def _entries(text: str) -> dict[str, int]:
    """Return the lines ``name number ...`` of a text."""
    words = (line.split() for line in text.splitlines())
    return {parts[0]: int(parts[1]) for parts in words if len(parts) > 1 and parts[1].isdigit()}
