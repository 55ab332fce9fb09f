"""Padded networks: samples of any size for modules that need one size."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from physx_core import Dataset, Field, NetworkConfig, Training
from physx_core.errors import ConfigError, FieldShapeError, FieldsMismatchError
from physx_core.pipelines import load_learner

POOLED = f"{Path(__file__).parents[1] / 'programs' / 'pooled.py'}:Pooled"
NAMES = {"net_fields": ["x", "edge", "load"], "opt_fields": "u"}
COUNTS = (2, 7, 1, 4, 5, 3, 6, 2, 4, 3)


@pytest.fixture
def data(tmp_path):
    rng = np.random.default_rng(0)
    fields = [
        Field("x", ("node", 1)),
        Field("edge", ("edge", 2), "int64", indexes="node"),
        Field("load", ()),
        Field("u", ("node",)),
    ]
    x = [rng.normal(size=(count, 1)) for count in COUNTS]
    edge = [np.stack([np.arange(count - 1), np.arange(1, count)], 1) for count in COUNTS]
    rows = {"x": x, "edge": edge, "load": rng.normal(size=len(COUNTS))}
    rows["u"] = [100.0 + place[:, 0] * load for place, load in zip(x, rows["load"], strict=True)]
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.define_fields("training", fields)
        dataset.append("training", rows)
    return tmp_path / "data"


def train(data, name, epochs=3, **options):
    network = NetworkConfig(
        "torch/padded", {"module": POOLED, **NAMES, **options},
        loss="MSELoss", optimizer="Adam", lr=0.01,
    )  # fmt: skip
    resume = (data.parent / name).exists()
    return Training(
        network, str(data), epoch_nb=epochs, batch_size=4, seed=1, session_dir=str(data.parent),
        session_name=name, resume=resume, quiet=True,
    ).execute()  # fmt: skip


def test_padding_changes_neither_losses_nor_errors_nor_predictions(data):
    """Whether samples are as large as the largest of the batch, or much larger."""
    found = [
        train(data, name, sizes=sizes).values for name, sizes in (("a", {}), ("b", {"node": 50}))
    ]
    for name, value in found[0].items():
        if "loss" in name or "error" in name:
            assert_allclose(found[1][name], value, rtol=1e-4)
    with Dataset.open(data) as dataset:
        rows = dataset["training"]
        given = {name: rows[name][:] for name in NAMES["net_fields"]}
    for learner in (load_learner(data.parent / name, trust=True) for name in "ab"):
        together = learner.predict(given)["u"]
        assert [len(each) for each in together] == list(COUNTS)
        for row, each in enumerate(together):
            alone = learner.predict({n: values[row : row + 1] for n, values in given.items()})
            assert_allclose(alone["u"][0], each, rtol=1e-5)


def test_resumed_padded_network_is_that_of_one_run(data):
    train(data, "whole", 4)
    train(data, "parts", 2)
    train(data, "parts", 4)
    states = [
        load_learner(data.parent / n, trust=True).network.state_dict() for n in ("whole", "parts")
    ]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_sample_that_is_larger_than_the_padded_ones_is_an_error(data):
    with pytest.raises(FieldShapeError, match=r'entries on the axis "node".*gives it 3'):
        train(data, "run", sizes={"node": 3})


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"sizes": {"nod": 3}}, ConfigError, "have edge, node. Did you mean"),
        ({"sizes": {"node": 0}}, ConfigError, "must be positive"),
        ({"net_fields": ["load"]}, FieldsMismatchError, 'no input has the axis "node"'),
    ],
)
def test_wrong_options_of_padding_are_errors(data, options, error, words):
    with pytest.raises(error, match=words):
        train(data, "run", **options)
