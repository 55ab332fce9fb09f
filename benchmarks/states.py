"""Streams that continue: what a kill costs, and what states cost.

    python benchmarks/states.py --check
    python benchmarks/states.py --only journal states        # these do not need a quiet machine

killed: a stream of 10 s whose process is killed every 3 s ends within 1.5 times as long. Without
states it never ends.
episode: the same for an independent episode.
age: after a kill, a stream that is ten times older goes on after at most 1.2 times as long.
resumed: the same after ``kill -9`` of the whole run and ``--resume``.
journal: for 3 000 rows that each ask for 5 predictions of 32 kB, 480 MB in all, the journal holds
those since the last state.
states: taking a state, sending and keeping it costs at most 1 % if there is one each 0.1 s.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from measure import claim, finish

from physx_core import DataGeneration, Environment, EnvironmentConfig, Field
from physx_core.net import decode, encode
from physx_core.sources import ClientSource
from physx_core.workers import Instance
from physx_core.workers.journal import Journal
from physx_core.workers.pasts import Past

ROUNDS = 5
WORK, INTERVAL, STEP = 10.0, 3.0, 5e-3
EVERY = 20
ROWS, ASKED, PREDICTION, BETWEEN = 3000, 5, 4096, 100


class Walk(Environment):
    """A random walk with steps that take time; it notes its process."""

    def __init__(self, *, pause: float = 0.0, asks: int = 0, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.pause, self.asks = pause, asks
        self.position = np.zeros(100)

    def create(self) -> None:
        """Note the process, for who wants to kill it."""
        Path("process").write_text(str(os.getpid()))

    def init_database(self) -> None:
        """Define the position."""
        self.define_training_fields(Field("position", (100,)))

    def step(self) -> None:
        """Make a step."""
        time.sleep(self.pause)
        for _ in range(self.asks):
            self.get_prediction(x=self.position[:1])
        self.position += self.rng.normal(size=100)
        self.set_training_data(position=self.position)


class Trip(Walk):
    """An independent episode."""

    episode_steps = round(WORK / STEP)

    def reset_parameters(self) -> None:
        """Return to the origin."""
        self.position = np.zeros(100)


class Services:
    """Predictions of 32 kB."""

    def predict(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return a large prediction."""
        return {"y": np.full(PREDICTION, fields["x"][0])}


def stream(every: int, **kwargs: Any) -> ClientSource:
    """Return the source of one stream."""
    config = EnvironmentConfig(
        f"{Path(__file__).resolve()}:Walk",
        env_kwargs=kwargs,
        retries=1000,
        state_every=every,
    )
    return ClientSource(config, Services(), [7], run_ahead=0)  # type: ignore[arg-type]


def kill() -> None:
    """Kill the client."""
    with contextlib.suppress(OSError, ValueError):
        os.kill(int(Path("process").read_text()), signal.SIGKILL)


@contextlib.contextmanager
def killing(interval: float) -> Iterator[None]:
    """Kill the client at a fixed interval."""
    is_over = threading.Event()

    def work() -> None:
        while not is_over.wait(interval):
            kill()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def seconds_of_rows(rows: int) -> float:
    """Return the time from the start of a stream until it has made some rows."""
    began = time.monotonic()
    with stream(EVERY, pause=STEP) as source:
        for _ in range(rows):
            source.batch(1)
        return time.monotonic() - began


def check_killed() -> bool:
    """Kill a stream again and again until it has ended."""
    rows = round(WORK / STEP)
    alone = seconds_of_rows(rows)
    with killing(INTERVAL):
        killed = seconds_of_rows(rows)
    print(f"A stream alone {alone:.1f} s, killed every {INTERVAL:g} s {killed:.1f} s")
    return claim("killed, times as long", killed / alone, at_most=1.5)


def seconds_of_episode(name: str) -> float:
    """Return the time that a run with one episode takes."""
    file, paused = Path(__file__).resolve(), {"pause": STEP}
    config = EnvironmentConfig(f"{file}:Trip", env_kwargs=paused, retries=1000, state_every=EVERY)
    began = time.monotonic()
    DataGeneration(config, session_name=name, episodes=1, quiet=True).execute()
    return time.monotonic() - began


def check_episode() -> bool:
    """Kill the client of an episode again and again until it has ended."""
    alone = seconds_of_episode("alone")
    with killing(INTERVAL):
        killed = seconds_of_episode("killed")
    print(f"An episode alone {alone:.1f} s, killed every {INTERVAL:g} s {killed:.1f} s")
    return claim("episode killed, times as long", killed / alone, at_most=1.5)


def seconds_to_continue(age: int) -> float:
    """Return the time from a kill to the next row of a stream that has made some rows."""
    with stream(EVERY, pause=1e-3) as source:
        source.batch(age)
        kill()
        began = time.monotonic()
        source.batch(1)
        return time.monotonic() - began


def check_age() -> bool:
    """Compare young streams with old ones."""
    ages = (300, 3000)
    found: dict[int, list[float]] = {age: [] for age in ages}
    for _ in range(ROUNDS):
        for age in ages:
            found[age].append(seconds_to_continue(age))
    young, old = (statistics.median(found[age]) for age in ages)
    print(f"Going on after {ages[0]} rows {young:.3f} s, after {ages[1]} rows {old:.3f} s")
    return claim("ten times older, times as long", old / young, at_most=1.2)


def generation(name: str, rows: int, **options: Any) -> DataGeneration:
    """Return a generation of one stream in batches of 100 rows."""
    config = EnvironmentConfig(
        f"{Path(__file__).resolve()}:Walk", env_kwargs={"pause": 1e-3}, state_every=EVERY, seed=7
    )
    return DataGeneration(
        config, session_name=name, batch_nb=rows // 100, batch_size=100, quiet=True, **options
    )


def run_and_die(name: str, rows: int) -> None:
    """Generate rows, and kill this process, in which that is all that happens."""

    class Mortal(DataGeneration):
        def data_generation_end(self) -> None:
            os.kill(os.getpid(), signal.SIGKILL)

    made = generation(name, rows)
    made.__class__ = Mortal
    made.execute()


def seconds_to_resume(name: str, age: int) -> float:
    """Return the time that a resumed run takes for 100 rows after as many as its age."""
    command = [sys.executable, __file__, "--die", name, str(age)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    began = time.monotonic()
    generation(name, age + 100, resume=True).execute()
    return time.monotonic() - began


def check_resumed() -> bool:
    """Compare young runs with old ones."""
    ages = (500, 5000)
    found: dict[int, list[float]] = {age: [] for age in ages}
    for number in range(2 * ROUNDS - 1):  # starting processes varies most
        for age in ages:
            found[age].append(seconds_to_resume(f"run{age}_{number}", age))
    young, old = (statistics.median(found[age]) for age in ages)
    print(f"Resumed after {ages[0]} rows {young:.3f} s, after {ages[1]} rows {old:.3f} s")
    return claim("run ten times older, times as long", old / young, at_most=1.2)


def check_journal() -> bool:
    """Follow the size of a journal."""
    largest = 0
    with stream(BETWEEN, asks=ASKED) as source:
        for _ in range(ROWS // 10):
            source.batch(10)
            journal = source._group.peer(1).journal
            largest = max(largest, 0 if journal is None else journal.size)
    between = BETWEEN * ASKED * PREDICTION * 8
    print(f"Predictions {ROWS * ASKED * PREDICTION * 8e-6:.0f} MB, journal {largest * 1e-6:.1f} MB")
    return claim("journal, predictions between two states", largest / between, at_most=1.2)


def check_states() -> bool:
    """Time what client and server do for a state."""
    instance = Instance(Walk, {}, instance_id=1, instance_nb=1, seed=[7])
    instance.open(None, draw=False, with_states=True)
    journal, times = Journal(1, 1e9, None, None), []
    for rows in range(1, 201):
        instance.step()
        began = time.process_time()
        kept = encode({"instance": instance.get_state()}, "the state")
        plain = decode(encode({"state": kept}))
        journal.keep_state(Past(rows, plain["state"]))
        times.append(time.process_time() - began)
    seconds = statistics.median(times)
    print(f"A state of {len(kept)} bytes takes {1e6 * seconds:.0f} us")
    return claim("states each 0.1 s, part of the time", seconds / 0.1, at_most=0.01)


CHECKS: dict[str, Callable[[], bool]] = {
    "killed": check_killed,
    "episode": check_episode,
    "age": check_age,
    "resumed": check_resumed,
    "journal": check_journal,
    "states": check_states,
}


def main() -> None:
    """Print the claims."""
    logging.getLogger("physx").setLevel(logging.ERROR)  # each kill is a warning
    parser = argparse.ArgumentParser()
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--only", nargs="+", choices=CHECKS, default=[*CHECKS])
    parser.add_argument("--die", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.die:
        run_and_die(given.die[0], int(given.die[1]))
    names = given.only
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        met = [CHECKS[name]() for name in names]
    finish(met)


if __name__ == "__main__":
    main()
