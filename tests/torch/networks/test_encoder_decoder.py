from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_torch import EncoderDecoder


@pytest.mark.parametrize(
    ("options", "sizes"),
    [
        ({"encoder": [30, 16, 4]}, (30, 16, 4, 16, 30)),
        ({"encoder": [30, 16, 8, 4], "nb_outputs": 3}, (30, 16, 8, 4, 8, 16, 3)),
        ({"encoder": [30, 8, 8, 8]}, (30, 8, 8, 8, 8, 8, 30)),
        ({"encoder": [30, 16, 4], "decoder": [6, 5, 2]}, (30, 16, 4, 6, 5, 2)),
        ({"encoder": [30, 4], "decoder": [2]}, (30, 4, 2)),
        ({"encoder": [30, 4]}, (30, 4, 30)),
    ],
    ids=["symmetric", "other outputs", "rectangular", "asymmetric", "short", "one layer each"],
)
def test_forms(options, sizes):
    network = EncoderDecoder(**options)
    linear = [module for module in network.layers if isinstance(module, torch.nn.Linear)]
    assert network.sizes == sizes
    assert [(m.in_features, m.out_features) for m in linear] == list(pairwise(sizes))
    x = torch.rand(5, sizes[0])
    code = network.encode(x)
    assert code.shape == (5, network.code_size) and network.code_size == options["encoder"][-1]
    assert torch.equal(network.decode(code), network(x))


def test_fields_biases_and_activation_are_those_of_fc():
    network = EncoderDecoder(
        [6, 4, 2], activation="Tanh", biases=[True, False, True, False], nb_outputs=3,
        net_fields=["a", "b"], opt_fields="c",
    )  # fmt: skip
    network.bind({"a": Field("a", (2, 2)), "b": Field("b", (2,)), "c": Field("c", (3, 1))})
    given = [m.bias is not None for m in network.layers if isinstance(m, torch.nn.Linear)]
    assert given == [True, False, True, False]
    data = {"a": torch.rand(4, 2, 2), "b": torch.rand(4, 2)}
    assert network.predict(data)["c"].shape == (4, 3, 1)
    assert network.encode(data["a"], data["b"]).shape == (4, 2)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"encoder": [3]}, "EncoderDecoder.encoder"),
        ({"encoder": "32"}, "EncoderDecoder.encoder"),
        ({"encoder": [3, 2], "decoder": [2], "nb_outputs": 2}, "nb_outputs"),
        ({"encoder": [3, 2], "decoder": [0]}, "EncoderDecoder.layers"),
        ({"encoder": [3, 2], "biases": [True]}, "EncoderDecoder.biases"),
    ],
)
def test_wrong_options(options, told):
    with pytest.raises(ConfigError, match=told):
        EncoderDecoder(**options)


def test_sizes_that_do_not_fit_the_fields():
    fields = {"input": Field("input", (4,)), "ground_truth": Field("ground_truth", (3,))}
    with pytest.raises(FieldsMismatchError, match="first of EncoderDecoder's layers"):
        EncoderDecoder([3, 2]).bind(fields)


@pytest.mark.slow
def test_learns_to_hand_on_points_of_a_plane(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    points = rng.standard_normal((300, 2)) @ rng.standard_normal((2, 12))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"points": points})
    network = NetworkConfig(
        "torch/encoder_decoder",
        {"encoder": [12, 8, 2], "net_fields": "points", "opt_fields": "points"},
        loss="MSELoss",
        optimizer="Adam",
        lr=1e-2,
    )
    data = DatasetConfig(existing_dir="data", normalize=True)
    training = Training(network, data, epoch_nb=30, batch_size=25, seed=0)
    training.execute()
    assert training.training_loss < 0.02  # of a variance of 1
