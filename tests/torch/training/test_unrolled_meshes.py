"""Networks on meshes that learn from, and are judged on, several steps of their own predictions."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training, View, evaluate
from physx_core.dataset import EpisodeRecord
from physx_core.errors import ConfigError
from physx_core.pipelines import load_learner
from physx_torch import TorchOptimization

SIZES, LENGTH, STEPS, BATCH = (4, 2, 3, 5, 2), 7, 3, 6
WINDOWS = {
    "past": ("u", 0), "next": ("u", 1), "sides": ("edge", 0), "push": ("load", 0),
    "ends": ("tips", 0),
}  # fmt: skip
GRAPH = {
    "nodes": 3, "outputs": 2, "hidden": 6, "steps": 2,
    "net_fields": ["past", "sides", "push"], "opt_fields": "next",
}  # fmt: skip


class Pointwise(torch.nn.Module):
    """Maps nodes with their sample's load and the values at two of its nodes."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(7, 2)

    def forward(self, past, push, ends, mask):
        nodes = past.shape[1]
        tips = torch.take_along_dim(past, ends[..., None], 1).flatten(1)
        shared = torch.cat([push[:, None], tips], 1)
        return torch.tanh(self.layer(torch.cat([past, shared[:, None].expand(-1, nodes, -1)], 2)))


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def episode(number, size):
    """Values of the nodes of a chain that swings, a load, edges, and the tips, of each row."""
    rng = np.random.default_rng(number)
    return {
        "u": np.cumsum(rng.normal(size=(LENGTH, size, 2)), axis=0) * 0.3,
        "load": rng.normal(size=LENGTH),
        "edge": np.stack([[np.arange(size - 1), np.arange(1, size)]] * LENGTH).swapaxes(1, 2),
        "tips": np.tile([0, size - 1], (LENGTH, 1)),
    }


def store(change=lambda number, rows: rows, name="data"):
    with Dataset.create(name) as dataset:
        nodes = Field("u", ("node", 2)), Field("edge", ("edge", 2), "int64", indexes="node")
        others = Field("load", ()), Field("tips", (2,), "int64", indexes="node")
        dataset.define_fields("training", [*nodes, *others])
        for number, size in enumerate(SIZES):
            rows = {n: list(v) for n, v in change(number, episode(number, size)).items()}
            dataset.append_episodes("training", rows, [EpisodeRecord(episode=number, rows=LENGTH)])


def training(network="torch/graph", kwargs=GRAPH, windows=WINDOWS, **options):
    config = NetworkConfig(
        network, kwargs, loss="MSELoss", optimizer="SGD", lr=0.1, device="cpu", data_type="float64"
    )
    data = DatasetConfig(
        existing_dir="data", normalize=True, view=View(window=windows, hold_back=False)
    )
    given = {"epoch_nb": 1, "batch_size": BATCH, "seed": 0, "quiet": True, "unroll": [STEPS]}
    return Training(config, data, **{**given, "rivals": "none", **options})


def padded():
    fields = {"net_fields": ["past", "push", "ends"], "opt_fields": "next"}
    return {"network": "torch/padded", "kwargs": {"module": Pointwise, **fields}}


def expected(module, rows, normalization, by):
    """Return the loss, computed mesh by mesh and step by step, as a mean over all entries."""
    found = []
    (m0, s0), (m1, s1), (mp, sp) = (
        (torch.tensor(normalization[n].mean), torch.tensor(normalization[n].std))
        for n in ("past", "next", "push")
    )
    for row in rows.tolist():
        number, first = divmod(row, LENGTH)
        known = {n: torch.from_numpy(v) for n, v in episode(number, SIZES[number]).items()}
        state = known["u"][first]
        for step in range(first, first + STEPS):
            inputs = (state - m0) / s0, (known["load"][step : step + 1] - mp) / sp
            output = by(module, *inputs, known["edge"][step], known["tips"][step])
            found.append((output - (known["u"][step + 1] - m1) / s1).square().flatten())
            state = output * s1 + m1
    return torch.cat(found).mean()


def graph_alone(module, past, push, edges, tips):
    return module(past, edges, push, torch.zeros(len(past), dtype=torch.int64))


def padded_alone(module, past, push, edges, tips):
    return module(past[None], push, tips[None], None)[0]


@pytest.mark.parametrize("kind", ["graph", "padded"])
def test_the_loss_and_its_gradient_are_those_of_each_mesh_alone(kind):
    store()
    with training(**(padded() if kind == "padded" else {})) as run:
        run.train_begin()
        run.epoch_begin()
        run.batch_begin()
        network = run.learner.network
        own = network.module if kind == "padded" else network
        twin = copy.deepcopy(own)
        (rows,) = run.data.stored._read.rows(0)
        by = padded_alone if kind == "padded" else graph_alone
        loss = expected(twin, rows, run.learner.transformation.normalization, by)
        loss.backward()
        run.batch_produce()
        run.optimize()
        assert run.losses["loss"] == pytest.approx(loss.item(), rel=1e-9)
        for mine, parameter in zip(own.parameters(), twin.parameters(), strict=True):
            torch.testing.assert_close(mine.detach(), parameter.detach() - 0.1 * parameter.grad)
    assert len(rows) == BATCH and max(rows % LENGTH) + STEPS < LENGTH


class Looking(TorchOptimization):
    """Keeps what its loss gets."""

    def compute_loss(self, batch):
        self.seen = batch.data
        return super().compute_loss(batch)


@pytest.mark.parametrize("kind", ["graph", "padded"])
def test_a_loss_gets_the_meshes_of_all_steps_one_after_another(kind):
    store()
    run = training(**(padded() if kind == "padded" else {}), noise=0.1, batch_nb=1)
    run.network_config = replace(run.network_config, optimization=Looking)
    run.execute()
    data = run.learner.optimization.seen
    ptr = data["node_ptr"]
    assert len(ptr) == BATCH * STEPS + 1 and ptr[-1] == len(data["past"]) == len(data["next"])
    samples = torch.repeat_interleave(torch.arange(BATCH * STEPS), ptr.diff())
    assert torch.equal(data["node_batch"], samples)
    if kind == "padded":
        assert torch.equal(data["ends"], torch.stack([ptr[:-1], ptr[1:] - 1], 1))
    else:
        first, second = data["sides"].T
        assert torch.equal(first + 1, second) and torch.equal(samples[first], samples[second])
        assert len(first) == len(samples) - BATCH * STEPS


def remesh(number, rows):
    """Turn the edges of an episode around, halfway."""
    if number == 1:
        rows["edge"][4:] = rows["edge"][4:, :, ::-1]
    return rows


def grow(number, rows):
    """Give the mesh of an episode more nodes, halfway."""
    later = episode(number, SIZES[number] + (number == 1))
    return {name: [*values[:4], *later[name][4:]] for name, values in rows.items()}


@pytest.mark.parametrize(
    ("change", "what"), [(remesh, "which entries it numbers"), (grow, 'size of its axis "node"')]
)
def test_a_mesh_that_changes_within_a_window_is_named(change, what):
    store(change)
    with pytest.raises(ConfigError, match=f"within a window of .* {what} changes"):
        training().execute()


def test_windows_of_several_rows_of_a_mesh_are_refused():
    store()
    with pytest.raises(ConfigError, match="windows of one row"):
        training(windows={**WINDOWS, "past": ("u", [-1, 0])}).execute()


def fed_back(learner, number):
    """Return the mean squared errors of an episode whose predictions are fed back, and of rest."""
    rows = episode(number, SIZES[number])
    state, found = rows["u"][0], []
    for step in range(LENGTH - 1):
        given = {"past": state, "sides": rows["edge"][step], "ends": rows["tips"][step]}
        answer = learner.predict(
            {name: np.fromiter([value], object, 1) for name, value in given.items()}
            | {"push": rows["load"][step : step + 1], "ends": given["ends"][None]}
        )
        state, truth = answer["next"][0], rows["u"][step + 1]
        found.append([np.square(each - truth).mean() for each in (state, rows["u"][0])])
    return found


@pytest.mark.parametrize("kind", ["graph", "padded"])
def test_predictions_on_meshes_are_fed_back_in_each_episode(kind):
    store()
    store(name="other")
    run = training(**(padded() if kind == "padded" else {}))
    run.execute()
    session = run.session.path
    rollout = evaluate(session, "other", trust=True).rollouts["next"]
    learner = load_learner(session, trust=True)
    squares = np.array([fed_back(learner, number) for number in range(len(SIZES))])
    errors = np.sqrt(squares.mean(axis=0)).T
    np.testing.assert_allclose([rollout.errors, rollout.unchanged], errors, rtol=1e-5)
    assert rollout.rows == tuple(range(1, LENGTH))


def test_predictions_on_a_mesh_that_changes_are_not_fed_back():
    nodes = Field("u", ("node", 2)), Field("edge", ("edge", 2), "int64", indexes="node")
    for name in ("data", "other"):
        with Dataset.create(name) as dataset:
            fields = [*nodes, Field("after", ("node", 2), like="u")]
            dataset.define_fields("training", fields)
            parts = [episode(1, 3), episode(1, 4)]  # a node more in the second row
            rows = {each: [part[each][0] for part in parts] for each in ("u", "edge")}
            rows["after"] = rows["u"]
            dataset.append_episodes("training", rows, [EpisodeRecord(episode=0, rows=2)])
    given = {**GRAPH, "nodes": 2, "net_fields": ["u", "edge"], "opt_fields": "after"}
    run = training(kwargs=given, windows={}, batch_size=1, unroll=[])
    run.execute()
    result = evaluate(run.session.path, "other")
    assert not result.rollouts and result["other/after/rmse"] > 0
    assert 'the size of the axis "node" changes' in str(result)


def test_windows_of_several_rows_of_a_mesh_are_not_fed_back():
    store()
    store(name="other")
    each = {"in_features": 2, "out_features": 2, "net_fields": "past", "opt_fields": "next"}
    two = {"past": ("u", [-1, 0]), "next": ("u", [1, 2])}
    run = training(torch.nn.Linear, each, two, unroll=[])
    run.execute()
    result = evaluate(run.session.path, "other", trust=True)
    assert not result.rollouts and "several rows" in str(result)
