"""MuJoCo is installed as a package of its own, and selected by name."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset

pytestmark = pytest.mark.processes

pytest.importorskip("mujoco")

ROOT = Path(__file__).parents[2]
ENGINE = ROOT / "examples/mujoco_engine"

COMPARE = """
import json, sys
import numpy as np
from physx_core import plugins
from physx_sim import Robot, World
found = {}
for engine in ("dart", "mujoco"):
    with plugins.resolve("backend", engine).build(World([Robot("cartpole")])) as simulation:
        simulation.set_state([0.0, 0.3], [0.0, 0.0])
        simulation.step(200)
        found[engine] = simulation.positions().tolist()
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install the engine into a folder; return the environment variables to find it."""
    folder = tmp_path_factory.mktemp("packages")
    command = [
        *(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"),
        *("--disable-pip-version-check", "--target", str(folder), str(ENGINE)),
    ]
    subprocess.run(command, check=True, timeout=300)
    return {**os.environ, "PYTHONPATH": str(folder)}


@pytest.fixture
def run(installed, tmp_path):
    """Run Python in the test's folder and return what it printed."""

    def run(*words):
        command = [sys.executable, *map(str, words)]
        done = subprocess.run(
            command, cwd=tmp_path, env=installed, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_it_is_found_by_its_name(run):
    listing = run("-m", "physx_core", "plugins")
    assert "mujoco  (physx-mujoco 0.1.0)" in listing
    assert "backend: mujoco/mujoco" in listing
    found = json.loads(run("-c", COMPARE))
    np.testing.assert_allclose(found["mujoco"], found["dart"], rtol=1e-9)


def test_an_environment_generates_samples_with_it_in_clients(run, tmp_path):
    pytest.importorskip("gymnasium")
    words = ("generate", "gym/physx/Cartpole-v0", "--environment.env-kwargs")
    sizes = ("--batch-nb", 3, "--batch-size", 20, "--environment.num-clients", 2)
    for engine in ("mujoco", "dart"):
        options = (f"backend={engine}", *sizes, "--environment.seed", 1)
        run("-m", "physx_core", *words, *options, "--session-name", engine)
    rows = {}
    for engine in ("mujoco", "dart"):
        with Dataset.open(tmp_path / "sessions" / engine / "dataset") as dataset:
            mode = dataset["training"]
            rows[engine] = {name: mode[name][:] for name in dataset.fields("training")}
    assert rows["mujoco"].keys() == rows["dart"].keys()
    for name, values in rows["mujoco"].items():
        assert len(values) == 60
        np.testing.assert_allclose(values, rows["dart"][name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_it_keeps_the_contract_of_engines(run):
    (report,) = json.loads(run("-m", "physx_core", "check", "mujoco", "--json"))["reports"]
    skipped = {each["name"] for each in report["checks"] if each["status"] == "skipped"}
    assert report["component"] == "mujoco/mujoco" and report["ok"]
    assert report["counts"]["failed"] == report["counts"]["expected"] == 0
    assert report["counts"]["passed"] > 30
    assert skipped == {
        "has derivatives that agree with finite differences",
        "bounces by its restitution",
        "hits with rays",
    }


def test_it_is_small_and_imports_faces_only():
    files = sorted(ENGINE.rglob("*.py"))
    texts = [file.read_text() for file in (*files, ENGINE / "pyproject.toml")]
    assert len(files) > 4
    assert sum(bool(line.strip()) for text in texts for line in text.splitlines()) <= 650
    faces = {
        "physx_core": ({"errors"}, {"plugins"}, {"rotations"}, {"typing"}),
        "physx_sim": (set(), {"engines"}, {"errors"}),
        "physx_mujoco": None,
    }
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("physx_"):
                package, *rest = (node.module or "").split(".")
                assert faces[package] is None or set(rest) in faces[package], file
