"""Clients join and leave a campaign of independent episodes: its rows do not depend on them."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sysconfig
import threading
import time
from pathlib import Path

import pytest
from campaigns import TROUBLED, Results, leased, rows_of

from physx_core import Dataset, EnvironmentConfig
from physx_core.errors import ConfigError, TooFewClientsError, UsageError
from physx_core.sources import ClientSource
from physx_core.workers.episode_queue import EpisodeQueue

pytestmark = pytest.mark.processes

SEED = [5, 2]
PAGE = Path(__file__).parents[3] / "docs" / "campaign.md"


@pytest.fixture
def config(token, port):
    """Return the configuration of a run that waits for clients."""
    return EnvironmentConfig(
        TROUBLED, launcher="physx/manual", port=port, timeout=20.0, min_clients=1, max_clients=3,
        env_kwargs={"sleep": 0.02, "least": 1},
    )  # fmt: skip


def wait_for(happened):
    """Wait until something has happened."""
    deadline = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.02)


class Beside(threading.Thread):
    """Does something while the test's own thread serves the clients."""

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.join()


def check(results, total, **options):
    expected = {number: rows_of(number, SEED, least=1, **options) for number in range(total)}
    assert results.rows == {number: rows for number, rows in expected.items() if rows is not None}


def test_late_client_simulates_episodes_of_a_run_that_has_begun(config, join, said, caplog):
    caplog.set_level("INFO", "physx")
    queue, ours = EpisodeQueue(60), [join()]

    def join_later():
        wait_for(lambda: queue.finished > 3)
        ours.append(join())

    with Beside(target=join_later), leased(config, SEED, queue) as source:
        results = Results().take_all(source, queue)
    check(results, 60)
    texts = [process.communicate(timeout=60)[0] for process in ours]
    assert [process.returncode for process in ours] == [0, 0]
    assert all("the run has ended" in text for text in texts)
    assert said()[0].startswith("The run waits for 1 client (at most 3 may join). Start each")


@pytest.mark.parametrize(
    ("how", "words"),
    [(signal.SIGINT, "left the run"), (signal.SIGTERM, "left the run"), (signal.SIGKILL, "closed")],
)
def test_leaving_client_does_not_end_the_run(config, join, said, caplog, how, words):
    caplog.set_level("INFO", "physx")
    queue, ours = EpisodeQueue(60, retries=0 if "left" in words else 1), [join(), join()]

    def leave():
        wait_for(lambda: queue.finished > 6)
        ours[0].send_signal(how)

    with Beside(target=leave), leased(config, SEED, queue) as source:
        results = Results().take_all(source, queue)
    check(results, 60)
    assert len(said(words)) == 1


def test_client_that_leaves_is_replaced_by_one_that_joins(config, join):
    queue, ours = EpisodeQueue(40), [join()]

    def change():
        wait_for(lambda: queue.finished > 4)
        ours[0].send_signal(signal.SIGINT)
        ours[0].wait()
        ours.append(join())

    with Beside(target=change), leased(config, SEED, queue) as source:
        results = Results().take_all(source, queue)
    check(results, 40)


@pytest.mark.slow
def test_run_with_too_few_clients_ends_after_timeout(config, join, unhurried):
    join()
    config = dataclasses.replace(config, min_clients=2, timeout=unhurried(1.0))
    with (
        pytest.raises(
            TooFewClientsError,
            match=r"has 1 client, but needs 2 \(min_clients\), and no other joined for \d+ s",
        ) as caught,
        leased(config, SEED, EpisodeQueue(9)),
    ):
        pass
    assert (caught.value.clients, caught.value.needed) == (1, 2)


def test_run_without_its_last_client_ends_after_timeout(config, join, unhurried):
    queue, ours = EpisodeQueue(1000), [join()]
    config = dataclasses.replace(config, timeout=unhurried(1.0))

    def leave():
        wait_for(lambda: queue.finished > 4)
        ours[0].kill()

    with (
        Beside(target=leave),
        pytest.raises(TooFewClientsError, match=r"has 0 clients.*Client \d closed the connection"),
        leased(config, SEED, queue) as source,
    ):
        Results().take_all(source, queue)


@pytest.mark.slow
def test_client_for_which_there_is_no_place_is_refused(config, join):
    queue, ours = EpisodeQueue(80), [join("--instance", "1")]
    config = dataclasses.replace(config, max_clients=1)

    def join_later():
        wait_for(lambda: queue.finished > 2)
        ours.extend([join(), join("--instance", "2")])
        for process in ours[1:]:
            process.wait()

    with Beside(target=join_later), leased(config, SEED, queue) as source:
        check(Results().take_all(source, queue), 80)
    for process in ours[1:]:
        assert "The server has no place for" in process.stderr.read()
        assert process.returncode == 1


@pytest.mark.slow
def test_guest_that_fails_to_start_does_not_end_the_run(config, join, said, tmp_path):
    script = tmp_path / "guests.py"
    script.write_text(
        "import os, sys\n"
        f"sys.path.insert(0, {str(Path(TROUBLED.split(':')[0]).parent)!r})\n"
        "import campaign_envs\n"
        "class Guest(campaign_envs.Troubled):\n"
        "    def create(self):\n"
        "        if 'FAILS' in os.environ:\n"
        "            raise RuntimeError('no solver here')\n"
    )
    config = dataclasses.replace(config, environment=f"{script}:Guest")
    queue, ours = EpisodeQueue(60), [join()]

    def join_later():
        wait_for(lambda: queue.finished > 2)
        ours.append(join(env={**os.environ, "FAILS": "1"}))
        ours[1].wait()

    with Beside(target=join_later), leased(config, SEED, queue) as source:
        check(Results().take_all(source, queue), 60)
    (text,) = said("no solver here")
    assert "It had no episode." in text
    assert ours[1].returncode == 1


def test_client_that_runs_too_long_an_episode_is_ended(said, nothing_stays_behind):
    kwargs = {"troubles": {"3": ["hangs", 0]}, "least": 1}
    config = EnvironmentConfig(TROUBLED, num_clients=2, env_kwargs=kwargs, episode_timeout=1.5)
    queue = EpisodeQueue(12, retries=0)
    with leased(config, SEED, queue) as source:
        results = Results().take_all(source, queue)
    assert list(results.failed) == [3]
    assert "has simulated episode 3 for" in results.failed[3]
    assert sorted(results.rows) == [number for number in range(12) if number != 3]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sleeps long", "is busy long"])
def test_long_step_of_an_episode_is_no_silence(kind, unhurried, nothing_stays_behind):
    timeout = unhurried(1.0)
    kwargs = {"troubles": {"1": [kind, 0]}, "least": 1, "long": timeout + 1.5}
    config = EnvironmentConfig(TROUBLED, env_kwargs=kwargs, timeout=timeout)
    queue = EpisodeQueue(3, retries=0)
    with leased(config, SEED, queue) as source:
        check(Results().take_all(source, queue), 3)


# Configurations ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"min_clients": 3, "max_clients": 2}, "min_clients is 3, but there may be at most 2"),
        ({"num_clients": 3, "max_clients": 2}, "num_clients is 3, but there may be at most 2"),
    ],
)
def test_contradicting_numbers_of_clients_are_refused(options, said):
    with pytest.raises(ConfigError, match=said):
        ClientSource(EnvironmentConfig(TROUBLED, **options), None, SEED)


def test_streams_have_a_fixed_number_of_clients(nothing_stays_behind):
    config = EnvironmentConfig("toy/spring", max_clients=2)
    with (
        pytest.raises(UsageError, match=r"is a stream.*without min_clients and max_clients"),
        ClientSource(config, None, SEED),
    ):
        pass


@pytest.mark.faults
def test_the_commands_of_the_page(port, tmp_path, nothing_stays_behind):
    text = PAGE.read_text()
    (tmp_path / "beam.py").write_text(
        re.search(r"file: beam.py.*?```python\n(.*?)```", text, re.S)[1]
    )
    commands = re.search(r"```sh\n(export PHYSX_TOKEN.*?)```", text, re.S)[1]
    path = f"{sysconfig.get_path('scripts')}:{os.environ['PATH']}"
    alone = "physx generate beam.py:Beam --episodes 40 --environment.seed 1"
    done = subprocess.run(
        ["bash", "-euc", f"{commands.replace('5000', str(port))}\n{alone}"],
        env=os.environ | {"PATH": path}, cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "(at most 8 may join)" in done.stderr
    found = []
    for session in sorted((tmp_path / "sessions").iterdir()):
        with Dataset.open(session) as dataset:
            names = sorted(dataset.fields("training"))
            found.append({name: dataset["training"][name][:].tobytes() for name in names})
    assert len(found) == 2
    assert found[0] == found[1]
