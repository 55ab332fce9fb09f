"""Trainings on views: windows, mixtures, weights, and what an interrupted one goes on with."""

import numpy as np
import pytest

from physx_core import (
    Batches,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    View,
    checkpoint,
)
from physx_core.dataset.read.access import memory
from physx_core.errors import ConfigError, DatasetError
from physx_core.views import sources

WINDOW = {"past": ("x", [-1, 0]), "next": ("x", 1)}


def store(folder, count, first=0):
    """Write trajectories of 10 rows of one instance; x grows by 1 in each step."""
    number = np.arange(first * 10, (first + count) * 10)
    rows = {"x": 1.0 * number[:, None], "y": 2.0 * number[:, None], "step": number % 10,
            "episode": number // 10, "env_id": np.ones(len(number), int)}  # fmt: skip
    is_new = not (folder / "dataset.json").exists()
    with Dataset.create(folder) if is_new else Dataset.open(folder, writable=True) as dataset:
        dataset.append("training", rows)


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store(tmp_path / "a", 40)
    store(tmp_path / "b", 20)


class Stopped(Exception):
    """Ends a training within an epoch."""


class Followed(Training):
    """Notes the samples of each batch; may end within an epoch."""

    ends = None

    def optimize(self):
        if self.ends is not None and len(self.seen) == self.ends:
            raise Stopped
        self.seen.append({name: values.copy() for name, values in self.batch.items()})
        super().optimize()


def train(data, fields=("past", "next"), ends=None, **options):
    network = NetworkConfig("toy/linear", {"net_fields": fields[0], "opt_fields": fields[1]})
    usual = {"epoch_nb": 2, "batch_size": 16, "seed": 0, "quiet": True, "session_name": "run"}
    training = Followed(network, data, **(usual | options))
    training.seen, training.ends = [], ends
    training.execute()
    return training


def test_a_folder_and_a_view_stand_for_their_configuration():
    several = [train(each, ("x", "y"), session_name=name).seen for name, each in (
        ("path", "a"), ("config", DatasetConfig(existing_dir="a")),
        ("view", View(sources={"a": 1.0})),
    )]  # fmt: skip
    for batches in several[1:]:
        assert [b["x"].tolist() for b in batches] == [b["x"].tolist() for b in several[0]]
    with pytest.raises(ConfigError, match="dataset_config is 3"):
        train(3)


@pytest.mark.reported(
    "ace#448", "anemoi-core#543", about="lengths of windows as an option of the loader"
)
def test_windows_are_learned_from_and_validated_with():
    view = View(window=WINDOW, fold=0)
    training = train(DatasetConfig(existing_dir="a", view=view, normalize=True), epoch_nb=3)
    assert training.validation_loss < 1e-6
    for batch in training.seen:
        assert batch["past"].shape[1:] == (2, 1) and batch["next"].shape[1:] == (1,)
        np.testing.assert_array_equal(batch["next"], batch["past"][:, 1] + 1)
    held = {int(row) // 10 for b in train(DatasetConfig(existing_dir="a", view=view)).seen
            for row in b["next"][:, 0]}  # fmt: skip
    assert len(held) == 32
    fields = checkpoint.read(training.checkpoint_path).fields
    assert fields["past"].shape == (2, 1)


def test_trajectories_are_sought_once_for_all_parts(monkeypatch):
    sought, find = [], sources.find_trajectories
    monkeypatch.setattr(
        sources, "find_trajectories", lambda rows: sought.append(rows) or find(rows)
    )
    training = train(View(sources={"a": 0.5, "b": 0.5}), ("x", "y"), epoch_nb=2)
    assert len(sought) == 2 and training.validation_loss < 1e-6


def test_a_training_that_ends_before_its_next_batch_keeps_its_last(tmp_path):
    config = DatasetConfig(existing_dir="a", view=View(fold=0))
    with pytest.raises(Stopped):
        train(config, ("x", "y"), ends=20, checkpoint_every=20)
    before = checkpoint.find(tmp_path / "sessions/run", None, -1).progress.last_batch
    assert before["number"] == 19 and before["fields"] == ["x", "y"]
    resumed = train(config, ("x", "y"), resume=True)
    assert len(resumed.seen) == 20
    again = train(config, ("x", "y"), resume=True, epoch_nb=2)
    assert again.seen == []
    found = checkpoint.find(tmp_path / "sessions/run", None, -1).progress
    assert (found.last_batch["number"], found.batches_read) == (39, 40)


VIEWS = [
    View(window=WINDOW, fold=1, test_fold=2),
    View(window=WINDOW, sources={"a": 0.7, "b": 0.3}, fold=0),
    View(window=WINDOW, weights="episode", edges="pad", fold=0),
    View(window=WINDOW, order="blocks", drop_last=True, hold_back=False),
]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("ends", [5, 20])
def test_an_interrupted_training_goes_on_with_the_same_batches(tmp_path, view, ends):
    config = DatasetConfig(existing_dir=None if view.sources else "a", view=view, normalize=True)
    whole = train(config, session_name="whole")
    with pytest.raises(Stopped):
        train(config, ends=ends)
    store(tmp_path / "a", 15, first=40)
    rest = train(config, resume=True)
    assert len(rest.seen) == len(whole.seen) - ends
    for one, other in zip(rest.seen, whole.seen[ends:], strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
    np.testing.assert_array_equal(rest.learner.network.weights, whole.learner.network.weights)
    assert rest.validation_loss == pytest.approx(whole.validation_loss, nan_ok=True, abs=0)


def test_contradictions_are_named():
    with pytest.raises(ConfigError, match="not both"):
        train(DatasetConfig(existing_dir="a", view=View(sources={"b": 1.0})))
    environment = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    for view in (View(window=WINDOW), View(fold=1)):
        with pytest.raises(ConfigError, match="environments generate"):
            train(DatasetConfig(view=view), environment_config=environment, batch_nb=2)
    replayed = EnvironmentConfig("toy/spring", load_samples=True, as_tcp_ip_client=False)
    for place, view in (
        ("a", View(window=WINDOW)),
        (None, View(sources={"a": 1.0})),
        ("a", View(weights="episode")),
        ("a", View(stride=2)),
    ):
        with pytest.raises(ConfigError, match="replay single rows"):
            config = DatasetConfig(existing_dir=place, view=view)
            train(config, environment_config=replayed)


@pytest.mark.parametrize("view", [View(), View(fold=0), View(drop_last=True)])
def test_appended_rows_do_not_change_the_normalization_of_a_resumed_training(tmp_path, view):
    config = DatasetConfig(existing_dir="a", view=view, normalize=True)
    whole = train(config, ("x", "y"), session_name="whole")
    with pytest.raises(Stopped):
        train(config, ("x", "y"), ends=15)
    store(tmp_path / "a", 15, first=40)
    rest = train(config, ("x", "y"), resume=True)
    np.testing.assert_array_equal(rest.learner.network.weights, whole.learner.network.weights)


def test_the_network_is_kept_although_its_data_cannot_be_read_any_more(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    config = DatasetConfig(existing_dir="a", view=View(order="blocks"))

    def vanish(self, number):
        raise DatasetError("The disk has failed.")

    class Unlucky(Followed):
        def batch_end(self):
            if len(self.seen) == 5:
                monkeypatch.setattr(Batches, "__getitem__", vanish)

    network = NetworkConfig("toy/linear", {"net_fields": "x", "opt_fields": "y"})
    training = Unlucky(network, config, epoch_nb=1, batch_size=16, quiet=True, session_name="run")
    training.seen = []
    with pytest.raises(DatasetError, match="disk has failed"):
        training.execute()
    assert checkpoint.find(tmp_path / "sessions/run", None, -1).progress.batch == 5


def test_a_mode_of_validation_samples_that_comes_later_does_not_change_what_is_learned(tmp_path):
    config = DatasetConfig(existing_dir="a", view=View(fold=0))
    whole = train(config, ("x", "y"), session_name="whole")
    with pytest.raises(Stopped):
        train(config, ("x", "y"), ends=15)
    with Dataset.open("a", writable=True) as dataset:
        view = dataset["training"]
        dataset.append("validation", {name: view[name][:20] for name in view})
    rest = train(config, ("x", "y"), resume=True)
    np.testing.assert_array_equal(rest.learner.network.weights, whole.learner.network.weights)
    assert rest.validation_loss == whole.validation_loss
