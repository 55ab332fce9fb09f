"""Fields that an independent episode has once: they are stored with its record, whoever made it."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from campaigns import stream

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.cli import main
from physx_core.dataset import EPISODES, EpisodeStatus
from physx_core.errors import ConfigError, DependentEpisodeError, FieldsMismatchError, UsageError

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAM = """
import time
import numpy as np
from physx_core import Environment, Field, Parameter

class Case(Environment):
    independent_episodes = True

    def __init__(self, *, fails=None, shape=4, parameters=False, sleep=0.0, **kwargs):
        super().__init__(**kwargs)
        self.fails, self.shape = {int(k): v for k, v in (fails or {}).items()}, shape
        self.has_parameters, self.sleep = parameters, sleep

    def create(self):
        if self.has_parameters:
            self.define_parameters(Parameter("p", 1.0, 2.0, unit="kg"))

    def init_database(self):
        self.define_training_fields(Field("x", ()))
        nodes = Field("nodes", (self.shape, 2), "float32", "m")
        self.define_episode_fields([nodes, ("fixed", int)])

    def reset_parameters(self, p=0.0):
        self.left = int(self.rng.integers(1, 4))
        self.nodes = np.full((self.shape, 2), self.episode_index)
        self.set_episode_data(nodes=self.nodes, fixed=1)
        self.nodes[:] = -1  # it was copied

    def step(self):
        time.sleep(self.sleep)
        self.set_training_data(x=self.rng.normal())
        self.set_episode_data(fixed=10 * self.episode_index)
        self.left -= 1
        if not self.left:
            if trouble := self.fails.get(self.episode_index):
                meet(self, trouble)
            self.end_episode()

def meet(case, trouble):
    if trouble == "raises":
        raise RuntimeError("no beans")
    if trouble == "misses":
        del case._episode_data["nodes"]
    if trouble == "not finite":
        case.set_episode_data(nodes=np.full((case.shape, 2), np.nan))
    if trouble == "of another shape":
        case.set_episode_data(nodes=[1, 2])
    if trouble == "of another type":
        case.set_episode_data(fixed=0.5)
    if trouble == "depends":
        case.set_episode_data(fixed=time.monotonic_ns())

class Single(Case):
    episode_steps = 1

class Picky(Case):
    def check_sample(self):
        return self.left == 0

class Stream(Case):
    independent_episodes = False

class Renamed(Case):
    def init_database(self):
        self.define_training_fields(Field("x", ()))
        self.define_episode_fields(Field("rows", ()))
"""
TROUBLES = {
    "raises": "no beans",
    "misses": 'Field "nodes" of the episode was not set: call set_episode_data()',
    "not finite": 'Field "nodes" holds NaN',
    "of another shape": 'Field "nodes" has shape (2,)',
    "of another type": 'Field "fixed" holds float64',
}


@pytest.fixture(autouse=True)
def case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case.py").write_text(PROGRAM)


def config(name="Case", clients=0, **env_kwargs):
    return EnvironmentConfig(f"case.py:{name}", seed=1, env_kwargs=env_kwargs,
                             as_tcp_ip_client=clients > 0, num_clients=max(1, clients))  # fmt: skip


def generate(made, name="run", episodes=8, **options):
    options = {"prove_independence": False, "quiet": True, **options}
    if options.get("batch_nb"):
        episodes = None
    run = DataGeneration(made, session_name=name, episodes=episodes, **options)
    run.execute()


def episodes(dataset):
    """Return the records of independent episodes, by field."""
    table = dataset.episode_table(["training"])
    own = table["status"] != EpisodeStatus.STREAM
    return {name: column[own] for name, column in table.items()}


def check(name="run", total=8, failed=()):
    """Compare the values of a session's episodes with those of their numbers."""
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        fields = dataset.fields(EPISODES)
        assert (fields["nodes"].role, fields["nodes"].unit) == ("episode", "m")
        assert fields["nodes"].numpy_dtype == np.float32
        assert "p" not in fields or fields["p"].unit == "kg"
        table = episodes(dataset)
        assert table["episode"].tolist() == list(range(total))
        good = np.array([number not in failed for number in range(total)])
        assert (table["status"] == EpisodeStatus.FAILED).tolist() == (~good).tolist()
        numbers = np.arange(total) * good
        assert (table["nodes"] == numbers[:, None, None]).all()
        assert table["fixed"].tolist() == (10 * numbers).tolist()
        assert table["count"].tolist() == [1] * total
        own = dataset["training"]["episode"][:]
        assert (dataset.episode_values("training", "fixed", slice(None)) == 10 * own).all()
        picked = np.arange(len(own))[::-2]
        nodes = dataset.episode_values("training", "nodes", picked)
        assert (nodes == own[picked][:, None, None]).all()
        return table, dataset["training"]["x"][:].tobytes()


@pytest.mark.parametrize("parameters", [False, True])
@pytest.mark.parametrize("name", ["Case", "Single"])
def test_each_episode_has_its_own_however_many_clients_there_are(name, parameters):
    found = []
    for clients in range(3):
        made = config(name, clients, parameters=parameters, fails={"3": "raises"})
        if name == "Single":
            made = dataclasses.replace(made, env_kwargs={"parameters": parameters})
        generate(made, f"of{clients}", 40, max_failed=1)
        failed = [3] if name == "Case" else []
        table, rows = check(f"of{clients}", 40, failed)
        found.append(({n: c.tobytes() for n, c in table.items() if n != "seconds"}, rows))
    assert found[0] == found[1] == found[2]


def test_large_fields_are_stored_in_pieces():
    for clients in (0, 2):
        generate(config("Single", clients, shape=200_000), f"of{clients}", 12)
        check(f"of{clients}", 12)


@pytest.mark.parametrize("clients", [0, 1])
def test_wrong_values_fail_their_episode_alone(clients):
    fails = {str(2 * number): trouble for number, trouble in enumerate(TROUBLES)}
    generate(config(clients=clients, fails=fails), episodes=12, max_failed=9)
    check(total=12, failed=[0, 2, 4, 6, 8])
    with Dataset.open("sessions/run") as dataset:
        reasons = [each.reason for each in dataset.failed_episodes("training")]
    for reason, expected in zip(reasons, TROUBLES.values(), strict=True):
        assert expected in reason


@pytest.mark.parametrize("clients", [0, 2])
def test_cut_episodes_keep_theirs_until_they_are_extended(clients):
    generate(config(clients=clients), batch_nb=1, batch_size=10)
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 10
    lengths = [int(stream(number, [1, 0]).integers(1, 4)) for number in range(20)]
    total = int(np.searchsorted(np.cumsum(lengths), 10)) + 1
    for rows in (10, 17):
        generate(config(clients=clients), batch_nb=1, batch_size=rows, resume=True)
        with Dataset.open("sessions/run") as dataset:
            assert dataset.num_samples("training") == rows
            table = episodes(dataset)
            with_rows = table["rows"] > 0
            numbers = table["episode"][with_rows]
            assert (table["fixed"][with_rows] == 10 * numbers).all()
            assert (table["nodes"][with_rows] == numbers[:, None, None]).all()
            if rows == 10:
                assert len(numbers) == total


@pytest.mark.slow
def test_killed_campaign_is_resumed():
    made = ["case.py:Case", "--environment.seed", "1", "--environment.num-clients", "2"]
    words = [*made, "--episodes", "60", "--session-name", "run", "--no-prove-independence",
             "--environment.env-kwargs.sleep", "0.01"]  # fmt: skip
    command = [sys.executable, "-m", "physx_core", "generate"]
    process = subprocess.Popen([*command, *words], stdout=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while not list(Path("sessions").glob("run/**/*fixed*")) and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(0.3)
    process.kill()
    process.wait()
    assert main(["generate", "sessions/run", "--resume"]) == 0
    generate(config(sleep=0.0), "whole", 60)
    (table, rows), (other, whole) = check("run", 60), check("whole", 60)
    assert rows == whole
    assert all(table[name].tobytes() == other[name].tobytes() for name in ("nodes", "fixed"))


def test_compacting_and_merging_keep_them(capsys):
    generate(config(clients=2), "one")
    generate(config(fails={"2": "raises"}), "two", max_failed=1)
    before, _ = check("one")
    assert main(["compact", "sessions/one"]) == 0
    after, _ = check("one")
    assert all(before[name].tobytes() == after[name].tobytes() for name in ("nodes", "fixed"))
    with Dataset.open("sessions/one", writable=True) as dataset:
        dataset.merge("sessions/two/dataset")
        table = episodes(dataset)
        numbers = table["episode"] * (table["status"] == EpisodeStatus.FINISHED)
        assert len(numbers) == 16
        assert (table["fixed"] == 10 * numbers).all()
        assert (table["nodes"] == numbers[:, None, None]).all()
    capsys.readouterr()
    assert main(["info", "sessions/one"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "nodes" in line]
    assert line.split()[:3] == ["nodes", "episode", "float32"]


def test_proof_of_independence_compares_them():
    made = config(sleep=0.001, fails={str(number): "depends" for number in range(300)})
    with pytest.raises(DependentEpisodeError) as caught:
        generate(made, episodes=300, prove_independence=True)
    assert caught.value.field == "fixed"


def test_replayed_rows_get_parameters_without_them():
    from physx_core.pipelines.stored_sets import find_sets

    generate(config(), "plain")
    generate(config(parameters=True), "chosen")
    with Dataset.open("sessions/plain") as dataset:
        assert find_sets(dataset, "training") is None
    with Dataset.open("sessions/chosen") as dataset:
        found = find_sets(dataset, "training").of(np.arange(2), {})
    assert list(found)[1:] == ["parameters/p"]


def test_rejected_samples_have_those_of_their_episode():
    made = dataclasses.replace(config("Picky"), record_wrong_samples=True)
    generate(made)
    with Dataset.open("sessions/run") as dataset:
        numbers = dataset["wrong"]["episode"][:]
        assert len(numbers) > 2
        found = dataset.episode_values("wrong", "fixed", slice(None))
        assert found.tolist() == (10 * numbers).tolist()
    check()


# Mistakes ----------------------------------------------------------------------------------------


def test_streams_have_none():
    with pytest.raises(UsageError, match="define additional fields.*independent_episodes = True"):
        generate(config("Stream"), episodes=None, batch_nb=1, batch_size=2)
    made = dataclasses.replace(config(), independent_episodes=False)
    with pytest.raises(ConfigError, match="Leave out independent_episodes=False"):
        generate(made, batch_nb=1, batch_size=2)


def test_names_of_the_record_are_taken():
    with pytest.raises(ConfigError, match='The name "rows"'):
        generate(config("Renamed"))


def test_another_shape_is_found_before_anything_is_simulated():
    generate(config())
    with pytest.raises(FieldsMismatchError, match="nodes"):
        generate(config(shape=5), mode="validation", new_session=False)
