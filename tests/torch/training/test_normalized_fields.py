"""Networks whose fields are normalized by channel, or by their logarithm."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training
from physx_core.errors import FieldShapeError
from physx_core.pipelines import load_learner

PICTURE = ("channel", "y", "x")


class Scaled(torch.nn.Module):
    """Multiplies each channel by a number, whatever the resolution."""

    def __init__(self):
        super().__init__()
        self.factor = torch.nn.Parameter(torch.tensor([0.9, 1.1]))

    def forward(self, u):
        return u * self.factor[:, None, None]


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Dataset.create("data") as dataset:
        fields = [Field(n, (2, 4, 4), axes=PICTURE) for n in ("u", "v")]
        dataset.define_fields("training", fields)
        dataset.append("training", rows(4, 60))


def rows(size, count=5):
    random = np.random.default_rng(size)
    u = np.exp(random.normal([[[1.0]], [[-4.0]]], [[[0.3]], [[0.5]]], (count, 2, size, size)))
    return {"u": u, "v": 3 * u}


def train(normalize, network=Scaled, **options):
    config = NetworkConfig(
        network, {"net_fields": "u", "opt_fields": "v"}, loss="MSELoss", optimizer="Adam", lr=0.01,
        data_type="float64", device="cpu",
    )  # fmt: skip
    training = Training(
        config, DatasetConfig(existing_dir="data", normalize=normalize), session_name="run",
        epoch_nb=20, batch_size=20, seed=0, quiet=True, **options,
    )  # fmt: skip
    training.execute()
    return load_learner("sessions/run", NetworkConfig(network))


@pytest.mark.slow
def test_a_network_normalized_by_channel_predicts_at_other_resolutions():
    learner = train(True)
    assert learner.transformation.normalization["u"].mean.shape == (2, 1, 1)
    for size in (4, 7):
        batch = rows(size)
        for predict in (learner.predict, learner.answer):
            found = predict({"u": batch["u"]})["v"]
            assert found.shape == (5, 2, size, size)
            np.testing.assert_allclose(found, batch["v"], rtol=0.2, atol=0.05)
    with pytest.raises(FieldShapeError, match=r"has shape \(3, 4, 4\)"):
        learner.answer({"u": np.ones((5, 3, 4, 4))})


def test_a_network_of_each_component_names_the_shape_that_it_takes():
    learner = train({"u": "component", "v": "component"})
    with pytest.raises(FieldShapeError, match=r"but the network takes \(2, 4, 4\)"):
        learner.predict({"u": rows(7)["u"]})


@pytest.mark.slow
def test_positive_fields_are_learned_from_their_logarithms():
    learner = train({"u": "log-channel", "v": "log-channel"})
    known = learner.transformation.normalization
    np.testing.assert_allclose(known["v"].mean - known["u"].mean, np.log(3))
    batch = rows(4)
    np.testing.assert_allclose(learner.predict({"u": batch["u"]})["v"], batch["v"], rtol=0.05)
    learner.export("run.pt2", "pt2")
    exported = torch.export.load("run.pt2").module()
    u = torch.from_numpy(batch["u"])
    np.testing.assert_allclose(exported({"u": u})["v"].detach(), batch["v"], rtol=0.05)
