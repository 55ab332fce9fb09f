"""Describes the installation for `physx doctor`: versions, plugins, drivers, and problems."""

from __future__ import annotations

import contextlib
import ctypes.util
import importlib.util
import os
import platform
import re
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import Distribution, distributions
from pathlib import Path

from physx_core import plugins
from physx_core.plugins.entries import unmet_requirements

_SHOWN = (
    *("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "CONDA_PREFIX", "ROS_DISTRO", "LD_LIBRARY_PATH"),
    *("DISPLAY", "WAYLAND_DISPLAY", "VK_DRIVER_FILES", "VK_ICD_FILENAMES", "CUDA_VISIBLE_DEVICES"),
    *("OMP_NUM_THREADS", "RANK", "WORLD_SIZE", "SLURM_JOB_ID", "TMPDIR"),
)
_FEW_FILES = 1024
_DRIVERS = ("/usr/share/vulkan", "/usr/local/share/vulkan", "/etc/vulkan")


@dataclass(frozen=True)
class Package:
    """An installed distribution.

    Attributes:
        name: Its name.
        version: Its version, or the problem with its metadata.
        place: Folder that its module is imported from.
        problems: Conflicts and defects, one sentence each.
    """

    name: str
    version: str
    place: str
    problems: tuple[str, ...] = ()


def describe_machine() -> dict[str, str]:
    """Return a description of interpreter, system, processors, and memory, by name."""
    pages = 0
    with contextlib.suppress(ValueError, OSError):
        pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    kind = "virtual environment" if sys.prefix != sys.base_prefix else "no virtual environment"
    return {
        "python": f"{platform.python_version()}, {sys.executable} ({kind})",
        "system": platform.platform(),
        "processors": f"{usable} usable of {os.cpu_count()}",
        "memory": f"{pages / 2**30:.1f} GiB",
    }


def describe_drivers(variables: Mapping[str, str], root: Path = Path("/")) -> dict[str, str]:
    """Return what is available for graphics and computing: display, Vulkan, graphics cards.

    Args:
        variables: The environment variables.
        root: The root folder of the system.
    """
    display = variables.get("WAYLAND_DISPLAY") or variables.get("DISPLAY")
    cards = sorted(
        str(path)
        for pattern in ("dev/nvidia[0-9]*", "dev/dri/renderD*", "dev/kfd")
        for path in root.glob(pattern)
    )
    version = ""
    with contextlib.suppress(OSError):
        told = (root / "proc/driver/nvidia/version").read_text(encoding="utf-8", errors="replace")
        found = re.search(r"\b\d+\.\d+(\.\d+)?\b", told)
        version = f", NVIDIA driver {found[0]}" if found else ""
    models = [
        match[1]
        for path in sorted(root.glob("proc/driver/nvidia/gpus/*/information"))
        if (match := re.search(r"^Model:\s*(.+)$", path.read_text(errors="replace"), re.MULTILINE))
    ]
    return {
        "display": display or "none: no viewer windows; images, files, and web pages work",
        "vulkan": _describe_vulkan(variables, root),
        "cards": ", ".join([*cards, *models] or ["none"]) + version,
    }


def _describe_vulkan(variables: Mapping[str, str], root: Path) -> str:
    chosen = variables.get("VK_DRIVER_FILES") or variables.get("VK_ICD_FILENAMES")
    if chosen:
        files = [Path(each) for each in chosen.split(os.pathsep) if Path(each).is_file()]
    else:
        folders = (root / f"{folder[1:]}/icd.d" for folder in _DRIVERS)
        files = [path for folder in folders for path in sorted(folder.glob("*.json"))]
    names = ", ".join(path.stem.removesuffix(".x86_64") for path in files)
    if not names:
        return "no driver: images need one, for example apt install mesa-vulkan-drivers"
    if ctypes.util.find_library("vulkan") is None:
        return f"{names}, but no loader: apt install libvulkan1"
    return names


def describe_disk(folder: Path) -> dict[str, str]:
    """Return how large and how fast a folder's disk is, by name.

    Args:
        folder: Where 64 MiB are written, and removed again.
    """
    free = f"{shutil.disk_usage(folder).free / 2**30:.1f} GiB free"
    block = os.urandom(2**20)  # of what no disk can compress
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            began = time.perf_counter()
            for _ in range(64):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
            seconds = time.perf_counter() - began
            began = time.perf_counter()
            for _ in range(8):
                os.pwrite(file.fileno(), block[:4096], 0)
                os.fsync(file.fileno())
            sync = (time.perf_counter() - began) / 8
    except OSError as error:
        return {"space": free, "speed": f"nothing can be written here: {error}"}
    speed = f"{64 / seconds:.0f} MiB/s written; {1000 * sync:.1f} ms for a row to be safe"
    return {"space": free, "speed": speed}


def describe_limits() -> dict[str, str]:
    """Return how much of what a run needs this process may use, by name."""
    limits = {"open files": resource.RLIMIT_NOFILE, "processes": resource.RLIMIT_NPROC}
    found = {name: resource.getrlimit(number)[0] for name, number in limits.items()}
    texts = {
        name: "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
        for name, limit in found.items()
    }
    if 0 <= found["open files"] < _FEW_FILES:
        texts["open files"] += ": few for a run with many clients; ulimit -n 4096 allows more"
    with contextlib.suppress(OSError):
        shared = shutil.disk_usage("/dev/shm")
        texts["/dev/shm"] = f"{shared.free / 2**30:.1f} GiB free of {shared.total / 2**30:.1f}"
    return texts


def describe_variables(variables: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that affect physx; secrets only by name."""
    return {
        name: "(set)" if "TOKEN" in name or "KEY" in name else text
        for name, text in sorted(variables.items())
        if name in _SHOWN or name.startswith(("PHYSX_", "RERUN_"))
    }


def find_packages() -> list[Package]:
    """Return the packages of physx and of plugins, and the libraries that they require."""
    found: dict[str, list[Distribution]] = {}
    for each in distributions():
        with contextlib.suppress(Exception):  # a foreign package's file: `physx plugins` reports it
            found.setdefault(_normal(each.metadata["Name"]), []).append(each)
    claims = [claim for info in plugins.available().values() for claim in info.distributions]
    owners = [claim.split()[0] for claim in claims]
    physx = sorted({*(name for name in found if name.startswith("physx-")), *map(_normal, owners)})
    libraries = {name for owner in physx for name in _required(found.get(owner, []))}
    names = [*physx, *sorted(libraries - set(physx))]
    described = [_describe(name, found[name]) for name in names if name in found]
    return [
        replace(each, problems=(*each.problems, *unmet_requirements(found[each.name][0])))
        if each.name in physx
        else each
        for each in described
    ]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _required(packages: Sequence[Distribution]) -> Iterator[str]:
    for line in (packages[0].requires or []) if packages else []:
        name = re.match(r"[\w.-]+", line)
        if name:
            yield _normal(name[0])


def _describe(name: str, packages: Sequence[Distribution]) -> Package:
    """Describe a package; the first of several is the one that Python imports."""
    first = packages[0]
    places, problems = [], []
    modules = _modules(first)
    if not modules and not _has_files(first):
        problems.append("its files are missing: reinstall it")
    for module, expected in modules:
        actual = _origin(module)
        if actual is not None and actual.resolve() not in {each.resolve() for each in expected}:
            problems.append(f"import {module} loads {actual}, not {expected[0]}")
        places += [str(actual.parent)] if actual else []
    for other in packages[1:]:
        folder, hidden = first.locate_file(""), other.locate_file("")
        if Path(str(folder)).resolve() != Path(str(hidden)).resolve():
            problems.append(f"{_version(first)} hides {_version(other)} in {hidden}")
    place = places[0] if places else str(first.locate_file(""))
    return Package(name, _version(first), place, tuple(problems))


def _version(package: Distribution) -> str:
    try:
        return str(package.version)
    except Exception as error:  # its metadata is damaged
        return f"without a version ({type(error).__name__})"


def _modules(package: Distribution) -> list[tuple[str, list[Path]]]:
    """Return a package's modules, each with the locations where it may be."""
    found: dict[str, list[Path]] = {}
    for file in package.files or []:
        place = Path(str(package.locate_file(file)))
        if file.suffix == ".pth" and len(file.parts) == 1:
            for module, path in _linked(place):
                found.setdefault(module, []).append(path)
        elif (
            file.name == "__init__.py"
            and place.is_file()
            and file.parent.parent.name
            in (
                "",
                "site-packages",
            )
        ):
            found.setdefault(file.parent.name, []).append(place.parent)  # nested one: from cmeel
    return [(name, found[name]) for name in sorted(found) if name.isidentifier()]


def _has_files(package: Distribution) -> bool:
    """Return whether a package has files other than metadata, links, and scripts."""
    files = [
        file for file in package.files or [] if file.parts[0] != ".." and file.suffix != ".pth"
    ]
    contents = [file for file in files if not file.parts[0].endswith((".dist-info", ".egg-info"))]
    return any(Path(str(package.locate_file(file))).exists() for file in contents)


def _linked(file: Path) -> Iterable[tuple[str, Path]]:
    """Return the packages in the folders named by the .pth file of an editable install."""
    with contextlib.suppress(OSError):
        for line in file.read_text(encoding="utf-8").splitlines():
            if not line.startswith("import ") and Path(line).is_dir():
                for path in sorted(Path(line).glob("*/__init__.py")):
                    yield path.parent.name, path.parent


def _origin(module: str) -> Path | None:
    """Return the folder of a module without importing it."""
    if (loaded := sys.modules.get(module)) is not None and getattr(loaded, "__file__", None):
        return Path(str(loaded.__file__)).parent
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    if spec is None or not (spec.origin or spec.submodule_search_locations):
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(str(spec.origin))
