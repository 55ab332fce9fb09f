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
CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"
OPTIONS = ("--quiet", "--no-compile", "-c", CONSTRAINTS)
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


@pytest.fixture(scope="module")
def python(tmp_path_factory, wheels):
    """The interpreter of an environment that holds the core alone."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    pip(folder / "bin/python", "install", *OPTIONS, next(wheels.glob("physx_core-*.whl")))
    return folder / "bin/python"


@pytest.fixture
def add(python, wheels):
    """Install a package beside the core; it goes after the test, with all that came with it."""
    before = installed(python)
    yield lambda name: pip(python, "install", *OPTIONS, next(wheels.glob(f"{name}-*.whl")))
    pip(python, "uninstall", "--quiet", "--yes", *sorted(installed(python) - before))


def pip(python, command, *words):
    """Have the pip of this environment work on another one, which then needs none."""
    line = [sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check"]
    done = subprocess.run(
        list(map(str, [*line, command, *words])), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def installed(python):
    """Return the names of all packages of an environment."""
    return {package["name"] for package in json.loads(pip(python, "list", "--format", "json"))}


FC = (
    "torch/fc", "--network.network-kwargs",
    "layers=[2,4,2]", "net_fields='state'", "opt_fields='next_state'",
    "--network.loss", "MSELoss", "--network.optimizer", "Adam",
)  # fmt: skip


def generate(run, python):
    return run(*PHYSX, "generate", "toy/spring", *GENERATE.split(), python=python).stderr


def train(run, python, network, *options, ok=True):
    words = (*PHYSX, "train", "sessions/data_generation", "--epoch-nb", 1, "--batch-size", 5)
    return run(*words, "--network.network", network, *options, python=python, ok=ok).stderr


def test_the_core_alone_generates_and_trains(python, run, wheels):
    folder = run(*PHYSX, "include", python=python).stdout.strip()
    assert {"physx.h", "physx.f90"} < {path.name for path in Path(folder).iterdir()}
    foreign = {"gymnasium", "torch", "dartpy", "pin", "rerun-sdk"}
    assert not foreign & installed(python)
    assert "20 training" in generate(run, python)

    def hint(name):
        return f"pip install {next(wheels.glob(f'{name}-*.whl'))}"

    arguments = ("--network.network-kwargs", "net_fields=['state','force']")
    assert "training loss" in train(run, python, "toy/linear", *arguments)
    assert hint("physx_torch") in train(run, python, *FC, ok=False)
    missing = run(*PHYSX, "generate", "dart/arm", *GENERATE.split(), python=python, ok=False)
    assert missing.returncode == 1 and hint("physx_dart") in missing.stderr
    missing = run(*PHYSX, "serve", python=python, ok=False)
    assert missing.returncode == 1 and hint("physx_remote") in missing.stderr


@pytest.mark.faults
def test_torch_adds_its_network(python, add, run):
    generate(run, python)
    add("physx_torch")
    assert "training loss" in train(run, python, *FC)


@pytest.mark.faults
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("physx_dart", f"generate dart/double-pendulum {GENERATE}"),
        ("physx_rerun", f"generate toy/spring {GENERATE} --environment.visualizer rerun"),
        ("physx_gym", f"generate gym/CartPole-v1 {GENERATE}"),
    ],
)
def test_each_plugin_works_with_the_core_alone(name, command, python, add, run):
    add(name)
    assert "20 training" in run(*PHYSX, *command.split(), python=python).stderr


def test_remote_works_with_the_core_alone(python, add, run, tmp_path):
    add("physx_remote")
    (tmp_path / "program.py").write_text(SERVE)
    assert "1.0 reward" in run("program.py", python=python).stdout


def test_the_plugin_of_clusters_works_with_the_core_alone(python, add, run):
    add("physx_cluster")
    words = ("generate", "toy/spring", *GENERATE.split(), "--environment.launcher")
    for name, library in (("cluster/ray", "Ray"), ("cluster/slurm", "submitit")):
        missing = run(*PHYSX, *words, name, python=python, ok=False)
        assert missing.returncode == 1
        assert f"needs {library}" in missing.stderr
        assert "physx_cluster" in missing.stderr and "pip install" in missing.stderr
