from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Field
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    FieldsMismatchError,
    MissingFieldError,
    UnknownOptionError,
)
from physx_core.toy import Linear
from physx_torch import FC, EncoderDecoder, TorchNetwork, UNet


class Force(TorchNetwork):
    """Two inputs, two outputs, a buffer, and layers that know training from prediction."""

    net_fields = ("position", "velocity")
    opt_fields = ("force", "power")

    def __init__(self, hidden=4, **fields):
        super().__init__(**fields)
        self.first = torch.nn.Linear(6, hidden)
        self.norm = torch.nn.BatchNorm1d(hidden)
        self.second = torch.nn.Linear(hidden, 4)
        self.answer = "list"

    def forward(self, position, velocity):
        out = self.second(self.norm(self.first(torch.cat([position, velocity], dim=1))))
        parts = [out[:, :3], out[:, 3:]]
        if self.answer == "dict":
            return {"power": parts[1], "force": parts[0], "more": out}
        return {"list": parts, "tuple": tuple(parts), "one": out, "wrong": {"force": out}}[
            self.answer
        ]


@pytest.fixture
def data():
    return {"position": torch.rand(5, 3), "velocity": torch.rand(5, 3), "other": torch.rand(5)}


# Names of the fields ----------------------------------------------------------------------------


def test_default_fields():
    network = FC([2, 1])
    assert network.net_fields == ("input",)
    assert network.opt_fields == ("ground_truth",)
    assert network.pred_fields == ("prediction",)


def test_prediction_gets_the_names_of_opt_fields():
    network = FC([2, 1], net_fields="state", opt_fields="torque")
    assert network.net_fields == ("state",)
    assert network.pred_fields == network.opt_fields == ("torque",)
    assert Force().pred_fields == ("force", "power")
    assert FC([2, 1], opt_fields="ground_truth").pred_fields == ("ground_truth",)


def test_pred_fields_can_be_named():
    network = FC([2, 2], opt_fields=["a", "b"], pred_fields=["x", "y"])
    assert network.pred_fields == ("x", "y")


@pytest.mark.parametrize(
    "fields",
    [
        {"net_fields": ["a", "a"]},
        {"net_fields": []},
        {"net_fields": [1]},
    ],
)
def test_names_that_do_not_fit(fields):
    with pytest.raises(ConfigError):
        FC([2, 1], **fields)


def test_unknown_option_names_the_nearest():
    with pytest.raises(UnknownOptionError, match='Did you mean "activation"'):
        FC([2, 1], activaton="ReLU")
    with pytest.raises(UnknownOptionError, match="hidden"):
        Force(hiden=3)


# Prediction -------------------------------------------------------------------------------------


@pytest.mark.parametrize("answer", ["list", "tuple", "dict"])
def test_forward_may_return_its_fields_in_three_forms(data, answer):
    network = Force()
    network.answer = answer
    prediction = network.predict(data)
    assert list(prediction) == ["force", "power"]
    assert prediction["force"].shape == (5, 3)
    assert prediction["power"].shape == (5, 1)


@pytest.mark.parametrize(("answer", "told"), [("one", "Tensor"), ("wrong", "force")])
def test_forward_that_returns_something_else(data, answer, told):
    network = Force()
    network.answer = answer
    with pytest.raises(FieldsMismatchError, match=told) as caught:
        network.predict(data)
    assert set(caught.value.differences) == {"force", "power"}


def test_missing_input_is_named(data):
    del data["velocity"]
    with pytest.raises(MissingFieldError, match='"velocity".*position') as caught:
        Force().predict(data)
    assert caught.value.field == "velocity"


def test_gradients_are_recorded_in_training_only(data):
    network = Force()
    network.set_train()
    assert network.training and network.predict(data)["force"].requires_grad
    network.set_eval()
    prediction = network.predict(data)["force"]
    assert not network.training and not prediction.requires_grad
    prediction.mul_(2)  # an ordinary tensor, which a transformation may change
    network.set_train()
    assert network.predict(data)["force"].requires_grad


def test_bind_names_missing_fields():
    with pytest.raises(FieldsMismatchError, match="velocity") as caught:
        Force().bind({"position": Field("position", (3,)), "force": Field("force", (3,))})
    assert set(caught.value.differences) == {"velocity", "power"}


# Parameters -------------------------------------------------------------------------------------


def test_parameters_by_name_and_number():
    network = Force(hidden=4)
    assert network.get_parameters()["first.weight"].shape == (4, 6)
    assert network.nb_parameters() == 6 * 4 + 4 + 4 + 4 + 4 * 4 + 4


@pytest.mark.parametrize("data_type", ["float32", "float64"])
def test_parameters_come_back_bit_for_bit(tmp_path, data, data_type):
    path = tmp_path / TorchNetwork.parameters_file
    first, second = Force(), Force()
    for network in (first, second):
        network.set_data_type(data_type)
    first.set_train()
    first.predict({name: value.to(first.data_type) for name, value in data.items()})
    first.save_parameters(path)
    second.load_parameters(path)
    state, loaded = first.state_dict(), second.state_dict()
    assert state["norm.num_batches_tracked"] == 1  # buffers too
    assert list(state) == list(loaded)
    for name, value in state.items():
        assert value.dtype == loaded[name].dtype
        assert torch.equal(value, loaded[name])


def test_parameters_load_into_another_floating_type(tmp_path):
    first, second = FC([2, 1]), FC([2, 1])
    second.set_data_type("float64")
    first.save_parameters(tmp_path / "p")
    second.load_parameters(tmp_path / "p")
    assert second.layers[0].weight.dtype == torch.float64
    assert torch.equal(second.layers[0].weight.float(), first.layers[0].weight)


def test_loaded_parameters_do_not_hang_on_the_file(tmp_path):
    path = tmp_path / "p"
    network = FC([2, 1])
    network.save_parameters(path)
    network.load_parameters(path)
    kept = network.layers[0].weight.clone()
    FC([2, 1]).save_parameters(path)
    assert torch.equal(network.layers[0].weight, kept)


def test_tied_parameters(tmp_path):
    class Tied(TorchNetwork):
        def __init__(self):
            super().__init__()
            self.a, self.b = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
            self.b.weight = self.a.weight

    first, second = Tied(), Tied()
    first.save_parameters(tmp_path / "p")
    second.load_parameters(tmp_path / "p")
    assert second.a.weight is second.b.weight
    assert torch.equal(first.a.weight, second.b.weight)


def test_missing_file(tmp_path):
    with pytest.raises(CheckpointError, match=r"no file .*nothing\.safetensors"):
        FC([2, 1]).load_parameters(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("damage", ["cut", "text", "empty", "header"])
def test_damaged_file(tmp_path, damage):
    path = tmp_path / "p"
    network = FC([4, 8, 1])
    network.save_parameters(path)
    whole = path.read_bytes()
    path.write_bytes(
        {
            "cut": whole[:-10],
            "text": b"this is no safetensors file",
            "empty": b"",
            "header": b"\xff" * 8 + whole[8:],
        }[damage]
    )
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(CheckpointError, match="damaged"):
        network.load_parameters(path)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_file_of_another_network_names_each_difference(tmp_path):
    FC([4, 8, 1]).save_parameters(tmp_path / "p")
    network = FC([4, 8, 8, 1], biases=[False, True, True])
    before = network.layers[0].weight.clone()
    with pytest.raises(CheckpointError) as caught:
        network.load_parameters(tmp_path / "p")
    text = str(caught.value)
    assert "layers.4.weight: not in the file" in text
    assert "layers.0.bias: only in the file" in text
    assert "layers.2.weight: (1, 8) in the file, (8, 8) in the network" in text
    assert torch.equal(network.layers[0].weight, before)


def test_state_that_is_no_tensor(tmp_path):
    class Odd(TorchNetwork):
        def get_extra_state(self):
            return {"a": 1}

    with pytest.raises(CheckpointError, match="_extra_state.*dict"):
        Odd().save_parameters(tmp_path / "p")


def test_folder_that_does_not_exist(tmp_path):
    with pytest.raises(CheckpointError, match="Cannot write"):
        FC([2, 1]).save_parameters(tmp_path / "nowhere" / "p")


def test_seed_gives_the_same_first_parameters():
    FC.set_seed(3)
    first = FC([4, 4]).layers[0].weight
    FC.set_seed(3)
    assert torch.equal(first, FC([4, 4]).layers[0].weight)
    assert not torch.equal(first, FC([4, 4]).layers[0].weight)


# Device and data type ---------------------------------------------------------------------------


def test_data_type_changes_parameters_but_not_torch():
    threads, default = torch.get_num_threads(), torch.get_default_dtype()
    network = FC([2, 3, 1])
    network.set_data_type("float64")
    network.set_device("auto")
    assert {p.dtype for p in network.parameters()} == {torch.float64}
    assert torch.get_default_dtype() == default
    assert torch.get_num_threads() == threads


def test_unknown_data_type():
    with pytest.raises(ConfigError, match=r"float16.*float32, float64"):
        FC([2, 1]).set_data_type("float16")


def test_devices():
    network = FC([2, 1])
    network.set_device("cpu")
    assert network.device == torch.device("cpu")
    network.set_device("auto")
    expected = "cuda" if torch.cuda.is_available() else "cpu"
    assert network.device.type == network.layers[0].weight.device.type == expected


@pytest.mark.parametrize("name", ["cuda:77", "gpu", "", "cpu:4"])
def test_device_that_is_not_there_lists_those_that_are(name):
    network = FC([2, 1])
    with pytest.raises(ConfigError, match=f'"{name}".*Devices: cpu'):
        network.set_device(name)
    assert network.device == torch.device("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_round_trip(tmp_path):
    network = FC([2, 3, 1])
    network.set_device("cuda:0")
    network.set_eval()
    tensors = network.numpy_to_tensor({"input": np.ones((4, 2))})
    assert tensors["input"].is_cuda
    on_gpu = network.tensor_to_numpy(network.predict(tensors))["prediction"]
    network.save_parameters(tmp_path / "p")
    network.set_device("cpu")
    network.load_parameters(tmp_path / "p")
    on_cpu = network.predict(network.numpy_to_tensor({"input": np.ones((4, 2))}))
    np.testing.assert_allclose(on_gpu, on_cpu["prediction"].numpy(), atol=1e-6)


# Arrays and tensors -----------------------------------------------------------------------------


@pytest.mark.parametrize("data_type", ["float32", "float64"])
def test_arrays_of_the_right_type_share_memory(data_type):
    network = FC([2, 1])
    network.set_data_type(data_type)
    array = np.arange(6, dtype=data_type).reshape(3, 2)
    tensor = network.numpy_to_tensor({"input": array})["input"]
    array[0, 0] = 7
    assert tensor[0, 0] == 7
    assert np.shares_memory(network.tensor_to_numpy({"input": tensor})["input"], array)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", ">f8", ">f4"])
def test_floating_arrays_get_the_network_type(dtype):
    network = FC([2, 1])
    array = np.array([[0.5, -2.0], [3.0, 4.0]], dtype)
    tensor = network.numpy_to_tensor({"x": array})["x"]
    assert tensor.dtype == torch.float32
    np.testing.assert_array_equal(network.tensor_to_numpy({"x": tensor})["x"], array)


@pytest.mark.parametrize("dtype", ["int8", "int32", "int64", "uint8", "bool", "complex64"])
def test_integers_become_int64_and_other_arrays_keep_their_type(dtype):
    network = FC([2, 1])
    array = np.array([[0, 1], [1, 0]], dtype)
    back = network.tensor_to_numpy(network.numpy_to_tensor({"x": array}))["x"]
    assert back.dtype == ("int64" if "int" in dtype else array.dtype)
    np.testing.assert_array_equal(back, array)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("form", ["read only", "reversed", "strided", "transposed", "empty", "1-D"])
def test_arrays_of_any_layout(form):
    network = FC([2, 1])
    array = np.arange(12, dtype="float32").reshape(6, 2)
    array = {
        "read only": array.copy(),
        "reversed": array[::-1],
        "strided": array[::2],
        "transposed": array.T,
        "empty": array[:0],
        "1-D": array[:, 0],
    }[form]
    if form == "read only":
        array.flags.writeable = False
    tensor = network.numpy_to_tensor({"x": array})["x"]
    assert tensor.shape == array.shape
    np.testing.assert_array_equal(tensor.numpy(), array)


def test_prediction_with_gradients_becomes_an_array():
    network = FC([2, 1])
    network.set_train()
    prediction = network.predict({"input": torch.rand(3, 2)})
    array = network.tensor_to_numpy(prediction)["prediction"]
    assert isinstance(array, np.ndarray)
    assert array.shape == (3, 1)


@pytest.mark.parametrize(
    "network",
    [
        lambda names: Linear(**names),
        lambda names: FC([2, 1], **names),
        lambda names: EncoderDecoder([3, 2], **names),
        lambda names: UNet(2, nb_input_channels=1, nb_output_channels=1, **names),
    ],
    ids=["linear", "fc", "encoder_decoder", "unet"],
)
@pytest.mark.parametrize("free", ["u", "v"])
def test_networks_of_samples_of_one_size_refuse_meshes(network, free):
    fields = {name: Field(name, ("node", 2) if name == free else (8, 8)) for name in "uv"}
    with pytest.raises(FieldsMismatchError, match=r'torch/graph".*"torch/padded') as caught:
        network({"net_fields": "u", "opt_fields": "v"}).bind(fields)
    assert caught.value.differences == {free: 'its axis "node" has another size in each sample'}
