"""Increments: networks that learn how a field changes since one of their inputs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training, Transformation, View
from physx_core.errors import ConfigError
from physx_core.pipelines import load_learner

WINDOWS = View(window={"past": ("x", [-1, 0]), "next": ("x", 1)})
SINGLE = View(window={"past": ("x", 0), "next": ("x", 1)})
STEPS, OFFSET = 20, 1e6


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    random, step = np.random.default_rng(0), np.arange(400)
    with Dataset.create("data") as dataset:
        x = OFFSET + np.cumsum(random.normal(0.1, 1.0, (400, 2)), 0)
        later = x + 2 * (x - OFFSET)
        numbers = [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
        fields = [Field("x", (2,)), Field("later", (2,), like="x"), *numbers]
        dataset.define_fields("training", fields)
        dataset.append(
            "training",
            {"x": x, "later": later, "episode": step // STEPS, "step": step % STEPS},
        )


class Plain(Transformation):
    """Changes nothing."""

    def set_normalization(self, normalization, network):
        """Keep nothing."""


def train(normalize, reads="past", learns="next", view=WINDOWS, **options):
    arguments = {"net_fields": reads, "opt_fields": learns}
    training = Training(
        NetworkConfig("toy/linear", arguments, **options),
        DatasetConfig(existing_dir="data", view=view, normalize=normalize),
        epoch_nb=2, batch_size=16, seed=0, session_name="run", quiet=True,
    )  # fmt: skip
    training.execute()
    return training, load_learner("sessions/run")


def test_statistics_are_those_of_the_changes():
    with WINDOWS.open(16, data="data") as batches:
        found = batches.normalization({"next": "increment"})["next"]
        rows = np.concatenate([batch["next"] - batch["past"][:, -1] for batch in batches])
    assert_allclose(found.mean, rows.mean(0), rtol=1e-6)
    assert_allclose(found.std, rows.std(0), rtol=1e-6)
    assert found.since == "past"


def test_loss_compares_changes_and_predictions_are_values():
    _, learner = train({"next": "increment"})
    with WINDOWS.open(16, data="data", part="validation") as batches:
        batch = batches[0]
    values = learner.predict({"past": batch["past"]})["next"]
    assert np.abs(values - batch["next"]).max() < 5  # a change is about 1, a value 1e6
    changed = learner.transformation.increments.of({"next": batch["next"]}, batch)["next"]
    assert_allclose(changed, batch["next"] - batch["past"][:, 1])


def test_stored_fields_of_one_row_are_increments():
    with Dataset.open("data") as dataset:
        x, later = dataset["training"]["x"][:], dataset["training"]["later"][:]
    view = View(hold_back=False)
    for normalize in ({"later": "increment"}, {"later": "increment:x"}):
        _, learner = train(normalize, "x", "later", view)
        found = learner.transformation.normalization["later"]
        assert_allclose(found.mean, (later - x).mean(0))
        assert_allclose(found.maximum, (later - x).max(0))


def test_changes_of_values_of_any_size_are_those_of_their_entries(tmp_path):
    before = [np.arange(size, dtype=float) for size in (3, 0, 5)]
    after = [values + 2 * values**2 for values in before]
    with Dataset.create(tmp_path / "free") as dataset:
        free = [Field("before", ("node",)), Field("after", ("node",), like="before")]
        dataset.define_fields("training", free)
        dataset.append("training", {"before": before, "after": after})
        with View(hold_back=False).open(2, data=dataset) as batches:
            found = batches.normalization({"after": "increment"})["after"]
    changes = np.concatenate(after) - np.concatenate(before)
    assert_allclose([found.mean, found.std], [changes.mean(), changes.std()])


def test_windows_of_fields_that_are_one_quantity_are_increments():
    train({"next": "increment"}, view=View(window={"past": ("later", 0), "next": ("x", 1)}))


def test_increments_of_a_stored_field_are_chosen_for_the_window_alone():
    with WINDOWS.open(16, data="data") as batches:
        found = batches.normalization({"x": "increment"})
    assert not found["next"].since and not found["past"].since


def test_which_of_several_fields_is_subtracted_must_be_said():
    view = View(window={"past": ("x", 0), "older": ("x", -1), "next": ("x", 1)})
    with view.open(16, data="data") as batches:
        with pytest.raises(ConfigError, match="older, past are the same quantity"):
            batches.normalization({"next": "increment"})
        found = batches.normalization({"next": "increment:older"})["next"]
        rows = np.concatenate([batch["next"] - batch["older"] for batch in batches])
    assert_allclose(found.mean, rows.mean(0), rtol=1e-6)


@pytest.mark.parametrize(
    ("normalize", "options", "words"),
    [
        ({"next": "increment:gone"}, {}, 'no field "gone" of numbers to subtract'),
        (
            {"next": "increment"},
            {"view": View(window={"past": ("x", 0), "next": ("x", [1, 2])})},
            r"is not that of one step",
        ),
        (
            {"past": "increment:next"},
            {"view": SINGLE},
            "it must read the second one and not the first one",
        ),
        ({"next": "increment"}, {"transformation": Plain}, "must call that of its base class"),
    ],
)
def test_mistakes_with_increments_are_named(normalize, options, words):
    with pytest.raises(ConfigError, match=words):
        train(normalize, **options)
