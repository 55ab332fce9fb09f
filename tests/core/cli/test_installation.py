"""What `physx doctor` tells of the installation: what a report of a bug needs."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from wide_lines import wide_lines

from physx_core import __version__
from physx_core.cli import installation

pytestmark = pytest.mark.processes


def doctor(**variables):
    """Return what the command prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "physx_core", "doctor"],
        env={**os.environ, **{name: str(text) for name, text in variables.items()}},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def package(folder, name, version, files=(), entries=""):
    """Install a package into a folder, as a copy would be on PYTHONPATH."""
    place = folder / f"{name}-{version}.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (place / "RECORD").write_text("".join(f"{file},,\n" for file in files))
    if entries:
        (place / "entry_points.txt").write_text(entries)
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()


def test_it_names_interpreter_versions_and_places():
    text = doctor(PHYSX_TOKEN="0123secret", PHYSX_IMPORT_TIMEOUT="50", COLUMNS="")
    assert sys.executable in text and __version__ in text
    assert "physx-core" in text and "numpy" in text
    assert "vulkan" in text and "display" in text
    assert "conflicts: none" in text
    assert "toy  (physx-core" in text and "broken" not in text
    assert "0123secret" not in text and "PHYSX_IMPORT_TIMEOUT  50" in text
    assert wide_lines(text) == []


def test_a_module_in_another_place_is_named(tmp_path):
    pytest.importorskip("zarr")
    (tmp_path / "zarr").mkdir()
    (tmp_path / "zarr/__init__.py").touch()
    text = doctor(PYTHONPATH=tmp_path, ROS_DISTRO="humble")
    assert f"zarr: import zarr loads {tmp_path / 'zarr'}, not " in text
    assert f"PYTHONPATH   {tmp_path}" in text and "ROS_DISTRO   humble" in text


def test_an_older_copy_that_comes_first_is_named(tmp_path):
    pytest.importorskip("zarr")
    package(tmp_path, "zarr", "0.1", ["zarr/__init__.py"])
    assert "zarr: 0.1 hides " in doctor(PYTHONPATH=tmp_path)


def test_a_broken_plugin_and_a_package_without_its_files_are_named(tmp_path):
    package(tmp_path, "bad", "2.0", ["bad/__init__.py"], "[physx]\nbad = bad.plugin\n")
    (tmp_path / "bad/__init__.py").unlink()
    text = doctor(PYTHONPATH=tmp_path)
    assert "bad: its files are missing: reinstall it" in text
    assert "bad  (bad 2.0)\n  broken: " in text


def test_drivers_are_found_where_a_system_has_them(tmp_path, monkeypatch):
    monkeypatch.setattr(installation.ctypes.util, "find_library", lambda name: "libvulkan.so.1")
    none = installation.describe_drivers({}, tmp_path)
    assert none["cards"] == "none" and "mesa-vulkan-drivers" in none["vulkan"]
    assert none["display"].startswith("none")
    for file in ("dev/nvidia0", "dev/dri/renderD128", "proc/driver/nvidia/version"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(
            "NVRM version: NVIDIA UNIX x86_64 Kernel Module  570.86.10  Jan"
        )
    (tmp_path / "etc/vulkan/icd.d").mkdir(parents=True)
    (tmp_path / "etc/vulkan/icd.d/lvp_icd.x86_64.json").touch()
    found = installation.describe_drivers({"DISPLAY": ":1"}, tmp_path)
    assert found["display"] == ":1" and found["vulkan"] == "lvp_icd"
    assert "nvidia0" in found["cards"] and "renderD128" in found["cards"]
    assert found["cards"].endswith("NVIDIA driver 570.86.10")
    chosen = {"VK_DRIVER_FILES": str(tmp_path / "none.json")}
    assert "no driver" in installation.describe_drivers(chosen, tmp_path)["vulkan"]
