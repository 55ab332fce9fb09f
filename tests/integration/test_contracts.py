"""Every component of physx keeps the contract of its kind; a new one is checked without a word."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from physx_core import NetworkConfig, plugins
from physx_core.external import INCLUDE
from physx_testing import check_plugin

pytestmark = [pytest.mark.slow, pytest.mark.processes]

for library in ("torch", "dartpy", "pinocchio", "mujoco", "rerun", "viser", "gymnasium"):
    pytest.importorskip(library)

PROGRAMS = Path(__file__).parents[1] / "core" / "programs" / "external"
UNET = {"nb_dims": 2, "nb_steps": 1, "nb_first_layer_channels": 4}
FC = NetworkConfig("torch/fc", network_kwargs={"layers": [4, 8, 3]})
ADAM = replace(FC, loss="MSELoss", optimizer="Adam", lr=0.01)
GIVEN = {
    "torch/fc": {"arguments": {"layers": [4, 8, 3]}},
    "cluster/local": {"arguments": {"options": {}, "threads": 1}},
    "remote/godot-rl": {"arguments": {"timeout": 0.1}},
    "torch/graph": {"arguments": {"nodes": 2, "outputs": 1}},
    "torch/encoder_decoder": {"arguments": {"encoder": [4, 2]}},
    "torch/padded": {
        "arguments": {"module": "torch.nn:Linear", "in_features": 2, "out_features": 1}
    },
    "torch/module": {
        "arguments": {"module": "torch.nn:Linear", "in_features": 4, "out_features": 3}
    },
    "network torch/unet": {"arguments": UNET},
    "optimization torch/default": {"network": ADAM},
    "transformation torch/default": {"network": FC},
    "transformation torch/unet": {"network": NetworkConfig("torch/unet", network_kwargs=UNET)},
}
"""What components are given that need it, by reference, with the kind if there are several."""
CHANCE = """
import numpy as np

class Chance:
    def __init__(self, vocs):
        self.vocs, self.random = vocs, np.random.default_rng(0)

    def suggest(self, number):
        bounds = self.vocs.variables.items()
        return [{k: self.random.uniform(*pair) for k, pair in bounds} for _ in range(number)]

    def ingest(self, results):
        self.random = np.random.default_rng(abs(hash(sum(one["loss"] for one in results))))
"""
ELSEWHERE = {"cluster/ray", "cluster/slurm"}
"""Launchers that need a cluster."""


def components():
    """Return kind and reference of every component, and of one of Gymnasium's own environments."""
    for plugin in plugins.available():
        for kind, offered in plugins.load(plugin).components.items():
            for name in offered:
                ours = plugin != "gym" or kind != "environment" or "physx/" in name
                if f"{plugin}/{name}" not in ELSEWHERE and (ours or name == "CartPole-v1"):
                    # Those of gym share nearly everything: the others are campaigns.
                    more = plugin == "gym" and "physx/" in name and "Ant" not in name
                    marks = [pytest.mark.faults] if more else []
                    identity = f"{kind}-{plugin}/{name}"
                    yield pytest.param(kind, f"{plugin}/{name}", id=identity, marks=marks)


@pytest.fixture
def given(tmp_path, monkeypatch):
    """Return a function that returns the options of a component's check."""

    def find(kind, reference):
        if reference == "physx/table":
            names = "stiffness,viscosity,push_0,push_1,cells"
            rows = [f"{10 + k},{0.1 + k / 100},0.5,{k / 10},{1 + k % 4}" for k in range(8)]
            (tmp_path / "sets.csv").write_text("\n".join([names, *rows]))
            return {"arguments": {"file": str(tmp_path / "sets.csv")}}
        if reference == "physx/generator":
            (tmp_path / "gest_api").mkdir()
            (tmp_path / "gest_api/vocs.py").write_text("from types import SimpleNamespace as VOCS")
            (tmp_path / "chance.py").write_text(CHANCE)
            monkeypatch.syspath_prepend(tmp_path)
            return {"arguments": {"generator": "chance:Chance"}}
        if reference == "external/program":
            words = [heat(tmp_path / "heat"), "4", "20", "10"]
            return {"arguments": {"program": words, "parameters": {"alpha": 0.1}}}
        return GIVEN.get(reference, GIVEN.get(f"{kind} {reference}", {}))

    return find


def heat(program):
    """Return the path of a program that simulates the heat equation, compiled."""
    if shutil.which("gcc") is None:
        pytest.skip("the compiler gcc is not installed")
    command = ["gcc", "-O2", f"-I{INCLUDE}", str(PROGRAMS / "heat.c"), "-lm", "-o", str(program)]
    subprocess.run(command, check=True)
    return str(program)


@pytest.mark.parametrize(("kind", "reference"), list(components()))
def test_a_component_keeps_its_contract(kind, reference, given, nothing_stays_behind):
    (report,) = check_plugin(reference, kind=kind, **given(kind, reference))
    counts = report.counts()
    assert counts["failed"] == 0 and counts["passed"] >= 1, str(report)
