"""How a step is made: of several batches, in mixed precision, compiled."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Transformation
from physx_core.components import PredictedBatch
from physx_core.errors import ConfigError
from physx_torch import FC, TorchOptimization

cuda = pytest.param(
    "cuda",
    marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
)


def made(options=None, device="cpu", data_type="float32", optimizer="SGD", lr=0.1):
    torch.manual_seed(0)
    network = FC([2, 8, 1])
    network.set_data_type(data_type)
    network.set_device(device)
    network.set_train()
    optimization = TorchOptimization(**(options or {}))
    optimization.set_loss("MSELoss")
    optimization.set_optimizer(optimizer, network, lr=lr)
    return network, optimization


def samples(network, number=12):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (number, 2))
    return network.numpy_to_tensor({"input": x, "ground_truth": x[:, :1] - x[:, 1:] ** 2})


def learn(network, optimization, data):
    batch = PredictedBatch.of(network, Transformation(), data)
    loss = optimization.compute_loss(batch)
    optimization.optimize(loss)
    return optimization.transform_loss(loss, batch)["loss"]


def vector(network):
    return torch.cat([parameter.detach().flatten().cpu() for parameter in network.parameters()])


# Several batches --------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [{}, {"gradient_clip": 0.01}])
def test_accumulated_batches_make_the_step_of_the_whole(more):
    whole, optimization = made(more)
    data = samples(whole)
    learn(whole, optimization, data)
    parts, optimization = made({"accumulate": 3, **more})
    before = vector(parts)
    for first in (0, 4, 8):
        assert torch.equal(vector(parts), before)
        learn(parts, optimization, {name: t[first : first + 4] for name, t in data.items()})
    assert not torch.equal(vector(parts), before)
    torch.testing.assert_close(vector(parts), vector(whole))


def test_batches_left_over_wait_for_the_next_epoch():
    network, optimization = made({"accumulate": 2})
    data = samples(network)
    learn(network, optimization, data)
    optimization.schedule(1.0)
    before = vector(network)
    learn(network, optimization, data)
    assert not torch.equal(vector(network), before)


@pytest.mark.parametrize("number", [0, -1, 1.5, "2", True])
def test_wrong_accumulate(number):
    with pytest.raises(ConfigError, match="accumulate"):
        TorchOptimization(accumulate=number)


# Mixed precision --------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", cuda])
@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_mixed_precision_learns_what_full_precision_learns(device, precision):
    plain, optimization = made(device=device, optimizer="Adam", lr=0.02)
    for _ in range(60):
        expected = learn(plain, optimization, samples(plain))
    mixed, optimization = made({"mixed_precision": precision}, device, optimizer="Adam", lr=0.02)
    data = samples(mixed)
    losses = [learn(mixed, optimization, data) for _ in range(60)]
    assert losses[-1] < 0.1 * losses[0]
    assert losses[-1] == pytest.approx(expected, rel=0.3)
    assert losses[-1] != expected
    assert {p.dtype for p in mixed.parameters()} == {torch.float32}


def test_mixed_precision_is_for_training_alone():
    network, _ = made({"mixed_precision": "bfloat16"})
    data, seen = samples(network), []
    network.layers[0].register_forward_hook(lambda module, given, output: seen.append(output.dtype))
    prediction = network.predict(data)["prediction"]
    assert prediction.dtype == torch.float32
    network.set_eval()
    network.predict(data)
    assert seen == [torch.bfloat16, torch.float32]


def test_gradients_of_float16_are_scaled_before_they_are_clipped():
    network, optimization = made({"mixed_precision": "float16", "gradient_clip": 0.5}, lr=1.0)
    data = samples(network)
    data["ground_truth"] = data["ground_truth"] + 100.0
    before = vector(network)
    while torch.equal(vector(network), before):  # steps with overflow are left out
        learn(network, optimization, data)
    length = torch.linalg.vector_norm(vector(network) - before).item()
    assert length == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("precision", "data_type", "told"),
    [("float8", "float32", "bfloat16, float16"), ("bfloat16", "float64", "data_type")],
)
def test_wrong_precision(precision, data_type, told):
    with pytest.raises(ConfigError, match=told):
        made({"mixed_precision": precision}, data_type=data_type)


# torch.compile ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_compiled_network_learns_the_same():
    plain, optimization = made()
    learn(plain, optimization, samples(plain))
    fast, optimization = made({"compile": "eager"})
    learn(fast, optimization, samples(fast))
    torch.testing.assert_close(vector(fast), vector(plain))
    assert list(fast.state_dict()) == list(plain.state_dict())


@pytest.mark.slow
def test_compiled_in_mixed_precision():
    network, optimization = made({"compile": "eager", "mixed_precision": "bfloat16"})
    data = samples(network)
    first = learn(network, optimization, data)
    for _ in range(20):
        last = learn(network, optimization, data)
    assert last < first


@pytest.mark.slow
def test_a_machine_without_a_compiler_is_told_so():
    def broken(graph, inputs):
        raise RuntimeError("no compiler found")

    torch._dynamo.reset()
    torch._dynamo.register_backend(broken, name="broken_compiler")
    network, optimization = made({"compile": "broken_compiler"})
    with pytest.raises(
        ConfigError, match='"broken_compiler" does not work here.*no compiler found'
    ):
        learn(network, optimization, samples(network))


@pytest.mark.slow
def test_unknown_backend():
    with pytest.raises(ConfigError, match="inductor"):
        made({"compile": "indcutor"})
