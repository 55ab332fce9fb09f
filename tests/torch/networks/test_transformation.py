from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Normalization
from physx_core.errors import ConfigError
from physx_torch import FC, TorchTransformation


@pytest.fixture
def network():
    network = FC([3, 3], net_fields=["x", "s"], opt_fields=["y", "z"], pred_fields=["p", "q"])
    network.set_data_type("float64")
    return network


@pytest.fixture
def normalization():
    return {
        "x": Normalization(np.array([1.0, -5.0]), np.array([2.0, 1.0])),
        "y": Normalization(np.array([[10.0], [20.0]]), np.array([[0.5], [4.0]])),
        "s": Normalization(np.array(3.0), np.array(0.1)),
    }


def batch(seed=0):
    rng = np.random.default_rng(seed)
    return {"x": rng.random((4, 2)), "s": rng.random(4), "y": rng.random((4, 2, 1))}


def test_identity_without_normalization(network):
    transformation = TorchTransformation()
    data = network.numpy_to_tensor(batch())
    for _ in range(2):
        assert transformation.transform_before_prediction(data) is data
        prediction, targets = transformation.transform_before_loss(data, data)
        assert prediction is data and targets is data
        assert transformation.transform_before_apply(data) is data
        transformation.set_normalization({}, network)


def test_inputs_and_targets_are_normalized(network, normalization):
    transformation = TorchTransformation()
    transformation.set_normalization(normalization, network)
    arrays = batch()
    data = network.numpy_to_tensor(arrays)
    inputs = transformation.transform_before_prediction({**data, "other": data["x"]})
    np.testing.assert_allclose(inputs["x"], (arrays["x"] - [1, -5]) / [2, 1])
    np.testing.assert_allclose(inputs["s"], (arrays["s"] - 3) / 0.1)
    np.testing.assert_array_equal(inputs["other"], arrays["x"])
    np.testing.assert_array_equal(data["x"], arrays["x"])  # the batch is untouched
    prediction = {"p": data["y"], "q": data["s"]}
    same, targets = transformation.transform_before_loss(
        prediction, {"y": data["y"], "z": data["s"]}
    )
    assert same is prediction
    np.testing.assert_allclose(targets["y"], (arrays["y"] - [[10], [20]]) / [[0.5], [4]])
    np.testing.assert_array_equal(targets["z"], arrays["s"])  # has no coefficients
    assert not targets["y"].requires_grad


@pytest.mark.parametrize(("data_type", "error"), [("float32", 1e-5), ("float64", 1e-13)])
def test_apply_inverts_what_the_loss_sees(network, normalization, data_type, error):
    network.set_data_type(data_type)
    transformation = TorchTransformation()
    transformation.set_normalization(normalization, network)
    arrays = batch()
    data = network.numpy_to_tensor(arrays)
    _, targets = transformation.transform_before_loss({}, {"y": data["y"], "z": data["s"]})
    assert targets["y"].dtype == network.data_type
    back = transformation.transform_before_apply({"p": targets["y"], "q": targets["z"]})
    assert list(back) == ["p", "q"]
    np.testing.assert_allclose(back["p"], arrays["y"], atol=error)
    np.testing.assert_allclose(back["q"], arrays["s"], atol=error)


def test_constant_component_is_shifted_only(network):
    transformation = TorchTransformation()
    transformation.set_normalization(
        {"x": Normalization(np.array([7.0, 0.0]), np.array([1.0, 2.0]))}, network
    )
    x = torch.tensor([[7.0, 4.0]], dtype=torch.float64)
    assert transformation.transform_before_prediction({"x": x})["x"].tolist() == [[0.0, 2.0]]


def test_a_target_that_was_constant_is_predicted_as_it_was_whatever_the_network_says(network):
    mean, std = np.array([7.0, 0.0, 3.0]), np.array([1.0, 1.0, 2.0])
    spread = np.array([7.0, 0.0, -1.0]), np.array([7.0, 0.0, 5.0])
    transformation = TorchTransformation()
    transformation.set_normalization({"y": Normalization(mean, std, *spread)}, network)
    said = torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    assert transformation.transform_before_apply({"p": said})["p"].tolist() == [[7.0, 0.0, 4.0]]
    kept = Normalization(np.array([5.0]), np.array([1.0]), np.array([5.0]), np.array([5.0]), True)
    transformation.set_normalization({"y": kept}, network)
    assert transformation.transform_before_apply({"p": said})["p"].tolist() == [[np.exp(5.0)] * 3]
    _, targets = transformation.transform_before_loss({}, {"y": torch.full((1, 1), np.exp(5.0))})
    assert targets["y"].tolist() == [[pytest.approx(0, abs=1e-9)]]


def test_integer_inputs_become_floating(network):
    transformation = TorchTransformation()
    transformation.set_normalization(
        {"x": Normalization(np.array([1.0, 1.0]), np.array([2.0, 2.0]))}, network
    )
    x = transformation.transform_before_prediction({"x": torch.tensor([[2, 4]])})["x"]
    assert x.dtype == torch.float64
    assert x.tolist() == [[0.5, 1.5]]


def test_coefficients_are_replaced_and_kept(network, normalization):
    transformation = TorchTransformation()
    transformation.set_normalization(normalization, network)
    assert transformation.normalization == normalization
    transformation.set_normalization({}, network)
    data = {"x": torch.rand(1, 2)}
    assert transformation.transform_before_prediction(data) is data


def test_gradients_pass_through_apply(network, normalization):
    transformation = TorchTransformation()
    transformation.set_normalization(normalization, network)
    p = torch.zeros(1, 2, 1, dtype=torch.float64, requires_grad=True)
    transformation.transform_before_apply({"p": p})["p"].sum().backward()
    assert p.grad.flatten().tolist() == [0.5, 4.0]


def test_network_of_another_library(normalization):
    with pytest.raises(ConfigError, match="not a TorchNetwork"):
        TorchTransformation().set_normalization(normalization, object())
