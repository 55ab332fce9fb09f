"""The distributions of the project have one version, which their packages read when asked."""

from __future__ import annotations

import importlib
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.parent.name for path in ROOT.glob("physx*/pyproject.toml"))


def test_all_distributions_have_the_same_version():
    assert len(PACKAGES) >= 7
    written = {
        name: tomllib.loads((ROOT / name / "pyproject.toml").read_text())["project"]["version"]
        for name in PACKAGES
    }
    assert len(set(written.values())) == 1, written


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_reads_its_version_from_the_metadata(name):
    package = pytest.importorskip("physx_demo" if name == "physx" else name)
    assert package.__version__ == version(name.replace("_", "-"))
    assert "__version__" in dir(package)


def test_the_version_is_read_when_it_is_asked_for():
    code = "import sys, physx_core; print('importlib.metadata' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"
    assert importlib.import_module("physx_core").__version__
