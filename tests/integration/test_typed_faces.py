"""The packages' faces are typed: no public name or call is `Any` to a user's type checker."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

for library in ("mypy", "torch", "rerun", "gymnasium"):
    pytest.importorskip(library)

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "core",
    "sim",
    "testing",
    "formats",
    "dart",
    "torch",
    "rerun",
    "gym",
    "remote",
    "cluster",
)
CALLS = {
    'connect("host:1")': "PhysxEnv",
    'connect("host:1", "godot-gym", repeat_action=2)': "GodotGymEnv",
    'connect("host:1", "godot-rl")': "GodotRLEnv",
    'connect("host:1", str())': "Env[Any, Any]",
    'connect_vector("host:1")': "PhysxVectorEnv",
    'connect_vector("host:1", "godot-rl")': "GodotRLVectorEnv",
    'serve("gym/CartPole-v1").token': "str",
    'serve("gym/CartPole-v1", "godot-rl")': "Service",
    'Dataset.open("folder")': "Dataset",
    'Dataset.open("folder")["training"]["x"][0:2]': "ndarray[tuple[Any, ...], dtype[Any]]",
    'plugins.resolve("environment", "dart/arm")()': "Environment",
    'plugins.resolve("network", "torch/fc")()': "Network",
    "plugins.available()": "dict[str, PluginInfo]",
    'World(robots=[Robot("arm.urdf")])': "World",
    "World().period": "float",
    'EnvironmentConfig("toy/spring").num_clients': "int",
    'Field("x").name': "str",
    "RobotEnv.step_dt": "float",
    'StoredDataset("folder")': "StoredDataset",
}
HEADER = """
from physx_core import Dataset, EnvironmentConfig, Field, plugins
from physx_sim import Robot, World
from physx_gym import Policy, RobotEnv
from physx_remote import connect, connect_vector, serve
from physx_torch import StoredDataset
"""


pytestmark = [pytest.mark.slow, pytest.mark.processes]


def reveal(folder):
    """Return text to the type that mypy reveals of it, for all public names and for `CALLS`."""
    sources = [ROOT / f"physx_{name}" / "src" for name in PACKAGES]
    lines, texts = [], []
    for source, package in zip(sources, PACKAGES, strict=True):
        face = source / f"physx_{package}"
        assert (face / "py.typed").exists()
        names = re.findall(r" as (\w+)$", (face / "__init__.pyi").read_text(), re.MULTILINE)
        lines.append(f"import physx_{package}")
        texts += [f"physx_{package}.{name}" for name in names]
    texts += CALLS
    lines += HEADER.splitlines()
    first = len(lines) + 1
    lines += [f"reveal_type({text})" for text in texts]
    file = folder / "program.py"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", file],
        cwd=ROOT,  # with the settings and the cache of the linter
        capture_output=True,
        text=True,
        timeout=600,
    )
    found = dict(re.findall(r'program\.py:(\d+): note: Revealed type is "(.*)"', done.stdout))
    assert ": error: " not in done.stdout, done.stdout + done.stderr
    revealed = {text: found[str(number)] for number, text in enumerate(texts, start=first)}
    return {text: re.sub(r"\b(\w+\.)+(?=\w)", "", kind) for text, kind in revealed.items()}


@pytest.mark.faults
def test_no_public_name_is_any_and_calls_have_the_types_of_their_results(tmp_path):
    revealed = reveal(tmp_path)
    assert len(revealed) > 100
    assert [text for text, kind in revealed.items() if kind == "Any"] == []
    assert {text: revealed[text] for text in CALLS} == CALLS
