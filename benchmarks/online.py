"""Online training: simulating and learning at the same time.

    python benchmarks/online.py
    python benchmarks/online.py --check

Overlap: one client simulates, with about the cost of a batch that its learner has. Claim: the
training makes at least 0.92 times as many batches a second as the slower of the two makes alone,
and neither waits for the other for more than 2 % of the time beyond what counts demand.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from typing import Any

import numpy as np
import torch
from measure import claim, finish

from physx_core import (
    DataGeneration,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Training,
)
from physx_core.pipelines.pipeline import Pipeline

BATCH, BATCHES, ROUNDS = 16, 60, 3
NETWORK = NetworkConfig(
    "torch/fc",
    network_kwargs={"layers": [8, 2000, 2000, 1], "opt_fields": "ground_truth"},
    loss="MSELoss",
    optimizer="Adam",
    lr=1e-4,
)


class Costly(Environment):
    """A simulation whose step takes a given time of a processor."""

    def __init__(self, *, cost: float, **kwargs: Any) -> None:
        """Note the cost of a step, in s."""
        super().__init__(**kwargs)
        self._cost = cost

    def create(self) -> None:
        """Create nothing."""

    def init_database(self) -> None:
        """Define a field to read and one to predict."""
        self.define_training_fields([Field("input", shape=(8,)), Field("ground_truth", shape=(1,))])

    def step(self) -> None:
        """Work."""
        until = time.perf_counter() + self._cost
        while time.perf_counter() < until:
            pass
        x = self.rng.normal(size=8)
        self.set_training_data(input=x, ground_truth=x[:1] * x[1:2])


def learner_alone(folder: str) -> float:
    """Return batches per second of a training on stored samples."""
    training = Training(
        NETWORK, DatasetConfig(existing_dir=folder), epoch_nb=1, batch_nb=BATCHES, **common(folder)
    )
    return batches_per_second(training)


def client_alone(folder: str, cost: float, batches: int = BATCHES) -> float:
    """Return batches per second of one client."""
    config = environment(cost)
    options = {key: value for key, value in common(folder).items() if key != "seed"}
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
        "online:Costly", as_tcp_ip_client=True, num_clients=1, env_kwargs={"cost": cost}, seed=0
    )


def common(folder: str) -> dict[str, Any]:
    """Return options of all pipelines."""
    return {"batch_size": BATCH, "session_dir": folder, "quiet": True, "seed": 0}


def batches_per_second(pipeline: Pipeline) -> float:
    """Return the batches per second of a pipeline, from when all is open."""
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


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    np.seterr(all="raise")
    finish(overlap())


if __name__ == "__main__":
    main()
