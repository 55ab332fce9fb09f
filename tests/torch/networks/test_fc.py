from __future__ import annotations

import pytest
import torch

from physx_core import Field
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch import FC


def fields(**shapes):
    return {name: Field(name, shape) for name, shape in shapes.items()}


def kinds(network):
    return [type(module).__name__ for module in network.layers]


def test_layers_and_activations():
    network = FC([27, 256, 128, 9])
    assert kinds(network) == ["Linear", "PReLU", "Linear", "PReLU", "Linear"]
    linear = [module for module in network.layers if isinstance(module, torch.nn.Linear)]
    assert [(m.in_features, m.out_features) for m in linear] == [(27, 256), (256, 128), (128, 9)]
    slopes = [module.num_parameters for module in network.layers[1::2]]
    assert slopes == [256, 128]  # one for each neuron
    weights = 27 * 256 + 256 * 128 + 128 * 9
    assert network.nb_parameters() == weights + (256 + 128 + 9) + (256 + 128)


@pytest.mark.slow
def test_one_layer_is_linear():
    network = FC([3, 2])
    x = torch.rand(4, 3)
    layer = network.layers[0]
    assert kinds(network) == ["Linear"]
    torch.testing.assert_close(network(x), x @ layer.weight.T + layer.bias)


@pytest.mark.parametrize(
    "activation", ["Tanh", torch.nn.Tanh, "torch.nn:Tanh", "torch.nn.modules.activation:Tanh"]
)
def test_activation_by_name_class_and_reference(activation):
    assert kinds(FC([2, 3, 1], activation=activation)) == ["Linear", "Tanh", "Linear"]


def test_every_plain_activation_works():
    for name in ("ReLU", "GELU", "SiLU", "ELU", "Sigmoid", "Softplus", "LeakyReLU", "Identity"):
        assert FC([2, 3, 1], activation=name)(torch.rand(4, 2)).shape == (4, 1)


@pytest.mark.parametrize(
    ("activation", "told"),
    [
        ("Relu", 'Did you mean "ReLU"'),
        ("torch.nn:Tahn", 'Did you mean "Tanh"'),
        ("nowhere:Tanh", "nowhere"),
        ("MultiheadAttention", "rejects its arguments"),
        (dict, "torch.nn.Module"),
    ],
)
def test_wrong_activation(activation, told):
    with pytest.raises(ConfigError, match=told):
        FC([2, 3, 1], activation=activation)


def test_biases():
    def given(biases):
        network = FC([2, 3, 4, 1], biases=biases)
        return [module.bias is not None for module in network.layers[::2]]

    assert given(True) == [True, True, True]
    assert given(False) == [False, False, False]
    assert given([True, False, True]) == [True, False, True]


@pytest.mark.parametrize("biases", [[True], [True] * 4, "yes", 1, [1, 0, 1], None])
def test_wrong_biases(biases):
    with pytest.raises(ConfigError, match="3 of them"):
        FC([2, 3, 4, 1], biases=biases)


@pytest.mark.parametrize("layers", [[], [3], [3, 0], [3, -1, 2], [3, 2.0], "33", 5, [True, 2]])
def test_wrong_layers(layers):
    with pytest.raises(ConfigError, match="FC.layers"):
        FC(layers)


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_output_has_the_shape_of_the_field(shape):
    network = FC([2, 4, 1])
    network.bind(fields(input=(2,), ground_truth=shape))
    assert network.predict({"input": torch.rand(5, 2)})["prediction"].shape == (5, *shape)


def test_fields_of_several_axes():
    network = FC([12, 8, 6])
    network.bind(fields(input=(4, 3), ground_truth=(2, 3)))
    x = torch.rand(5, 4, 3)
    prediction = network.predict({"input": x})["prediction"]
    assert prediction.shape == (5, 2, 3)
    torch.testing.assert_close(prediction.flatten(1), network.layers(x.flatten(1)))
    assert network.predict({"input": x[:0]})["prediction"].shape == (0, 2, 3)


def test_several_fields_are_concatenated_and_split_in_order():
    network = FC([2 + 1 + 6, 3 + 1 + 4], net_fields=["a", "b", "c"], opt_fields=["p", "q", "r"])
    network.bind(fields(c=(2, 3), b=(), a=(2,), r=(2, 2), q=(), p=(3,), more=(9,)))
    a, b, c = torch.rand(5, 2), torch.rand(5), torch.rand(5, 2, 3)
    prediction = network.predict({"c": c, "b": b, "a": a})
    output = network.layers(torch.cat([a, b[:, None], c.flatten(1)], dim=1))
    assert list(prediction) == ["p", "q", "r"]
    torch.testing.assert_close(prediction["p"], output[:, :3])
    torch.testing.assert_close(prediction["q"], output[:, 3])
    torch.testing.assert_close(prediction["r"], output[:, 4:].reshape(5, 2, 2))


def test_integers_are_read_as_numbers():
    network = FC([3, 1], net_fields=["a", "on"], opt_fields="p")
    network.bind(fields(a=(2,), on=(), p=(1,)))
    data = {"a": torch.ones(4, 2, dtype=torch.int64), "on": torch.tensor([True] * 4)}
    torch.testing.assert_close(network.predict(data)["p"], network.layers(torch.ones(4, 3)))


def test_output_shape_without_bind():
    network = FC([2, 6], output_shape=[2, 3])
    assert network.predict({"input": torch.rand(5, 2)})["prediction"].shape == (5, 2, 3)
    network.bind(fields(input=(2,), ground_truth=(2, 3)))
    with pytest.raises(FieldsMismatchError, match=r"\(3, 2\).*\(2, 3\)"):
        network.bind(fields(input=(2,), ground_truth=(3, 2)))
    assert FC([2, 6], output_shape=6)(torch.rand(5, 2)).shape == (5, 6)


def test_wrong_output_shape():
    with pytest.raises(ConfigError, match="4 values"):
        FC([2, 6], output_shape=[2, 2])
    with pytest.raises(ConfigError, match="one prediction field"):
        FC([2, 6], output_shape=[6], opt_fields=["a", "b"])


@pytest.mark.parametrize(
    ("shapes", "which", "size", "named"),
    [
        ({"input": (3,), "ground_truth": (1,)}, "first", 3, "input"),
        ({"input": (2,), "ground_truth": (2, 2)}, "last", 4, "ground_truth"),
    ],
)
def test_sizes_that_do_not_fit_name_field_shape_and_layer(shapes, which, size, named):
    with pytest.raises(FieldsMismatchError) as caught:
        FC([2, 5, 1]).bind(fields(**shapes))
    text = str(caught.value)
    assert f"{which} of FC's layers [2, 5, 1] must be {size}" in text
    assert f"{named}: shape {shapes[named]}" in text
    assert set(caught.value.differences) == {named}


def test_field_of_unknown_shape():
    with pytest.raises(FieldsMismatchError, match="input.*not known"):
        FC([2, 1]).bind(fields(input=None, ground_truth=(1,)))
