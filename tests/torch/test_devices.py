"""Everything is made where the network is, seen on the device "meta", which mixes with no other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Field, NetworkConfig, Normalization
from physx_core.pipelines import Learner
from physx_torch import devices
from physx_torch.networks import network
from physx_torch.storage import state

GRID = {"input": (4, 5, 1), "ground_truth": (4, 5, 2)}
FLAT = {"input": (3,), "ground_truth": (2, 1)}
NETWORKS = {
    "FC": ("torch/fc", {"layers": [3, 4, 2]}, FLAT),
    "EncoderDecoder": ("torch/encoder_decoder", {"encoder": [3, 2], "nb_outputs": 2}, FLAT),
    "module": (
        "torch.nn:Linear",
        {"in_features": 3, "out_features": 2},
        {"input": (3,), "ground_truth": (2,)},
    ),
    "UNet": (
        "torch/unet",
        {
            "nb_dims": 2,
            "nb_output_channels": 2,
            "nb_first_layer_channels": 2,
            "nb_steps": 1,
            "normalization": "batch",
            "positions": True,
        },
        GRID,
    ),
}


@pytest.fixture
def elsewhere(monkeypatch):
    """A device "meta" for networks: as if it were a graphics card, with ones for numbers."""
    monkeypatch.setattr(network, "find_device", torch.device)
    item = torch.Tensor.item
    monkeypatch.setattr(torch.Tensor, "item", lambda self: 1.0 if self.is_meta else item(self))
    return "meta"


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_training_and_prediction_stay_on_the_device_of_the_network(name, elsewhere):
    reference, kwargs, shapes = NETWORKS[name]
    config = NetworkConfig(
        reference,
        kwargs,
        optimization_kwargs={"gradient_clip": 1.0, "accumulate": 2, "loss_kwargs": {"beta": 0.5}},
        loss="SmoothL1Loss",
        optimizer="Adam",
        lr=1e-3,
        device=elsewhere,
    )
    learner = Learner(config, trains=True)
    learner.bind(
        {name: Field(name, shape) for name, shape in shapes.items()},
        {name: Normalization(np.zeros(shape), np.ones(shape)) for name, shape in shapes.items()},
    )
    learner.network.set_train()
    batch = {name: np.random.default_rng(0).random((4, *shape)) for name, shape in shapes.items()}
    for _ in range(3):
        learner.optimize(batch)
    learner.network.set_eval()
    inputs = learner.network.numpy_to_tensor({"input": batch["input"]})
    prediction = learner.network.predict(learner.transformation.transform_before_prediction(inputs))
    prediction = learner.transformation.transform_before_apply(prediction)
    assert prediction["prediction"].device.type == elsewhere
    assert prediction["prediction"].shape == (4, *shapes["ground_truth"])
    used = [*learner.network.parameters(), *learner.network.buffers()]
    assert {tensor.device.type for tensor in used} == {elsewhere}


def test_mixed_precision_is_that_of_the_device(monkeypatch):
    asked = []

    class Autocast(torch.autocast):
        def __init__(self, device_type, dtype):
            asked.append((device_type, dtype))
            super().__init__("cpu", torch.bfloat16)

    monkeypatch.setattr(torch, "autocast", Autocast)
    from physx_torch.training.training_forward import run_in_precision

    forward = run_in_precision(lambda x: x, torch.device("cuda:1"), torch.float16, torch.float32)
    assert forward(torch.zeros(2)).dtype == torch.float32
    assert asked == [("cuda", torch.float16)]


def test_each_process_of_torchrun_has_a_device_of_its_own(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    found = []
    for rank in ("0", "1", "2"):
        monkeypatch.setenv("LOCAL_RANK", rank)
        found += [devices.find_device("cuda"), devices.find_device("auto")]
    assert [device.index for device in found] == [0, 0, 1, 1, 0, 0]
    assert devices.find_device("cuda:1") == torch.device("cuda:1")


def test_random_numbers_of_the_device_are_kept_with_the_state(monkeypatch):
    drawn = torch.arange(16, dtype=torch.uint8)
    given = []
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: drawn)
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda value, device: given.append(device))
    kept = state.random_state(torch.device("cuda:1"))
    assert kept["cuda"] is drawn and kept["cpu"].device.type == "cpu"
    state.set_random_state(kept, torch.device("cuda:1"))
    state.set_random_state({"cpu": kept["cpu"]}, torch.device("cuda:1"))  # written without one
    state.set_random_state(kept, torch.device("cpu"))
    assert given == [torch.device("cuda:1")]
