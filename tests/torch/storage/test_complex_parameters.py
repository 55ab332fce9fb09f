"""Networks with complex parameters, as Fourier neural operators have."""

from collections import OrderedDict

import pytest
import torch

from physx_torch.networks.module_network import ModuleNetwork


class Spectral(torch.nn.Module):
    """Multiplies the spectrum with complex weights, and notes in its state how it was made."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.randn(5, dtype=torch.complex64))

    def forward(self, x):
        return torch.fft.irfft(torch.fft.rfft(x) * self.weight, n=8)

    def state_dict(self, *args, **kwargs):
        state = super().state_dict(*args, **kwargs)
        assert isinstance(state, OrderedDict)
        state["_metadata"] = {"weights": 5}
        return state


def network():
    return ModuleNetwork(Spectral, net_fields="x", opt_fields="y")


@pytest.mark.parametrize(
    ("name", "real", "complex_"),
    [("float32", torch.float32, torch.complex64), ("float64", torch.float64, torch.complex128)],
)
def test_they_keep_their_imaginary_part(name, real, complex_):
    first = network()
    weight = first.module.weight.detach().clone()
    first.set_data_type(name)
    assert first.module.weight.dtype == complex_
    assert torch.equal(first.module.weight.detach(), weight.to(complex_))
    assert first.predict({"x": torch.ones(2, 8, dtype=real)})["y"].dtype == real


def test_each_counts_as_two_numbers():
    assert network().nb_parameters() == 10


def test_they_are_saved_and_loaded_without_the_modules_notes(tmp_path):
    first, second = network(), network()
    first.save_parameters(tmp_path / "parameters.safetensors")
    second.load_parameters(tmp_path / "parameters.safetensors")
    assert torch.equal(first.module.weight, second.module.weight)
