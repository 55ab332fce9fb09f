"""Each wheel is built and installed into an empty environment, as a user would do it."""

import json
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import filelock
import pytest

pytestmark = pytest.mark.slow

PACKAGES = (
    *("physx_core", "physx_dart", "physx_torch", "physx_rerun", "physx_gym", "physx_remote"),
    "physx_cluster",
)
PHYSX = ("-m", "physx_core")
GENERATE = "--batch-nb 2 --batch-size 10"
SERVE = """
import threading
from physx_remote import connect, serve

service = serve("CartPole-v1")
threading.Thread(target=service.run, daemon=True).start()
with connect("{}:{}".format(*service.address), token=service.token) as env:
    env.reset(seed=0)
    print(env.step(1)[1], "reward")
"""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory, request):
    """Folder of the wheels, built once for all processes that run tests."""
    root, own = request.config.rootpath, tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "wheels"
    with filelock.FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            build_wheels(root, own / "building").rename(folder)
    return folder


def build_wheels(root, folder):
    for name in PACKAGES:
        source = shutil.copytree(root / name, folder / "src" / name)
        command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", folder, source]
        subprocess.run(list(map(str, command)), check=True, capture_output=True)
    return folder


@pytest.fixture
def empty(tmp_path, run, wheels, root):
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv/bin/python"

    def install(*names):
        files = [next(wheels.glob(f"{name}-*.whl")) for name in names]
        constraints = ("-c", root / "constraints.txt")
        quiet = ("--quiet", "--disable-pip-version-check", "--no-compile")
        run("-m", "pip", "install", *quiet, *constraints, *files, python=python)
        return python

    return install


def test_the_core_alone_generates_and_trains_and_torch_adds_its_network(empty, run, wheels):
    python = empty("physx_core")
    listed = json.loads(run("-m", "pip", "list", "--format", "json", python=python).stdout)
    folder = run(*PHYSX, "include", python=python).stdout.strip()
    assert {"physx.h", "physx.f90"} < {path.name for path in Path(folder).iterdir()}
    foreign = {"gymnasium", "torch", "dartpy", "pin", "rerun-sdk"}
    assert not foreign & {package["name"] for package in listed}
    generate = (*PHYSX, "generate", "toy/spring", "--batch-nb", 2, "--batch-size", 10)
    assert "20 training" in run(*generate, python=python).stderr

    def pip(name):
        return f"pip install {next(wheels.glob(f'{name}-*.whl'))}"

    def train(network, *options, ok=True):
        words = (*PHYSX, "train", "sessions/data_generation", "--epoch-nb", 1, "--batch-size", 5)
        return run(*words, "--network.network", network, *options, python=python, ok=ok)

    arguments = ("--network.network-kwargs", "net_fields=['state','force']")
    assert "training loss" in train("toy/linear", *arguments).stderr
    fc = (
        "torch/fc", "--network.network-kwargs",
        "layers=[2,4,2]", "net_fields='state'", "opt_fields='next_state'",
        "--network.loss", "MSELoss", "--network.optimizer", "Adam",
    )  # fmt: skip
    missing = train(*fc, ok=False)
    assert missing.returncode == 1 and pip("physx_torch") in missing.stderr
    missing = run(*PHYSX, "generate", "dart/arm", *generate[4:], python=python, ok=False)
    assert missing.returncode == 1 and pip("physx_dart") in missing.stderr
    missing = run(*PHYSX, "serve", python=python, ok=False)
    assert missing.returncode == 1 and pip("physx_remote") in missing.stderr
    empty("physx_torch")
    assert "training loss" in train(*fc).stderr


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("physx_dart", f"generate dart/double-pendulum {GENERATE}"),
        ("physx_rerun", f"generate toy/spring {GENERATE} --environment.visualizer rerun"),
        ("physx_gym", f"generate gym/CartPole-v1 {GENERATE}"),
    ],
)
def test_each_plugin_works_with_the_core_alone(name, command, empty, run):
    python = empty("physx_core", name)
    assert "20 training" in run(*PHYSX, *command.split(), python=python).stderr


def test_remote_works_with_the_core_alone(empty, run, tmp_path):
    python = empty("physx_core", "physx_remote")
    (tmp_path / "program.py").write_text(SERVE)
    assert "1.0 reward" in run("program.py", python=python).stdout


def test_the_plugin_of_clusters_works_with_the_core_alone(empty, run):
    python = empty("physx_core", "physx_cluster")
    words = ("generate", "toy/spring", *GENERATE.split(), "--environment.launcher")
    for name, library in (("cluster/ray", "Ray"), ("cluster/slurm", "submitit")):
        missing = run(*PHYSX, *words, name, python=python, ok=False)
        assert missing.returncode == 1
        assert f"needs {library}" in missing.stderr
        assert "physx_cluster" in missing.stderr and "pip install" in missing.stderr
