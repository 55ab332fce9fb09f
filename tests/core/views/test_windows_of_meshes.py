"""Windows of several rows of free axes, against lists of the rows."""

import os
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field, View
from physx_core.dataset import EpisodeRecord

FIELDS = [
    Field("x", ("node", 2), unit="m"),
    Field("edge", ("edge", 2), "int32", indexes="node"),
    Field("pair", (2,), "int64", indexes="node"),
    Field("load", ()),
]
WINDOWS = {
    "load_now": ("load", 0), "x_now": ("x", 0), "edge_past": ("edge", [-2, 0]), "load_past":
    ("load", [-2, 0]), "x_past": ("x", [-2, 0]), "pair_past": ("pair", [-2, 0]), "x_next":
    ("x", [1]),
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def nothing_reaches_the_disk():
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fsync", "fdatasync"):  # nothing here depends on that
            patch.setattr(os, name, lambda descriptor: None)
        yield


def row(episode, step):
    """The row of an episode; some meshes have no edges."""
    nodes, edges = 1 + (episode * 5 + step * 3) % 4, (episode + 2 * step) % 3
    return {
        "x": np.arange(nodes * 2.0).reshape(nodes, 2) + 100 * episode + 10 * step,
        "edge": (np.arange(edges * 2).reshape(edges, 2) + step).astype("int32") % nodes,
        "pair": np.array([0, nodes - 1]),
        "load": np.float64(episode + step / 10),
    }


def store(folder, lengths):
    rows = [row(e, s) for e, length in enumerate(lengths) for s in range(length)]
    records = [EpisodeRecord(episode=e, rows=length) for e, length in enumerate(lengths)]
    with Dataset.create(folder, max_file_size=2.1e-5) as dataset:
        dataset.define_fields("training", FIELDS)
        block = {field.name: [each[field.name] for each in rows] for field in FIELDS}
        dataset.append_episodes("training", block, records)


def check(batch, windows, pads):
    """Compare a batch with the rows of each window: lists of (number of episode, length, step)."""
    past, now = [], []
    for episode, length, step in windows:
        here = [min(max(step + offset, 0), length - 1) for offset in (-2, 0, 1)]
        past += [row(episode, each) for each in here[:2]]
        now.append(row(episode, step))
        shown = batch["x_past_is_pad"][len(now) - 1].tolist() if pads else [False, False]
        assert shown == [step < 2, False] if pads else not any(shown)
    assert_array_equal(batch["x_now"], np.concatenate([each["x"] for each in now]))
    assert_array_equal(batch["x_past"], np.concatenate([each["x"] for each in past]))
    counts = [len(each["x"]) for each in past]
    assert batch["edge_past_node_sizes"].ravel().tolist() == counts
    before = np.cumsum([0, *counts])
    assert batch["edge_past_node_ptr"].tolist() == before[::2].tolist()
    assert_array_equal(batch["edge_past_node_batch"], np.repeat(np.arange(len(past)) // 2, counts))
    edges = [each["edge"] + first for each, first in zip(past, before, strict=False)]
    assert_array_equal(batch["edge_past"], np.concatenate(edges))
    pairs = [each["pair"] + first for each, first in zip(past, before, strict=False)]
    assert_array_equal(batch["pair_past"].reshape(-1, 2), pairs)
    assert_array_equal(batch["load_past"].ravel(), [each["load"] for each in past])
    following = [min(step + 1, length - 1) for _, length, step in windows]
    of = [row(e, s)["x"] for (e, _, _), s in zip(windows, following, strict=True)]
    assert_array_equal(batch["x_next"], np.concatenate(of))


@pytest.mark.parametrize("edges", ["inside", "pad"])
@given(
    lengths=st.lists(st.integers(1, 7), min_size=1, max_size=5).filter(lambda own: max(own) > 3),
    size=st.integers(1, 5),
    reuse=st.booleans(),
)
@settings(max_examples=8)
def test_windows_of_several_rows_are_packed_in_a_row(tmp_path_factory, edges, lengths, size, reuse):
    folder = tmp_path_factory.mktemp("data")
    store(folder, lengths)
    low, high = (0, 0) if edges == "pad" else (2, 1)
    expected = [
        (e, length, step) for e, length in enumerate(lengths) for step in range(low, length - high)
    ]
    view = View(window=WINDOWS, hold_back=False, order="stored", edges=edges)
    with view.open(size, data=folder, reuse=reuse) as batches:
        assert batches.num_items == len(expected)
        for number in range(len(batches)):
            some = expected[number * size : (number + 1) * size]
            check(batches[number], some, edges == "pad")
            assert batches[number].keys() == batches.fields.keys()


def test_windows_of_several_rows_are_the_same_of_several_sources_and_in_other_processes(tmp_path):
    for name in ("a", "b"):
        store(tmp_path / name, [5, 4])
    sources = {str(tmp_path / name): 1.0 for name in ("a", "b")}
    view = View(sources=sources, window=WINDOWS, hold_back=False, order="stored", epoch="all")
    windows = [(0, 5, 2), (0, 5, 3), (1, 4, 2)]
    with view.open(6, seed=1) as batches:
        check(batches[0], [one for one in windows for _ in sources], pads=False)
        with pickle.loads(pickle.dumps(batches)) as others:  # noqa: S301
            check(others[0], [one for one in windows for _ in sources], pads=False)


def test_statistics_of_a_window_of_meshes_are_those_of_its_field(tmp_path):
    store(tmp_path, [5, 4])
    view = View(window=WINDOWS, hold_back=False)
    with view.open(3, data=tmp_path) as batches, Dataset.open(tmp_path) as dataset:
        found = batches.normalization()
        assert_array_equal(found["x_past"].mean, dataset.normalization_of("training")["x"].mean)
