"""Each wheel is built and installed alone into an empty environment, as a user would do it."""

import shutil
import subprocess
import sys
import venv

import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheels(tmp_path_factory, request):
    root = request.config.rootpath
    folder = tmp_path_factory.mktemp("wheels")
    for name in ("physx_core", "physx_dart", "physx_torch", "physx_rerun"):
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
        quiet = ("--quiet", "--disable-pip-version-check")
        run("-m", "pip", "install", *quiet, *constraints, *files, python=python)
        return python

    return install


def test_the_core_alone_generates_and_torch_adds_its_network(empty, run):
    python = empty("physx_core")
    generate = ("-m", "physx_core", "generate", "toy/spring", "--batch-nb", 2, "--batch-size", 10)
    assert "20 samples" in run(*generate, python=python).stdout
    train = (
        "-m", "physx_core", "train", "sessions/data_generation", "--epoch-nb", 1,
        "--batch-size", 5, "--network.network", "torch/fc", "--network.network-kwargs",
        "layers=[2,4,2]", "net_fields='state'", "opt_fields='next_state'",
        "--network.loss", "MSELoss", "--network.optimizer", "Adam",
    )  # fmt: skip
    missing = run(*train, python=python, ok=False)
    assert missing.returncode == 1 and "pip install physx-torch" in missing.stderr
    missing = run(
        "-m", "physx_core", "generate", "dart/arm", *generate[4:], python=python, ok=False
    )
    assert missing.returncode == 1 and "pip install physx-dart" in missing.stderr
    empty("physx_torch")
    assert "training loss" in run(*train, python=python).stdout


GENERATE = "--batch-nb 2 --batch-size 10"


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("physx_dart", f"generate dart/double-pendulum {GENERATE}"),
        ("physx_rerun", f"generate toy/spring {GENERATE} --environment.visualizer rerun"),
    ],
)
def test_each_plugin_works_with_its_dependencies_alone(name, command, empty, run):
    python = empty("physx_core", name)
    assert "20 samples" in run("-m", "physx_core", *command.split(), python=python).stdout
