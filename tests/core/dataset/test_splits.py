import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import (
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)
from physx_core.errors import ConfigError, DatasetError
from physx_core.statistics import RunningStatistics

pytestmark = pytest.mark.processes

ROWS = 3000
WALK = f"{__file__}:Walk"


class Walk(Environment):
    """Counts up; begins anew after each `length` steps, told before or after the step's data."""

    def __init__(self, *, length=5, late=False, reject=(), **kwargs):
        super().__init__(**kwargs)
        self.length, self.late, self.reject = length, late, reject

    def create(self):
        self.place = 0.0

    def init_database(self):
        self.define_training_fields(("place", float))

    def step(self):
        if not self.late and self.step_index and self.step_index % self.length == 0:
            self.place = 0.0
            self.new_episode()
        self.set_training_data(place=self.place)
        self.place += 1.0
        if self.late and (self.step_index + 1) % self.length == 0:
            self.place = 0.0
            self.new_episode()

    def check_sample(self):
        return self.step_index not in self.reject


def store(folder, source):
    with source, Dataset.create(folder) as dataset:
        for _ in range(2):
            dataset.append("training", source.batch(20))
    return Dataset.open(folder)


@pytest.fixture
def walks(folder, local):
    """Makes a dataset of two instances' walks."""
    return lambda **kwargs: store(folder, local(WALK, num_clients=2, env_kwargs=kwargs))


@pytest.fixture
def dataset(folder):
    """3000 rows of 3 instances and 60 trajectories, in several partitions."""
    number = np.arange(ROWS)
    with Dataset.create(folder, max_file_size=2e-5) as dataset:
        dataset.append(
            "training",
            {
                "x": np.random.default_rng(0).normal(3, [1, 5], (ROWS, 2)),
                "number": number,
                "env_id": (number % 3 + 1).astype("int32"),
                "episode": number // 150,
                "step": number // 3,
            },
        )
    with Dataset.open(folder) as dataset:
        yield dataset


# Trajectories -----------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [False, True])
def test_trajectories_are_cut_out_again(walks, late):
    with walks(late=late) as dataset:
        episodes = dataset.episodes("training")
        assert len(episodes) == 8
        assert {(e.env_id, e.episode) for e in episodes} == {
            (i, n) for i in (1, 2) for n in range(4)
        }
        for episode in episodes:
            assert dataset["training"]["place"][episode.rows].tolist() == [0, 1, 2, 3, 4]
            assert set(dataset["training"]["env_id"][episode.rows]) == {episode.env_id}


def test_clients_keep_the_same_numbers(walks, clients):
    with clients(WALK, num_clients=2) as source, walks() as dataset:
        assert_array_equal(dataset["training"]["episode"][:], source.batch(40)["episode"])


def test_a_rejected_sample_ends_a_trajectory(walks):
    with walks(length=100, reject=[7]) as dataset:
        lengths = [len(e.rows) for e in dataset.episodes("training") if e.env_id == 1]
        assert lengths == [7, 13]
        assert dataset["training"]["episode"][:].max() == 0


def test_another_run_begins_another_trajectory(walks, folder, local):
    walks(length=100).close()
    with Dataset.open(folder, writable=True) as dataset, local(WALK, num_clients=2) as source:
        dataset.append("training", source.batch(4))
        assert [len(e.rows) for e in dataset.episodes("training")] == [20, 20, 2, 2]


def test_rows_of_older_datasets_are_cut_by_their_steps(folder):
    with Dataset.create(folder) as dataset:
        rows = {"x": np.zeros(6), "env_id": np.ones(6, "int32"), "step": [0, 1, 2, 0, 1, 5]}
        dataset.append("training", rows)
        episodes = dataset.episodes("training")
        assert [e.rows.tolist() for e in episodes] == [[0, 1, 2], [3, 4], [5]]
        dataset.append("validation", {"x": np.zeros(3), "episode": [0, 0, 4]})
        assert [e.rows.tolist() for e in dataset.episodes("validation")] == [[0, 1], [2]]
        dataset.append("prediction", {"x": np.zeros(3)})
        with pytest.raises(DatasetError, match="where trajectories begin"):
            dataset.episodes("prediction")


# Splits -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["row", "episode"])
def test_parts_hold_each_row_once(dataset, by):
    parts = dataset.split("training", {"training": 0.7, "validation": 0.2, "test": 0.1}, by=by)
    assert list(parts) == ["training", "validation", "test"]
    assert_array_equal(np.sort(np.concatenate([p.rows for p in parts.values()])), np.arange(ROWS))
    assert [p.num_samples for p in parts.values()] == [2100, 600, 300]
    again = dataset.split("training", {"training": 0.7, "validation": 0.2, "test": 0.1}, by=by)
    other = dataset.split("training", {"training": 0.7, "validation": 0.3}, by=by, seed=1)
    assert_array_equal(parts["training"].rows, again["training"].rows)
    assert not np.array_equal(parts["training"].rows, other["training"].rows)


def test_no_trajectory_is_in_two_parts(dataset):
    parts = dataset.split("training", {"a": 0.5, "b": 0.25}, by="episode", seed=3)
    assert [p.num_samples for p in parts.values()] == [1500, 750]
    for episode in dataset.episodes("training"):
        shares = [np.isin(episode.rows, part.rows).mean() for part in parts.values()]
        assert set(shares) <= {0.0, 1.0} and sum(shares) <= 1


def test_trajectories_of_unequal_length_approximate_the_shares(folder):
    lengths = [400, 1, 1, 1, 97]
    step = np.concatenate([np.arange(length) for length in lengths])
    with Dataset.create(folder) as dataset:
        dataset.append("training", {"x": np.zeros(500), "step": step})
        for seed in range(10):
            parts = dataset.split("training", {"a": 0.8, "b": 0.2}, by="episode", seed=seed)
            assert all(part.num_samples for part in parts.values())
            assert sum(part.num_samples for part in parts.values()) == 500
            assert len(dataset.split("training", dict.fromkeys("abcde", 0.2), by="episode")) == 5


@pytest.mark.parametrize(
    ("shares", "by", "message"),
    [
        ({"a": 0.9, "b": 0.2}, "row", "add up to at most 1"),
        ({"a": 0.9, "b": 0}, "row", "must be positive"),
        ({"a": -0.1}, "row", "must be positive"),
        ({}, "row", "must be positive"),
        ({"a": float("nan")}, "row", "must be positive"),
        ({"a": 0.5, "b": 1e-6}, "row", '"b" would be empty'),
        ({"a": 0.5}, "time", '"row" or "episode"'),
        (dict.fromkeys(map(str, range(61)), 1 / 61), "episode", "60 trajectories"),
    ],
)
def test_invalid_splits_are_rejected(dataset, shares, by, message):
    with pytest.raises(ConfigError, match=message):
        dataset.split("training", shares, by=by)


def test_a_part_is_read_like_a_mode(dataset):
    part = dataset.split("training", {"a": 0.3})["a"]
    assert part.fields == dataset.fields("training") and part.num_samples == 900
    number = part["number"]
    assert_array_equal(number[:], part.rows)
    assert number[3] == part.rows[3] and number[-1] == part.rows[-1]
    assert_array_equal(number[10:20:3], part.rows[10:20:3])
    assert_array_equal(number[[5, 2]], part.rows[[5, 2]])
    assert_array_equal(number[part.rows > 2900], part.rows[part.rows > 2900])
    assert part["x"].shape == (900, 2) and len(part["x"]) == 900
    assert_array_equal(part["x"][:], dataset["training"]["x"][part.rows])
    with pytest.raises(IndexError):
        number[900]
    with pytest.raises(DatasetError, match="no field"):
        part["y"]


@pytest.mark.parametrize("order", ["exact", "blocks"])
@pytest.mark.parametrize("shuffle", [True, False])
def test_batches_of_a_part_are_exactly_its_rows(dataset, order, shuffle):
    part = dataset.split("training", {"a": 0.4}, by="episode")["a"]
    options = {"shuffle": shuffle, "seed": 5, "order": order}
    batches = list(part.batches(32, epochs=2, **options))
    assert [len(b["number"]) for b in batches] == 2 * ([32] * 37 + [16])
    epochs = np.concatenate([b["number"] for b in batches]).reshape(2, -1)
    for epoch in epochs:
        assert_array_equal(np.sort(epoch), part.rows)
    assert np.array_equal(epochs[0], part.rows) is not shuffle
    for batch in batches:
        assert_array_equal(batch["x"], dataset["training"]["x"][batch["number"]])
    again = np.concatenate([b["number"] for b in part.batches(1200, reuse=True, **options)])
    assert_array_equal(again, epochs[0])


def test_a_part_of_many_blocks_on_the_disk(folder):
    number = np.arange(60_000)
    with Dataset.create(folder, max_file_size=1e-3) as dataset:
        dataset.append("training", {"number": number, "x": np.outer(number, np.ones(9))})
        part = dataset.split("training", {"a": 0.3, "b": 0.001})["b"]
        batches = list(part.batches(7, shuffle=True, seed=0, order="blocks"))
    assert_array_equal(np.sort(np.concatenate([b["number"] for b in batches])), part.rows)
    assert all((b["x"] == b["number"][:, None]).all() for b in batches)


def test_rows_added_later_are_in_no_part(folder):
    with Dataset.create(folder) as dataset:
        dataset.append("training", {"x": np.arange(100.0)})
        part = dataset.split("training", {"a": 1})["a"]
        dataset.append("training", {"x": np.arange(100.0)})
        assert sum(len(b["x"]) for b in part.batches(7, shuffle=True, epochs=1)) == 100


def test_a_part_is_normalized_by_its_own_rows(dataset):
    part = dataset.split("training", {"a": 0.1})["a"]
    found = part.normalization()
    assert set(found) == {"x"}
    rows = dataset["training"]["x"][part.rows]
    statistics = RunningStatistics()
    statistics.update(rows)
    wanted = statistics.normalization()
    for name in ("mean", "std", "minimum", "maximum"):
        assert_allclose(getattr(found["x"], name), getattr(wanted, name), rtol=1e-12)
    batch = next(part.batches(300, normalize=True))
    assert_allclose(batch["x"].mean(axis=0), 0, atol=1e-12)


# Training ---------------------------------------------------------------------------------------


@pytest.fixture
def numbered(folder):
    """Rows whose y is 2 x."""
    x = np.random.default_rng(0).normal(4, 3, (200, 1))
    with Dataset.create(folder) as dataset:
        rows = {"x": x, "y": 2 * x, "number": np.arange(200), "step": np.arange(200) % 20}
        dataset.append("training", rows)
    return folder


class Numbered(Training):
    """Notes which rows it learns from, and which it validates with."""

    def train_begin(self):
        self.learned, self.held = [], []

    def epoch_begin(self):
        self.expected = self._epoch_batches

    def batch_end(self):
        self.learned += self.batch["x"].ravel().tolist()

    def validate(self):
        batches = self.data.validation_batches(self.learner.batch_fields)
        self.held = [v for batch in batches for v in batch["x"].ravel().tolist()]
        return super().validate()


def numbered_training(folder, seed=0, environment=None, **options):
    network = {"net_fields": "x", "opt_fields": "y"}
    return Numbered(
        NetworkConfig("toy/linear", network_kwargs=network, data_type="float64"),
        DatasetConfig(existing_dir=None if environment else str(folder), **options),
        environment,
        epoch_nb=1,
        batch_size=16,
        batch_nb=3 if environment else None,
        seed=seed,
    )


@pytest.mark.parametrize("by", ["row", "episode"])
def test_a_training_holds_samples_back(numbered, by):
    training = numbered_training(numbered, validation_split=0.2, split_by=by, normalize=True)
    training.execute()
    with Dataset.open(numbered) as dataset:
        x = dataset["training"]["x"][:].ravel()
        part = dataset.split("training", {"t": 0.8, "v": 0.2}, by=by)
    assert sorted(training.learned) == sorted(x[part["t"].rows])
    assert training.held == x[part["v"].rows].tolist()
    assert training.expected == 10 and training.validation_loss < 1e-12
    mean = training.learner.transformation.normalization["x"].mean
    assert_allclose(mean, np.mean(training.learned))


def test_each_training_holds_back_the_same_samples(numbered):
    runs = [numbered_training(numbered, seed, validation_split=0.1) for seed in (1, 2)]
    for run in runs:
        run.execute()
    assert runs[0].held == runs[1].held and runs[0].learned != runs[1].learned


def test_a_validation_mode_is_used_in_place_of_a_split(numbered):
    with Dataset.open(numbered, writable=True) as dataset:
        rows = {"x": np.ones((3, 1)), "y": np.ones((3, 1)), "number": range(3), "step": range(3)}
        dataset.append("validation", rows)
    training = numbered_training(numbered, validation_split=0.2)
    training.execute()
    assert training.held == [1, 1, 1] and len(training.learned) == 200


def test_generated_samples_cannot_be_held_back(folder):
    environment = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    with pytest.raises(ConfigError, match="Generate the samples first"):
        numbered_training(folder, environment=environment, validation_split=0.2).execute()


def test_without_validation_nothing_is_held_back(numbered):
    training = numbered_training(numbered)
    training.execute()
    assert len(training.learned) == 200 and np.isnan(training.validation_loss)
