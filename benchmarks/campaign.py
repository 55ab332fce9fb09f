"""Campaigns of independent episodes against a pool without overhead, and against a bare loop.

1. 64 simulations of uneven length (log-normal, median 0.25 s, sigma 1.2) on 4 clients: the time
   from the first to the last, start-up apart, against list scheduling of the same durations, in
   which each of 4 workers takes the next number at once. Claim: at most 1.1 times as long with rows
   of 32 B, and 1.15 times with rows of 5 MB.
2. Episodes of one row, 5 floats each, on 2 clients, start included, against a loop that sets the
   same random stream in place for each row and writes blocks with `os.write`.
"""

from __future__ import annotations

import heapq
import itertools
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measure import claim, finish, rates, report

from physx_core import DataGeneration, Environment, EnvironmentConfig
from physx_core.random_streams import NumberedStreams

EPISODES, CLIENTS, ROUNDS = 64, 4, 3
SINGLE, BLOCK = 400_000, 1_000
NAMES = itertools.count()


class Uneven(Environment):
    """A simulation that takes its time and has one row."""

    episode_steps = 1

    def __init__(self, *, size: int = 4, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.size = size

    def create(self) -> None:
        """Do nothing."""

    def init_database(self) -> None:
        """Define one field."""
        self.define_training_fields(("x", np.ndarray))

    def step(self) -> None:
        """Wait for the length of the simulation, in s."""
        duration = self.rng.lognormal(np.log(0.25), 1.2)
        time.sleep(duration)
        self.set_training_data(x=np.full(self.size, duration))


class Single(Environment):
    """Episodes of one row of random numbers."""

    episode_steps = 1

    def create(self) -> None:
        """Do nothing."""

    def init_database(self) -> None:
        """Define one field."""
        self.define_training_fields(("x", np.ndarray))

    def step(self) -> None:
        """Draw five numbers."""
        self.set_training_data(x=self.rng.normal(size=5))


def generation(
    folder: Path, environment: type, episodes: int, clients: int, seed: int, **kwargs: Any
) -> DataGeneration:
    """Return a data generation."""
    config = EnvironmentConfig(
        environment, env_kwargs=kwargs, num_clients=clients, seed=seed, timeout=600.0
    )
    name = f"run_{next(NAMES)}"
    return DataGeneration(
        config, session_dir=str(folder), session_name=name, episodes=episodes, quiet=True
    )


def list_schedule(durations: np.ndarray, workers: int) -> float:
    """Return when the last simulation ends if each worker takes the next one at once."""
    free = [0.0] * workers
    for duration in durations:
        heapq.heappush(free, heapq.heappop(free) + float(duration))
    return max(free)


def uneven(folder: Path, size: int, target: float) -> bool:
    """Compare a campaign with list scheduling of its durations."""
    ratios = []
    for seed in range(ROUNDS):
        with generation(folder, Uneven, EPISODES, CLIENTS, seed, size=size) as campaign:
            began = time.perf_counter()
            campaign.execute()
            seconds = time.perf_counter() - began
            durations = campaign.dataset["training"]["x"][:][:, 0]
        ratios.append(seconds / list_schedule(durations, CLIENTS))
    print(f"{EPISODES} uneven simulations on {CLIENTS} clients, rows of {8 * size:,} B")
    shown = ", ".join(f"{each:.2f}" for each in ratios)
    return claim(
        f"time against the ideal pool ({shown})", statistics.median(ratios), at_most=target
    )


def bare_loop(folder: Path) -> int:
    """Draw the same numbers without physx's sources and dataset."""
    streams, block = NumberedStreams(0), np.empty((BLOCK, 5))
    draw = streams.generator.normal
    handle = os.open(folder / f"bare_{next(NAMES)}", os.O_CREAT | os.O_WRONLY)
    for first in range(0, SINGLE, BLOCK):
        for row in range(BLOCK):
            streams.seek(first + row)
            block[row] = draw(size=5)
        os.write(handle, block.tobytes())
    os.close(handle)
    return SINGLE


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        small = uneven(folder, 4, 1.1)
        large = uneven(folder, 655_360, 1.15)

        def campaign() -> int:
            generation(folder, Single, SINGLE, 2, 0).execute()
            return SINGLE

        measured = rates(
            {"bare loop": lambda: bare_loop(folder), "2 clients, start included": campaign}, ROUNDS
        )
        single = report(
            "Episodes of one row, 5 floats", "episodes", measured, "bare loop", 0.85,
            "2 clients, start included",
        )  # fmt: skip
    finish([small, large, single])


if __name__ == "__main__":
    main()
