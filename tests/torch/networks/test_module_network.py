from __future__ import annotations

import pytest
import torch

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_torch import FC, ModuleNetwork


class Product(torch.nn.Module):
    def __init__(self, factor=1.0):
        super().__init__()
        self.factor = torch.nn.Parameter(torch.tensor(float(factor)))

    def forward(self, a, b):
        return a * b * self.factor


def test_module_by_reference_with_its_own_arguments():
    make = plugins.resolve("network", "torch/module")
    network = make(
        module="torch.nn:Linear",
        in_features=4,
        out_features=2,
        bias=False,
        net_fields="state",
        opt_fields="torque",
    )
    assert isinstance(network, ModuleNetwork)
    assert network.nb_parameters() == 8
    network.set_eval()
    x = torch.rand(3, 4)
    prediction = network.predict({"state": x})
    torch.testing.assert_close(prediction["torque"], x @ network.module.weight.T)


def test_module_by_class_with_several_inputs():
    network = ModuleNetwork(Product, factor=3, net_fields=["a", "b"], opt_fields="c")
    prediction = network.predict({"b": torch.full((2, 1), 5.0), "a": torch.full((2, 1), 2.0)})
    assert prediction["c"].tolist() == [[30.0], [30.0]]


def test_module_of_a_script(tmp_path):
    script = tmp_path / "own.py"
    script.write_text(
        "import torch\n"
        "class Twice(torch.nn.Module):\n"
        "    def forward(self, x):\n"
        "        return {'prediction': 2 * x, 'hidden': x}\n"
    )
    network = ModuleNetwork(f"{script}:Twice")
    assert network.predict({"input": torch.ones(2, 1)})["prediction"].tolist() == [[2.0], [2.0]]


def test_parameters_round_trip(tmp_path):
    first = ModuleNetwork(Product, factor=3, net_fields=["a", "b"])
    second = ModuleNetwork(Product, net_fields=["a", "b"])
    first.save_parameters(tmp_path / "p")
    second.load_parameters(tmp_path / "p")
    assert second.module.factor == 3


@pytest.mark.parametrize(
    ("module", "arguments", "told"),
    [
        ("torch.nn:Linera", {}, 'Did you mean "Linear"'),
        ("nowhere_at_all:Linear", {}, "nowhere_at_all"),
        ("torch.nn:Linear", {"inputs": 3}, "in_features, out_features"),
        (Product, {"faktor": 3}, "It takes: factor"),
        (dict, {}, "not a torch.nn.Module"),
        (FC, {"layers": [2, 1]}, "already a network"),
    ],
)
def test_wrong_modules(module, arguments, told):
    with pytest.raises(ConfigError, match=told):
        ModuleNetwork(module, **arguments)
