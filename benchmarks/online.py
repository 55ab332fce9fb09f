"""Online training: simulating and learning at the same time.

    python benchmarks/online.py --check
    python benchmarks/online.py --only overlap waits        # timings: these need a quiet machine

overlap: one client simulates, at about the same cost per batch as the learner. The training makes
at least 0.92 times as many batches per second as the slower of the two makes alone.
uneven: four clients make simulations of very different durations (log-normal, sigma 1.2), which a
sampler that learns chooses, `run_ahead` 64. The training takes at most 1 / 0.9 times as long as
list scheduling of their durations.
waits: neither waits for the other for more than 2 % of the time beyond what the counts require.
memory: it does not grow while ten times as many rows arrive as a reservoir holds.
repeated: with clients of any speed and one busy core, trainings end with bit-identical networks,
including those whose sampler learns.
learned: from the same number of simulations, a reservoir learns more than a stream, and as much as
a training on stored samples, shuffled.
chosen: simulations where the loss is high make the largest errors smaller than random ones do.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from measure import claim, finish, list_schedule

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    View,
)
from physx_core.observers import read_scalars
from physx_core.pipelines.pipeline import Pipeline

BATCH, BATCHES, ROUNDS = 16, 60, 3
NETWORK = NetworkConfig(
    "torch/fc",
    network_kwargs={"layers": [8, 2000, 2000, 1], "opt_fields": "output"},
    loss="MSELoss",
    optimizer="Adam",
    lr=1e-4,
)


def learner_alone(folder: str) -> float:
    """Return batches per second of a training on stored samples."""
    data = DatasetConfig(existing_dir=folder, view=View(hold_back=False))
    training = Training(NETWORK, data, epoch_nb=1, batch_nb=BATCHES, **common(folder))
    return batches_per_second(training)


def client_alone(folder: str, cost: float, batches: int = BATCHES) -> float:
    """Return batches per second of one client."""
    config = environment(cost)
    options = {key: value for key, value in common(folder).items() if key not in ("seed", "rivals")}
    return batches_per_second(DataGeneration(config, batch_nb=batches, **options))


def both(folder: str, cost: float) -> float:
    """Return batches per second of a training while a client generates."""
    training = Training(
        NETWORK, None, environment(cost), epoch_nb=1, batch_nb=BATCHES, **common(folder)
    )
    return batches_per_second(training)


def environment(cost: float) -> EnvironmentConfig:
    """Return the configuration of one client."""
    return EnvironmentConfig(
        "online_problems:Costly",
        as_tcp_ip_client=True,
        num_clients=1,
        env_kwargs={"cost": cost},
        seed=0,
    )


def common(folder: str) -> dict[str, Any]:
    """Return options of all pipelines."""
    return {"batch_size": BATCH, "session_dir": folder, "quiet": True, "seed": 0, "rivals": "none"}


def batches_per_second(pipeline: Pipeline) -> float:
    """Return the batches per second of a pipeline, timed once everything is open."""
    with pipeline:
        begin = time.perf_counter()
        pipeline.execute()
        return BATCHES / (time.perf_counter() - begin)


def overlap() -> list[bool]:
    """Compare a training with the slower of its two sides."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        stored = f"{name}/stored"
        generation = DataGeneration(
            environment(0.0), batch_nb=16, batch_size=64, session_dir=name, session_name="stored",
            quiet=True,
        )  # fmt: skip
        generation.execute()
        for _ in range(ROUNDS):
            learner = learner_alone(stored)
            cost = 1.0 / (learner * BATCH)
            client = client_alone(name, cost)
            trained = both(name, cost)
            found.append((trained / min(learner, client), learner, client, trained))
    ratio, learner, client, trained = map(statistics.median, zip(*found, strict=True))
    print("Batches/s with a client and a learner of the same cost, on", torch.get_num_threads())
    print(f"  learner alone {learner:.1f}, client alone {client:.1f}, both {trained:.1f}")
    return [claim("both against the slower alone", float(ratio), at_least=0.92)]


def waits() -> list[bool]:
    """Measure how long each side waits although the other one has done its part."""
    met = []
    with tempfile.TemporaryDirectory() as folder:
        learner = batches_per_second(
            Training(
                NETWORK, None, environment(0.0), epoch_nb=1, batch_nb=BATCHES, **common(folder)
            )
        )
        for name, share, side in (
            ("network, samples are there", 0.25, "network_waits"),
            ("environments, rows are wanted", 4.0, "environments_wait"),
        ):
            config = environment(share / (learner * BATCH))
            training = Training(
                NETWORK, None, config, epoch_nb=1, batch_nb=BATCHES, **common(folder)
            )
            training.execute()
            numbers = read_scalars(training.session.path)["batch", f"online/{side}"]
            share_of_time = statistics.median(numbers.values())
            met.append(claim(f"share of time that the {name}, waits", share_of_time, at_most=0.02))
    return met


class Watched(Training):
    """A training that records the memory of this process after each batch.

    It lets the clients run ahead as far as they may, so the same number of rows waits for it each
    time. The C library returns what is freed, so this is the memory in use.
    """

    resident: list[float]

    def batch_end(self) -> None:
        """Wait until the clients are ahead, and record the memory, in MiB."""
        dataset, deadline = self.data.dataset, time.monotonic() + 10
        rows = min(self.batch_id + RUN_AHEAD, self.batch_nb or 0) * BATCH
        while dataset.num_samples("training") < rows and time.monotonic() < deadline:
            time.sleep(0.001)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.resident.append(pages * resource.getpagesize() / 2**20)


CAPACITY, TIMES, RUN_AHEAD = 500, 10, 60
MMAP_THRESHOLD, SMALL = -3, 2**16  # memory from this size on is mapped, and unmapped when freed


def memory() -> list[bool]:
    """Measure the growth of memory from a full reservoir until ten times as many rows."""
    ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, SMALL)
    size = 2**13
    config = EnvironmentConfig(
        "online_problems:Large", as_tcp_ip_client=True, env_kwargs={"size": size}, seed=0
    )
    kwargs = {"layers": [size, 1], "opt_fields": "output"}
    linear = NetworkConfig(
        "torch/fc", network_kwargs=kwargs, loss="MSELoss", optimizer="SGD", lr=0.0
    )
    with tempfile.TemporaryDirectory() as folder:
        training = Watched(
            linear, None, config, epoch_nb=1, batch_nb=TIMES * CAPACITY // BATCH,
            online="physx/reservoir", online_kwargs={"capacity": CAPACITY}, **common(folder),
        )  # fmt: skip
        training.resident = []
        training.execute()
    found = training.resident[len(training.resident) // 4 : -RUN_AHEAD]
    reservoir = CAPACITY * size * 4 / 2**20
    print(f"A reservoir of {reservoir:.0f} MiB, and {TIMES} times as many rows")
    third = len(found) // 3
    grown = statistics.median(found[-third:]) - statistics.median(found[:third])
    return [claim("memory grows, MiB", grown, at_most=0.1 * reservoir)]


# What is learned ----------------------------------------------------------------------------------


class Problem(NamedTuple):
    """Simulations with random parameters, and a network that learns them."""

    environment: str
    network: NetworkConfig
    simulations: int
    samples: int

    @property
    def rows(self) -> int:
        """Number of samples of all simulations."""
        return self.simulations * self.samples


def network(output: str, *layers: int) -> NetworkConfig:
    """Return a network that predicts a field."""
    kwargs = {"layers": list(layers), "activation": "SiLU", "opt_fields": output}
    return NetworkConfig(
        "torch/fc", network_kwargs=kwargs, loss="MSELoss", optimizer="Adam", lr=1e-3
    )


HEAT = f"{Path(__file__).parents[1] / 'examples' / 'environments' / 'heat.py'}:Heat"
PROBLEMS = {
    "Lorenz": Problem("online_problems:Lorenz", network("output", 6, 64, 64, 3), 128, 50),
    "heat": Problem(HEAT, network("temperature", 5, 128, 128, 128, 576), 192, 10),
}
VIEWS, SEEDS, SMALL_BATCH = 8, range(5), 32


def stored(problem: Problem, folder: str, name: str, seed: int, simulations: int) -> str:
    """Generate samples of some simulations, and return the folder of their session."""
    config = EnvironmentConfig(problem.environment, num_clients=2, seed=seed)
    rows = simulations * problem.samples
    DataGeneration(
        config, batch_nb=1, batch_size=rows, session_dir=folder, session_name=name, quiet=True
    ).execute()
    return f"{folder}/{name}"


class Examined(Training):
    """A training that records its losses on unseen data near its end.

    With a constant learning rate, the loss of a single network varies by a quarter from batch to
    batch, so the result of a training is the mean over the last tenth of its batches.
    """

    unseen: Mapping[str, np.ndarray]
    total: int
    batches: int
    found: list[float]

    def batch_end(self) -> None:
        """Record the mean squared error, ten times in all."""
        self.batches -= 1
        every = max(1, self.total // 100)
        if self.batches < 10 * every and self.batches % every == 0:
            (field,) = self.learner.network.opt_fields
            predicted = self.learner.predict_in_training({"input": self.unseen["input"]})[field]
            self.found.append(float(np.mean((predicted - self.unseen[field]) ** 2)))

    def learn(self, unseen: Mapping[str, np.ndarray], batches: int) -> float:
        """Train for `batches` batches, and return the mean of the losses."""
        self.unseen, self.found = unseen, []
        self.total = self.batches = batches
        self.execute()
        assert not self.batches
        return statistics.mean(self.found)


def losses(problem: Problem, folder: str, seed: int) -> list[float]:
    """Return the losses of stream, reservoir and offline training with as many simulations."""
    seen = EnvironmentConfig(problem.environment, num_clients=2, seed=seed)
    with Dataset.open(stored(problem, folder, "validation", 10_000, 100)) as dataset:
        data = {name: view[:] for name, view in dataset["training"].items()}
    rows = problem.rows
    once, often = rows // SMALL_BATCH, VIEWS * rows // SMALL_BATCH
    options = {
        "batch_size": SMALL_BATCH, "session_dir": folder, "seed": seed, "quiet": True,
        "epoch_nb": 1,
    }  # fmt: skip
    reservoir = {"capacity": rows // 2, "watermark": rows // 5, "views": VIEWS}
    offline = stored(problem, folder, "offline", seed, problem.simulations)
    stream = Examined(problem.network, None, seen, batch_nb=once, **options)
    mixed = Examined(
        problem.network, None, seen, batch_nb=often,
        online="physx/reservoir", online_kwargs=reservoir, **options,
    )  # fmt: skip
    every = DatasetConfig(existing_dir=offline, view=View(hold_back=False))
    shuffled = Examined(problem.network, every, **{**options, "epoch_nb": VIEWS})
    return [stream.learn(data, once), mixed.learn(data, often), shuffled.learn(data, often)]


def learned() -> list[bool]:
    """Compare what is learned from a stream, from a reservoir, and offline."""
    met = []
    for name, problem in PROBLEMS.items():
        found = []
        for seed in SEEDS:
            with tempfile.TemporaryDirectory() as folder:
                found.append(losses(problem, folder, seed))
        stream, reservoir, offline = np.median(found, axis=0)
        print(f"{name}: losses after {problem.simulations} simulations, medians of {len(SEEDS)}")
        print(f"  stream {stream:.3g}, reservoir {reservoir:.3g}, offline shuffled {offline:.3g}")
        ratios = np.array(found)
        against = [float(np.median(ratios[:, 1] / ratios[:, other])) for other in (0, 2)]
        met.append(claim("reservoir against stream", against[0], at_most=0.7))
        met.append(claim("reservoir against offline shuffled", against[1], at_most=1.1))
    return met


# Which simulations --------------------------------------------------------------------------------

RESONANCE = Problem("online_problems:Resonance", network("output", 2, 64, 64, 2), 1024, 1)
MANY_VIEWS = 64


def resonance(
    environment: str,
    sampler: str | None,
    folder: str,
    seed: int,
    views: int,
    clients: int = 2,
    rows: int = RESONANCE.rows,
) -> Training:
    """Return a training whose sampler chooses simulations."""
    return Training(
        RESONANCE.network,
        None,
        EnvironmentConfig(environment, num_clients=clients, sampler=sampler, seed=seed),
        epoch_nb=1,
        batch_nb=views * rows // SMALL_BATCH,
        batch_size=SMALL_BATCH,
        seed=seed,
        session_dir=folder,
        quiet=True,
        online="physx/reservoir",
        online_kwargs={
            "capacity": rows // 2,
            "watermark": max(SMALL_BATCH, rows // 10),
            "views": views,
        },
    )


def tail(sampler: str | None, folder: str, seed: int, data: Mapping[str, np.ndarray]) -> float:
    """Return the 99th percentile of the error of a training whose sampler chooses simulations."""
    with resonance(RESONANCE.environment, sampler, folder, seed, MANY_VIEWS) as training:
        training.execute()
        predicted = training.learner.predict_in_training({"input": data["input"]})["output"]
    errors = np.sqrt(np.mean((predicted - data["output"]) ** 2, axis=1))
    return float(np.quantile(errors, 0.99))


def chosen() -> list[bool]:
    """Compare simulations chosen by the loss with random ones."""
    found = []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            with Dataset.open(stored(RESONANCE, folder, "validation", 10_000, 2000)) as dataset:
                data = {name: view[:] for name, view in dataset["training"].items()}
            pair = [tail(sampler, folder, seed, data) for sampler in (None, "physx/active")]
        found.append((*pair, pair[1] / pair[0]))
    uniform, active, ratio = np.median(found, axis=0)
    print(f"Resonance, {RESONANCE.simulations} simulations: 99th percentile of the error, medians")
    print(f"  uniform {uniform:.3g}, active {active:.3g}; ratios", end=" ")
    print(*(f"{each:.2f}" for *_, each in found))
    return [claim("active against uniform", float(ratio), at_most=0.7)]


def uneven() -> list[bool]:
    """Compare a training on simulations of very different durations with an ideal pool."""
    ratios, clients = [], 4
    for seed in range(ROUNDS):
        with tempfile.TemporaryDirectory() as folder:
            name = "online_problems:Uneven"
            with resonance(name, "physx/active", folder, seed, 8, clients, 256) as training:
                began = time.perf_counter()
                training.execute()
                elapsed = time.perf_counter() - began
                durations = training.data.dataset["training"]["seconds"][:]
        ratios.append(list_schedule(durations, clients) / elapsed)
    print(
        "Simulations of uneven durations, chosen by the loss:", *(f"{each:.2f}" for each in ratios)
    )
    return [claim("against the ideal pool", statistics.median(ratios), at_least=0.9)]


# Repeated -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def busy_core() -> Iterator[None]:
    """Keep a processor core busy with another process."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def parameters(sampler: str | None, *, is_late: bool, seed: int = 0) -> np.ndarray:
    """Return the bytes of a training's final parameters."""
    name = "Late" if is_late else "Resonance"
    with tempfile.TemporaryDirectory() as folder:
        training = resonance(f"online_problems:{name}", sampler, folder, seed, views=8)
        with training:
            training.execute()
            found = training.learner.network.get_parameters().values()
    return np.concatenate([each.detach().numpy().ravel() for each in found]).view(np.uint8)


def repeated() -> list[bool]:
    """Count the bits in which the networks of identical trainings differ."""
    met = []
    for sampler in ("physx/uniform", "physx/active"):
        expected = parameters(sampler, is_late=False)
        differing = {}
        with busy_core():
            for what, options in (
                ("the same again", {"is_late": False}),
                ("clients that dawdle at random", {"is_late": True}),
                ("another seed", {"is_late": False, "seed": 1}),
            ):
                found = parameters(sampler, **options)
                differing[what] = int(np.unpackbits(expected ^ found).sum())
        print(f"{sampler}, one core busy: bits of {8 * len(expected)} that differ", end="")
        print(f"; {(what := 'another seed')}: {differing.pop(what)}")
        met += [claim(what, count, at_most=0) for what, count in differing.items()]
    return met


CLAIMS: dict[str, Callable[[], list[bool]]] = {
    "overlap": overlap,
    "uneven": uneven,
    "waits": waits,
    "memory": memory,
    "repeated": repeated,
    "learned": learned,
    "chosen": chosen,
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CLAIMS, default=CLAIMS, help="what to measure")
    parser.add_argument("--check", action="store_true", help="exit with 1 if a target is missed")
    options = parser.parse_args()
    torch.set_num_threads(1)
    np.seterr(all="raise", under="ignore")
    finish([met for name in options.only for met in CLAIMS[name]()])


if __name__ == "__main__":
    main()
