"""How good a stored network is: predictions that are fed back, other samples, other resolutions."""

from __future__ import annotations

import json

import numpy as np
import pytest

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training, View, evaluate
from physx_core.cli import main
from physx_core.errors import CheckpointError, ConfigError, DatasetError, UsageError
from physx_core.results import read_results

ROWS, EPISODES = 12, 20


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def line(number, rows=ROWS, push=0.0):
    """Return a straight motion: position and velocity, shape (rows, 2)."""
    begin, velocity = np.random.default_rng(number).uniform(0.5, 2.0, 2)
    position = begin + (velocity + push) * np.arange(rows + 1)
    return np.stack([position, np.full(rows + 1, velocity)], axis=1)


def store(name, episodes=range(EPISODES), cells=None, *, jumps=False):
    """Store motions: as a series, and each row with the value after it."""
    shape = (2,) if cells is None else (cells, cells, 2)
    with Dataset.create(name) as data:
        axes = () if cells is None else ("y", "x", "channel")
        after = Field("after", shape, like="state", axes=axes)
        fields = [Field("state", shape, axes=axes), after, Field("push", (1,))]
        numbers = [Field(each, (), "int64", role="additional") for each in ("episode", "step")]
        data.define_fields("training", [*fields, *numbers])
        for episode in episodes:
            push = 0.1 * (episode % 3)
            motion = line(episode, push=push)
            if cells is not None:
                motion = np.broadcast_to(motion[:, None, None], (len(motion), cells, cells, 2))
            rows = {
                "state": motion[:-1] * (np.random.default_rng(0).normal() if jumps else 1.0),
                "after": motion[1:],
                "push": np.full((ROWS, 1), push),
                "episode": np.full(ROWS, episode),
                "step": np.arange(ROWS),
            }
            data.append("training", rows)
    return name


def train(data, view=None, reads=("state", "push"), learns="after", network=None):
    linear = NetworkConfig("toy/linear", {"net_fields": list(reads), "opt_fields": learns})
    config = DatasetConfig(existing_dir=data, view=view or View(test_fold=1), normalize=True)
    with Training(
        network or linear, config, epoch_nb=3, batch_size=16, seed=0, session_name="net", quiet=True
    ) as run:
        run.execute()
        return run.session.path


def test_predictions_are_fed_back_in_episodes_that_decided_nothing():
    session = train(store("data"))
    result = evaluate(session)
    rollout = result.rollouts["after"]
    assert list(result.parts) == ["validation", "test"] and rollout.part == "test"
    assert list(rollout.rows) == list(range(1, ROWS + 1))
    assert rollout.episodes == 4
    assert rollout.errors[0] == pytest.approx(result["test/after/rmse"], rel=1.0)
    assert rollout.unchanged[-1] == pytest.approx(ROWS * rollout.unchanged[0], rel=1e-6)
    assert result["rollout/after/rmse"] == rollout.errors[-1]
    assert "predictions fed back: 4 episodes (test), 12 rows" in str(result)
    kept = read_results(session)["evaluation"].to_json()
    assert kept == result.to_json()


@pytest.mark.parametrize(("past", "later", "rows"), [(0, 1, 11), ([-1, 0], [1, 2], 10)])
def test_windows_are_fed_back(past, later, rows):
    view = View(window={"past": ("state", past), "next": ("state", later)})
    result = evaluate(train(store("data"), view, ["past"], "next"))
    rollout = result.rollouts["next"]
    assert rollout.rows[-1] == rows and rollout.part == "validation"


def test_what_leaves_gaps_is_not_fed_back():
    view = View(window={"past": ("state", [-1, 0]), "next": ("state", 3)})
    session = train(store("data"), view, ["past"], "next")
    result = evaluate(session)
    assert not result.rollouts and "leaves gaps" in str(result)
    with pytest.raises(UsageError, match="leaves gaps"):
        evaluate(session, steps=3)


def test_rows_that_do_not_follow_one_another_are_not_fed_back():
    result = evaluate(train(store("data", jumps=True)))
    assert not result.rollouts
    assert "do not go on where the one before ended" in str(result)


def test_what_is_no_input_is_not_fed_back():
    result = evaluate(train(store("data"), reads=["state"], learns="push"))
    assert not result.rollouts and result["test/push/rmse"] >= 0


def velocity(values):
    return values["state"][:, 1]


def test_an_invariant_says_how_far_predictions_drift():
    session = train(store("data"))
    drift = evaluate(session, invariants=[velocity]).rollouts["after"].invariants["velocity"]
    assert len(drift.truth) == ROWS and max(drift.truth) < 1e-6
    assert drift.prediction[-1] > drift.prediction[0] > 0
    with pytest.raises(ConfigError, match="one number for each"):
        evaluate(session, invariants=[lambda values: values["state"]])


def test_steps_bound_a_rollout():
    session = train(store("data"))
    assert evaluate(session, steps=5).rollouts["after"].rows[-1] == 5
    with pytest.raises(UsageError, match="at least 1"):
        evaluate(session, steps=0)


def test_another_dataset_is_compared_with_the_same_rivals():
    session = train(store("data"))
    result = evaluate(session, store("more", range(50, 60)))
    assert list(result.parts) == ["other"]
    assert result.parts["other"].division == "10 trajectories of more"
    assert result.parts["other"].fields["after"].rivals["linear map"].errors
    assert result.rollouts["after"].episodes == 10
    with pytest.raises(UsageError, match="was trained with"):
        evaluate(session, "data")
    with pytest.raises(DatasetError, match="mode"):
        evaluate(session, "data", mode="nothing")


@pytest.mark.slow
def test_another_resolution_is_compared_with_what_needs_no_samples():
    pytest.importorskip("torch")
    place = {"module": "torch.nn:Linear", "in_features": 2, "out_features": 2}
    names = {"net_fields": "state", "opt_fields": "after"}
    network = NetworkConfig("torch/module", place | names, loss="MSELoss", optimizer="Adam")
    session = train(store("data", cells=8), network=network)
    result = evaluate(session, store("fine", range(50, 60), cells=12), trust=True)
    rivals = result.parts["other"].fields["after"].rivals
    assert rivals["nothing changes"].errors
    assert "another shape" in rivals["linear map"].why and not rivals["linear map"].errors
    assert result.rollouts["after"].rows[-1] == ROWS


def test_a_result_of_another_version_is_replaced_and_the_others_stay():
    session = train(store("data"))
    file = session / "results.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "evaluation": {"kind": 3}}))
    result = evaluate(session, store("more", range(50, 60)))
    kept = read_results(session)
    assert kept["evaluation"].parts.keys() == result.parts.keys() == {"other"}
    assert kept["training"].parts


def test_a_network_without_held_back_samples_needs_a_dataset():
    session = train(store("data"), View(hold_back=False))
    with pytest.raises(DatasetError, match="name another dataset"):
        evaluate(session)
    assert evaluate(session, store("more", range(50, 60)))["other/after/rmse"] >= 0


def test_the_command_prints_text_or_json(capsys):
    train(store("data"))
    with pytest.raises(CheckpointError):
        evaluate("nothing")
    assert main(["evaluate", "sessions/net", "--steps", "2"]) == 0
    assert "if nothing changes" in capsys.readouterr().out
    assert main(["evaluate", "sessions/net", store("more", [70, 71]), "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["parts"]) == ["other"]
