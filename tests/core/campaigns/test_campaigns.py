"""Campaigns from start to end: how many clients, interruptions and resumed runs change no row."""

from __future__ import annotations

import dataclasses
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import sizes
from campaigns import TROUBLED, rows_of

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.cli import main
from physx_core.dataset import EpisodeStatus
from physx_core.errors import (
    ClientError,
    ConfigError,
    FailedEpisodesError,
    PhysxError,
    SessionError,
    UsageError,
)

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

SEED = 3
ENDED = (EpisodeStatus.FINISHED, EpisodeStatus.FAILED)
LOCAL = EnvironmentConfig(TROUBLED, as_tcp_ip_client=False, seed=SEED)


def generate(name, episodes, config=LOCAL, *, env_kwargs=None, clients=0, **options):
    """Simulate a campaign in a session of this name, in this process or in some clients."""
    config = dataclasses.replace(
        config,
        env_kwargs=env_kwargs or config.env_kwargs,
        as_tcp_ip_client=clients > 0,
        num_clients=max(1, clients),
    )
    options = {"prove_independence": False, **options}  # each number is to be simulated once
    run = DataGeneration(config, session_name=name, episodes=episodes, **options)
    run.execute()
    return run


def contents(name, mode="training"):
    """Return everything of a session's dataset that its readers may depend on."""
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        known = dataset.recorded_episodes(mode)
        rows = {field: values[:].tobytes() for field, values in dataset[mode].items()}
        each = [
            [number, status]
            for first, count, status in zip(
                known.episode.tolist(), known.numbers.tolist(), known.status.tolist(), strict=True
            )
            for number in range(first, first + count)
        ]
        scale = {
            field: (found.mean.tobytes(), found.std.tobytes())
            for field, found in dataset.normalization_of(mode).items()
        }
        return rows, each, scale


def numbers(name, mode="training"):
    """Return the numbers of the episodes that have ended, in order, and which of them failed."""
    _, each, _ = contents(name, mode)
    ended = [number for number, status in each if status in ENDED]
    return ended, [number for number, status in each if status == EpisodeStatus.FAILED]


def begun(log="log"):
    """Return how often the environment began each number."""
    return Counter(map(int, Path(log).read_text().split())) if Path(log).exists() else Counter()


def check_rows(name, total, troubles=None, **options):
    """Compare the rows of the first campaign of a session with the simplest model."""
    expected = [rows_of(number, [SEED, 0], troubles, **options) for number in range(total)]
    with Dataset.open(f"sessions/{name}") as dataset:
        found = dataset["training"]["x"][:].tolist()
    assert found == list(itertools.chain(*(rows for rows in expected if rows is not None)))


SCALED = """
from physx_core import Environment, Field

class Scaled(Environment):
    episode_steps = 1

    def __init__(self, *, scale, fails=False, **kwargs):
        super().__init__(**kwargs)
        self.scale, self.fails = scale, fails

    def create(self):
        self.save_parameters(scale=self.scale)

    def init_database(self):
        self.define_training_fields([Field("x", ())])

    def step(self):
        if self.fails:
            raise KeyboardInterrupt
        self.set_training_data(x=self.load_parameters()["scale"])
"""


def test_what_a_run_without_episodes_saved_does_not_count():
    Path("scaled.py").write_text(SCALED)
    config = EnvironmentConfig("scaled.py:Scaled", as_tcp_ip_client=False, seed=SEED)
    with pytest.raises(KeyboardInterrupt):
        generate("s", 2, config, env_kwargs={"scale": 1.0, "fails": True})
    generate("s", 2, config, env_kwargs={"scale": 2.0}, new_session=False)
    with Dataset.open("sessions/s") as dataset:
        assert dataset["training"]["x"][:].tolist() == [2.0, 2.0]
    with pytest.raises(UsageError, match="another value"):  # rows are there that depend on it
        generate("s", 2, config, env_kwargs={"scale": 3.0}, new_session=False)


# Who simulates -----------------------------------------------------------------------------------


TROUBLES = {"2": ["raises", 0], "11": ["is not finite", 1], "30": ["raises early", 0]}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["walks", "single rows", "parameters", "long"])
def test_datasets_are_equal_however_many_clients_there_are(kind):
    kwargs = {"troubles": TROUBLES, "least": 1}
    config, total = LOCAL, 40
    if kind == "single rows":
        config = dataclasses.replace(config, episode_steps=1)
        kwargs["troubles"], total = {"7": ["raises", 0]}, 400
    if kind == "parameters":
        config = dataclasses.replace(config, sampler="physx/sobol")
        kwargs["parameters"] = True
    if kind == "long":
        kwargs.update(troubles={**TROUBLES, "5": ["is long", 9000]}, width=30)
    for clients in range(4):
        generate(f"of{clients}", total, config, env_kwargs=kwargs, clients=clients, max_failed=3)
    expected = contents("of0")
    for clients in (1, 2, 3):
        rows, each, scale = contents(f"of{clients}")
        assert each == expected[1]
        assert rows.keys() == expected[0].keys()
        assert all(rows[name] == expected[0][name] for name in rows)
        assert scale == expected[2]


def test_rows_are_those_of_the_numbers_in_order():
    generate("run", 30, env_kwargs={"troubles": TROUBLES}, clients=2, max_failed=3)
    check_rows("run", 30, TROUBLES)
    with Dataset.open("sessions/run") as dataset:
        assert len(set(dataset["training"]["env_id"][:].tolist())) == 1
        reasons = {each.episode: each.reason for each in dataset.failed_episodes("training")}
    assert all("no more beans for 2" in reasons[number] for number in reasons if number == 2)


# Interrupted runs --------------------------------------------------------------------------------


COMMAND = [sys.executable, "-m", "physx_core", "generate"]
SLOW = {"sleep": 0.004, "least": 1, "log": "log"}


def start(*words, episodes=60, clients=0, session="cut"):
    """Start ``physx generate`` of slow episodes in the background."""
    options = ["--episodes", str(episodes), "--environment.seed", str(SEED)]
    options += ["--environment.no-as-tcp-ip-client"] if not clients else []
    options += ["--environment.num-clients", str(max(1, clients))]
    for name, value in SLOW.items():
        options += [f"--environment.env-kwargs.{name}", str(value)]
    options = [*options, "--no-prove-independence"]  # each number is to be simulated once
    command = [*COMMAND, TROUBLED, *options, "--session-name", session, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for(happened):
    deadline = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def begun_at_least(count):
    return lambda: sum(begun().values()) >= count


@pytest.mark.slow
@pytest.mark.parametrize("clients", [0, 2])
@pytest.mark.parametrize("trial", range(sizes.trials(6, 1)))
def test_killed_run_is_resumed_with_what_is_missing(clients, trial):
    rng = random.Random(f"{sizes.seed()} {clients} {trial}")
    generate("whole", 60, env_kwargs={"least": 1})
    process = start(clients=clients)
    wait_for(begun_at_least(rng.randrange(1, 60)))
    process.kill()
    process.communicate()
    wait_for(nobody_steps)
    recorded = ended("cut")
    before = begun()
    finish = subprocess.run(
        [*COMMAND, "sessions/cut", "--resume"], capture_output=True, text=True, check=False
    )
    assert finish.returncode == 0, finish.stdout + finish.stderr
    assert contents("cut") == contents("whole")
    again = begun() - before
    assert set(again) == set(range(60)) - set(recorded)
    assert set(again.values()) <= {1}


def nobody_steps():
    """Return whether the clients of a killed run have ended: the log stays as it is."""
    mark = os.environ["PHYSX_TEST_MARK"].encode()
    for environ in (folder / "environ" for folder in Path("/proc").glob("[0-9]*")):
        try:
            if mark in environ.read_bytes() and int(environ.parent.name) != os.getpid():
                return False
        except OSError:
            continue
    return True


def ended(name):
    """Return the numbers that a session, which may have no rows yet, has recorded."""
    try:
        with Dataset.open(f"sessions/{name}") as dataset:
            if "training" not in dataset.modes:
                return []
    except PhysxError:
        return []
    return numbers(name)[0]


@pytest.mark.parametrize("clients", [0, 2])
def test_interrupted_run_keeps_what_has_finished(clients):
    generate("whole", 60, env_kwargs={"least": 1})
    process = start(clients=clients)
    wait_for(begun_at_least(25))
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode
    assert "physx generate sessions/cut --resume" in said
    recorded, failed = numbers("cut")
    assert len(recorded) >= 5
    assert not failed
    before = begun()
    assert main(["generate", "sessions/cut", "--resume"]) == 0
    assert contents("cut") == contents("whole")
    assert set(begun() - before) == set(range(60)) - set(recorded)


@pytest.mark.slow
def test_campaign_is_killed_again_and_again():
    generate("whole", 60, env_kwargs={"least": 1})
    process = start()
    for share in (10, 30, 50):
        wait_for(begun_at_least(share))
        process.kill()
        process.communicate()
        process = subprocess.Popen(
            [*COMMAND, "sessions/cut", "--resume"], stdout=subprocess.PIPE, text=True
        )
    process.communicate(timeout=120)
    assert process.returncode == 0
    assert contents("cut") == contents("whole")


# Extended and resumed ----------------------------------------------------------------------------


def test_larger_number_extends_the_campaign():
    kwargs = {"log": "log"}
    generate("run", 10, env_kwargs=kwargs)
    generate("run", 25, env_kwargs=kwargs, resume=True)
    assert begun() == Counter(range(25))
    generate("whole", 25)
    assert contents("run") == contents("whole")
    generate("run", 40, env_kwargs=kwargs, clients=2, resume=True)
    assert begun() == Counter(range(40))
    generate("run", 12, env_kwargs=kwargs, resume=True)  # which it has
    assert begun() == Counter(range(40))
    check_rows("run", 40)


def test_command_extends_the_campaign():
    generate("run", 5)
    assert main(["generate", "sessions/run", "--resume", "--episodes", "9"]) == 0
    check_rows("run", 9)
    assert main(["generate", "sessions/run", "--resume"]) == 0
    assert numbers("run") == (list(range(9)), [])


def test_seed_that_was_drawn_is_kept():
    config = dataclasses.replace(LOCAL, seed=None)
    generate("run", 6, config)
    first = contents("run")[0]["x"]
    generate("run", 12, config, resume=True)
    assert contents("run")[0]["x"].startswith(first)
    assert numbers("run")[0] == list(range(12))


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"env_kwargs": {"most": 5}}, "env_kwargs"),
        ({"seed": 4}, "seed"),
        ({"episode_steps": 2}, "episode_steps"),
        ({"simulations_per_step": 2}, "simulations_per_step"),
        ({"sampler": "physx/uniform", "env_kwargs": {"parameters": True}}, "env_kwargs"),
    ],
)
def test_changed_option_is_named(change, name):
    generate("run", 5)
    before = contents("run")
    with pytest.raises(ConfigError, match=rf"cannot be continued: {name} was .* and is now"):
        generate("run", 8, dataclasses.replace(LOCAL, **change), resume=True)
    assert contents("run") == before


def test_another_campaign_has_other_rows():
    generate("run", 5)
    with Dataset.open("sessions/run") as dataset:
        before = dataset.num_samples("training")
    generate("run", 5, new_session=False)
    with Dataset.open("sessions/run") as dataset:
        known = dataset.recorded_episodes("training")
        found = dataset["training"]["x"][:].tolist()
    assert sorted(set(known.campaign.tolist())) == [0, 1]
    rows = [rows_of(number, [SEED, 0, offset]) for offset in (0, before) for number in range(5)]
    assert found == list(itertools.chain(*rows))


# Failures ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("clients", [0, 2])
def test_run_ends_with_more_failures_than_allowed(clients):
    troubles = {"3": ["raises", 0], "6": ["raises", 0], "8": ["raises early", 0]}
    kwargs = {"troubles": troubles, "least": 1, "log": "log"}
    with pytest.raises(FailedEpisodesError, match="beans") as caught:
        generate("run", 20, env_kwargs=kwargs, clients=clients, max_failed=1)
    assert caught.value.failed >= 2
    recorded, failed = numbers("run")
    assert {3, 6, 8} >= set(failed) != set()
    before = begun()
    generate("run", 20, env_kwargs=kwargs, clients=clients, max_failed=2, resume=True)
    assert set(begun() - before) == set(range(20)) - set(recorded)
    assert numbers("run") == (list(range(20)), [3, 6, 8])
    check_rows("run", 20, troubles, least=1)


def test_as_many_failures_as_allowed_are_no_error():
    troubles = {"0": ["raises", 0], "4": ["is not finite", 0]}
    generate("run", 9, env_kwargs={"troubles": troubles, "least": 1}, max_failed=2)
    assert numbers("run") == (list(range(9)), [0, 4])
    check_rows("run", 9, troubles, least=1)


@pytest.mark.slow
def test_number_that_ends_its_client_twice_has_failed():
    troubles = {"4": ["ends the process", 0]}
    kwargs = {"troubles": troubles, "least": 1, "sleep": 0.03, "log": "log"}
    generate("run", 8, env_kwargs=kwargs, clients=1, max_failed=1)
    assert numbers("run") == (list(range(8)), [4])
    assert begun() == Counter([*range(8), 4])
    with Dataset.open("sessions/run") as dataset:
        (failure,) = dataset.failed_episodes("training")
    assert "exit status 3" in failure.reason


def test_campaign_in_which_all_episodes_fail():
    troubles = {str(number): ["raises", 0] for number in range(4)}
    kwargs = {"troubles": troubles, "least": 1}
    generate("run", 4, env_kwargs=kwargs, max_failed=4)
    generate("run", 4, env_kwargs=kwargs, max_failed=0, resume=True)  # nothing is missing
    with Dataset.open("sessions/run") as dataset:
        assert len(dataset.failed_episodes("training")) == 4


def test_resumed_after_all_failed_has_rows():
    troubles = {str(number): ["raises", 0] for number in range(4)}
    kwargs = {"troubles": troubles, "least": 1}
    generate("run", 4, env_kwargs=kwargs, max_failed=4)
    generate("run", 8, env_kwargs=kwargs, resume=True)
    assert numbers("run") == (list(range(8)), [0, 1, 2, 3])
    check_rows("run", 8, troubles, least=1)


# Mistakes in the options -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"batch_nb": 2},
        {"batch_size": 2},
        {"episodes": 3, "batch_nb": 2},
        {"episodes": 3, "batch_size": 2},
        {"episodes": 3, "batch_nb": 2, "batch_size": 2},
    ],
)
def test_either_batches_or_episodes(options):
    with pytest.raises(ConfigError, match="either batch_nb and batch_size, or episodes"):
        DataGeneration(LOCAL, **options)


def test_option_of_episodes_is_not_for_streams():
    config = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    with pytest.raises(ConfigError, match=r"max_failed is for independent episodes.*spring"):
        DataGeneration(config, batch_nb=1, batch_size=1, max_failed=1).execute()


@pytest.mark.parametrize("option", [{"episodes": 0}, {"episodes": 2, "max_failed": -1}])
def test_numbers_out_of_range(option):
    with pytest.raises(ConfigError, match="at least"):
        DataGeneration(LOCAL, **option)


@pytest.mark.parametrize("clients", [0, 1])
def test_stream_has_no_episodes(clients):
    config = EnvironmentConfig("toy/spring", seed=1)
    with pytest.raises(UsageError, match="is a stream, which has no episodes to count"):
        generate("run", 3, config, clients=clients)


def test_resumed_session_must_exist_and_have_episodes():
    with pytest.raises(SessionError):
        generate("nothing", 3, resume=True)
    config = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
    DataGeneration(config, session_name="stream", batch_nb=1, batch_size=3).execute()
    with pytest.raises(ConfigError, match=r"has no episodes of the mode .* leave\s+resume out"):
        generate("stream", 3, resume=True)


def test_modes_have_campaigns_of_their_own():
    generate("run", 5)
    generate("run", 4, new_session=False, mode="validation")
    generate("run", 6, mode="validation", resume=True)
    assert numbers("run")[0] == list(range(5))
    assert numbers("run", "validation")[0] == list(range(6))


def test_environment_that_cannot_be_created_ends_the_run():
    config = EnvironmentConfig(TROUBLED, env_kwargs={"unknown": 1}, seed=1, num_clients=2)
    with pytest.raises(PhysxError, match="unknown") as caught:
        DataGeneration(config, episodes=3).execute()
    assert not isinstance(caught.value, ClientError)
