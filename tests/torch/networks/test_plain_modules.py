"""A class of torch.nn.Module is given as the network itself, without a class of physx around it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, checkpoint
from physx_core.errors import (
    ComponentNotFoundError,
    ConfigError,
    ReferenceFormError,
    UntrustedReferenceError,
)
from physx_core.pipelines import Learner, load_learner
from physx_core.plugins.networks import resolve_network
from physx_torch import FC, ModuleNetwork

pytestmark = pytest.mark.processes

SCRIPT = """
import sys
import numpy as np
import torch
from physx_core import Dataset, DatasetConfig, NetworkConfig, Training

class Mixture(torch.nn.Module):
    def __init__(self, width=8):
        super().__init__()
        self.first, self.last = torch.nn.Linear(3, width), torch.nn.Linear(width, 2)

    def forward(self, a, b):
        return self.last(torch.tanh(self.first(torch.cat([a, b], dim=1))))

if __name__ == "__main__":
    network = NetworkConfig(Mixture, {"width": 6, "net_fields": ["a", "b"], "opt_fields": "c"},
                            loss="MSELoss", optimizer="Adam", lr=1e-2)
    data = DatasetConfig(existing_dir="data")
    training = Training(network, data, epoch_nb=2, batch_size=5, seed=1)
    training.execute()
    learner = training.learner
    batch = {"a": np.ones((1, 2)), "b": np.ones((1, 1))}
    np.save("answer.npy", learner.predict_in_training(batch)["c"])
"""


class Greedy(torch.nn.Module):
    """Takes arguments that have the names of a network's."""

    def __init__(self, net_fields=3, module="none"):
        super().__init__()
        self.module_name = module
        self.layer = torch.nn.Linear(net_fields, 1)

    def forward(self, x):
        return self.layer(x)


def config(network, arguments):
    return NetworkConfig(network, arguments, loss="MSELoss", optimizer="Adam")


@pytest.mark.parametrize("reference", ["torch.nn:Linear", torch.nn.Linear])
def test_a_class_of_torch(reference):
    arguments = {"in_features": 4, "out_features": 2, "net_fields": "x", "opt_fields": "y"}
    make, given = resolve_network(reference, arguments)
    assert make is ModuleNetwork and given == {"module": reference, **arguments}
    network = Learner(config(reference, arguments), trains=True).network
    assert isinstance(network.module, torch.nn.Linear)
    assert (network.net_fields, network.pred_fields) == (("x",), ("y",))


def test_networks_of_physx_stay_what_they_are():
    for reference, expected in ((FC, FC), ("physx_torch:FC", FC), ("torch/fc", FC)):
        assert resolve_network(reference, {"layers": [2, 1]}) == (expected, {"layers": [2, 1]})
    with pytest.raises(ReferenceFormError, match="dict.* not derived from Network"):
        Learner(config(dict, {"a": 1}), trains=False)


def test_a_function_that_makes_a_module_is_told_the_way():
    reference = "torch.nn.utils.parametrizations:weight_norm"
    with pytest.raises(ConfigError, match='network="torch/module"'):
        Learner(config(reference, {"module": torch.nn.Linear(2, 1)}), trains=False)


def test_a_class_that_is_not_there():
    with pytest.raises(ComponentNotFoundError, match='Did you mean "Linear"'):
        resolve_network("torch.nn:Linaer", {})


def test_arguments_that_are_not_the_modules():
    with pytest.raises(ConfigError, match="It takes: in_features"):
        Learner(config("torch.nn:Linear", {"inputs": 4}), trains=False)


def test_clashing_names_are_an_error():
    with pytest.raises(ConfigError, match='Greedy also takes an argument "net_fields"'):
        Learner(config(Greedy, {"net_fields": "x"}), trains=False)
    with pytest.raises(ConfigError, match="module_kwargs"):
        Learner(config(Greedy, {"module": "x"}), trains=False)
    with pytest.raises(ConfigError, match="width.*module_kwargs are set"):
        Learner(config(Greedy, {"width": 3, "module_kwargs": {}}), trains=False)
    arguments = {"net_fields": "x", "module_kwargs": {"net_fields": 5, "module": "own"}}
    network = Learner(config(Greedy, arguments), trains=False).network
    assert network.net_fields == ("x",) and network.module.layer.in_features == 5
    assert network.module.module_name == "own"


def test_the_seed_decides_its_first_parameters(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": np.ones((4, 2)), "y": np.ones((4, 1))})
    arguments = {"in_features": 2, "out_features": 1, "net_fields": "x", "opt_fields": "y"}
    found = []
    for seed in (1, 1, 2):
        data = DatasetConfig(existing_dir="data")
        network = config("torch.nn:Linear", arguments)
        with Training(network, data, epoch_nb=1, batch_size=4, seed=seed) as training:
            found.append(training.learner.network.module.weight.detach().clone())
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


@pytest.mark.slow
def test_the_checkpoint_of_a_scripts_class_is_restored_in_a_new_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        rows = {"a": rng.random((20, 2)), "b": rng.random((20, 1)), "c": rng.random((20, 2))}
        dataset.append("training", rows)
    Path("script.py").write_text(SCRIPT)
    subprocess.run([sys.executable, "script.py"], check=True, timeout=120)
    path = checkpoint.find(Path("sessions/training"), "network", -1).path
    assert "script.py:Mixture" in (path / checkpoint.DESCRIPTION).read_text()
    with pytest.raises(UntrustedReferenceError, match=r"script\.py:Mixture"):
        load_learner(path)
    load_learner(path, trust=True)
    learner = load_learner(path, NetworkConfig("script.py:Mixture"))
    assert learner.network.module.first.out_features == 6
    answer = learner.predict({"a": np.ones((1, 2)), "b": np.ones((1, 1))})["c"]
    np.testing.assert_allclose(answer, np.load("answer.npy"), rtol=1e-6)
