"""Campaigns of independent episodes against a pool without overhead, and against a bare loop.

1. 64 simulations of uneven length (log-normal, median 0.15 s, sigma 1.2) on 4 clients: the time
   from the first to the last, start-up apart, against list scheduling of the same durations, in
   which each of 4 workers takes the next number at once. Claim: at most 1.1 times as long with rows
   of 32 B, and 1.15 times with rows of 5 MB.
2. Episodes of one row, 5 floats each, on 2 clients, start and end included, against a loop that
   sets the same random stream in place for each row and writes blocks with `os.write`. There are
   3 million, so that the start, about a second, is a tenth of it. Claim: at least 0.85 times as
   fast.
3. The same with one parameter and 1 million, against a loop that draws the parameters of all rows
   in one call. Claim: at least 0.5 times as fast.
"""

from __future__ import annotations

import itertools
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measure import claim, finish, list_schedule, rates, report

from physx_core import DataGeneration, Environment, EnvironmentConfig, Parameter
from physx_core.plugins import resolve
from physx_core.random_streams import NumberedStreams

EPISODES, CLIENTS, ROUNDS = 64, 4, 3
PLAIN, VARIED, BLOCK = 3_000_000, 1_000_000, 1_000
NAMES = itertools.count()
MIDDLE = Parameter("middle", 1.0, 2.0)


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
        duration = self.rng.lognormal(np.log(0.15), 1.2)
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


class Varied(Single):
    """Episodes of one row of random numbers around a parameter."""

    def create(self) -> None:
        """Define the parameter."""
        self.define_parameters(MIDDLE)

    def reset_parameters(self, middle: float) -> None:
        """Take the parameter."""
        self.middle = middle

    def step(self) -> None:
        """Draw five numbers."""
        self.set_training_data(x=self.middle + self.rng.normal(size=5))


def generation(
    folder: Path,
    environment: type,
    episodes: int,
    clients: int,
    seed: int,
    sampler: str | None = None,
    **kwargs: Any,
) -> DataGeneration:
    """Return a data generation."""
    config = EnvironmentConfig(
        environment,
        env_kwargs=kwargs,
        num_clients=clients,
        seed=seed,
        timeout=600.0,
        sampler=sampler,
    )
    name = f"run_{next(NAMES)}"
    return DataGeneration(
        config, session_dir=str(folder), session_name=name, episodes=episodes, quiet=True
    )


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


def bare_loop(folder: Path, episodes: int, sampler: str | None = None) -> int:
    """Draw the same numbers without physx's sources and dataset."""
    streams, block = NumberedStreams(0), np.empty((BLOCK, 5))
    draw = streams.generator.normal
    values = None if sampler is None else all_values(sampler, episodes)
    handle = os.open(folder / f"bare_{next(NAMES)}", os.O_CREAT | os.O_WRONLY)
    for first in range(0, episodes, BLOCK):
        for row in range(BLOCK):
            streams.seek(first + row)
            block[row] = draw(size=5) if values is None else values[first + row] + draw(size=5)
        os.write(handle, block.tobytes())
    os.close(handle)
    return episodes


def all_values(reference: str, episodes: int) -> list[float]:
    """Return the parameter of each row."""
    sampler = resolve("sampler", reference)()
    sampler.begin([MIDDLE], [0])
    values: list[float] = sampler.ask_many(0, episodes)["middle"].tolist()
    return values


def single_rows(folder: Path, title: str, sampler: str | None, target: float) -> bool:
    """Compare a campaign of episodes of one row with a loop."""
    environment, episodes = (Single, PLAIN) if sampler is None else (Varied, VARIED)

    def campaign() -> int:
        generation(folder, environment, episodes, 2, 0, sampler).execute()
        return episodes

    def bare() -> int:
        return bare_loop(folder, episodes, sampler)

    clients = "2 clients, start included"
    measured = rates({"bare loop": bare, clients: campaign}, ROUNDS)
    return report(title, "episodes", measured, "bare loop", target, clients)


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        small = uneven(folder, 4, 1.1)
        large = uneven(folder, 655_360, 1.15)
        title = "Episodes of one row, 5 floats"
        plain = single_rows(folder, title, None, 0.85)
        varied = [
            single_rows(folder, f"{title}, and one parameter, {sampler}", sampler, 0.5)
            for sampler in ("physx/uniform", "physx/sobol")
        ]
    finish([small, large, plain, *varied])


if __name__ == "__main__":
    main()
