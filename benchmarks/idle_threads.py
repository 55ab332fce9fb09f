"""How much idle threads of a network's library slow down environments in other processes.

    python benchmarks/idle_threads.py

A policy's network, wide enough that its library uses several threads, and a vector environment in
two processes alternate, as in reinforcement learning. Three settings are compared: the time for
which GNU's OpenMP lets idle threads spin, the shorter time that physx requests, and one thread,
which leaves none idle. A training on stored samples, whose pieces of work follow each other
immediately, runs with the first two.
"""

from __future__ import annotations

import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np
from measure import claim, finish

import physx_gym  # noqa: F401 - shortens the spin time of OpenMP
from physx_core import Dataset, DatasetConfig, NetworkConfig, Training

ROUNDS, SLICE = 9, 0.5
OWN, PHYSX, ONE = "OpenMP's own", "physx", "one thread"
SPINS = {OWN: {"GOMP_SPINCOUNT": "300000"}, PHYSX: {}, ONE: {"OMP_NUM_THREADS": "1"}}


def act() -> None:
    """Step ants with a policy; print the steps per second for each line that is read."""
    import torch

    sizes = [27, 512, 512, 8]
    layers = [torch.nn.Linear(*pair) for pair in itertools.pairwise(sizes)]
    policy = torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2])
    env = gymnasium.make_vec("physx/Ant-v0", 8, num_processes=2)
    observations, _ = env.reset(seed=0)
    for _ in sys.stdin:
        begin, steps = time.perf_counter(), 0
        while time.perf_counter() - begin < SLICE:
            with torch.no_grad():
                actions = policy(torch.as_tensor(observations, dtype=torch.float32))
            observations, *_ = env.step(np.clip(actions.numpy(), -1.0, 1.0))
            steps += env.num_envs
        print(steps / (time.perf_counter() - begin), flush=True)
    env.close()


def learn() -> None:
    """Train on stored samples; print the samples per second for each line that is read."""
    rng, count = np.random.default_rng(0), 8192
    with tempfile.TemporaryDirectory() as name:
        with Dataset.create(Path(name) / "data") as data:
            rows = {"input": rng.random((count, 32)), "ground_truth": rng.random((count, 8))}
            data.append("training", rows)
        network = NetworkConfig(
            "torch/fc", {"layers": [32, 512, 512, 8]}, loss="MSELoss", optimizer="Adam"
        )
        stored = DatasetConfig(existing_dir=str(Path(name) / "data"), normalize=False)
        for _ in sys.stdin:
            training = Training(network, stored, session_dir=name, epoch_nb=1, batch_size=64)
            with training:
                training.train_begin()
                training.epoch_begin()
                begin = time.perf_counter()
                while training.batch_condition():
                    training.batch_produce()
                    training.optimize()
                    training.batch_count()
                print(count / (time.perf_counter() - begin), flush=True)


def compare(what: str, *kinds: str) -> dict[str, list[float]]:
    """Return the rates of each kind of process in interleaved rounds."""
    chosen = {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY", "OMP_NUM_THREADS"}
    plain = {name: value for name, value in os.environ.items() if name not in chosen}
    processes = {
        kind: subprocess.Popen(
            [sys.executable, __file__, what],
            env={**plain, **SPINS[kind]},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for kind in kinds
    }
    measured: dict[str, list[float]] = {kind: [] for kind in kinds}
    for count in range(ROUNDS + 1):
        for kind, process in processes.items():
            print("go", file=process.stdin, flush=True)
            rate = float(process.stdout.readline())
            if count:
                measured[kind].append(rate)
    for process in processes.values():
        process.communicate()
    return measured


def main() -> None:
    """Measure and print."""
    if sys.argv[1:] in (["act"], ["learn"]):
        {"act": act, "learn": learn}[sys.argv[1]]()
        return
    met = []
    for title, what, kinds, target in (
        ("8 ants in 2 processes and a policy in turn, steps/s", "act", (OWN, PHYSX, ONE), 1.15),
        ("Training on stored samples, FC [32, 512, 512, 8], samples/s", "learn", (OWN, PHYSX), 0.9),
    ):
        measured = compare(what, *kinds)
        print(f"{title}, by how long idle threads spin")
        for kind, values in measured.items():
            print(f"  {kind}: {statistics.median(values):,.0f}")
        pairs = zip(measured[PHYSX], measured[OWN], strict=True)
        ratio = statistics.median(mine / other for mine, other in pairs)
        met.append(claim("physx against OpenMP's own", ratio, at_least=target))
    finish(met)


if __name__ == "__main__":
    main()
