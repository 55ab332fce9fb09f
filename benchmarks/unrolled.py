"""Unrolled training against training on single steps: the error of a rollout of 100 steps.

Lorenz-96 with 8 variables and F = 8, in steps of 0.01 (100 of them are about 1.7 Lyapunov times). A
fully connected network learns the change in a step from 60 episodes of 60 rows: exact ones, and
measured ones, with an error of 1 % of the standard deviation. Each network predicts 100 steps of 20
unseen episodes from their first states; its error is the root mean square over them, in standard
deviations. Unrolled training (1, 2, 4 and 8 steps, more by epoch) competes with training on single
steps for half as many epochs more; the seconds are those of one training.

    python benchmarks/unrolled.py --check
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time

import numpy as np
from measure import claim, finish

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, View
from physx_core.pipelines import load_learner

SIZE, FORCING, DT, STEPS = 8, 8.0, 0.01, 100
EPISODES, ROWS = 60, 60
CASES = {"exact states": 0.0, "states measured with an error of 1 %": 0.01}
SCHEDULE = [1] * 50 + [2] * 25 + [4] * 25 + [8] * 20
SINGLE = 180
KINDS = {
    "single steps": {"epoch_nb": SINGLE},
    "unrolled": {"epoch_nb": len(SCHEDULE), "unroll": SCHEDULE},
}


def slope(x: np.ndarray) -> np.ndarray:
    """Return dx/dt of Lorenz-96."""
    return (np.roll(x, -1, 1) - np.roll(x, 2, 1)) * np.roll(x, 1, 1) - x + FORCING


def simulate(episodes: int, rows: int, seed: int) -> np.ndarray:
    """Return states, shape (episodes, rows, SIZE), after a time in which the start is forgotten."""
    x = FORCING + np.random.default_rng(seed).normal(size=(episodes, SIZE))
    states = np.empty((episodes, rows, SIZE))
    for row in range(-1000, rows):
        if row >= 0:
            states[:, row] = x
        a = slope(x)
        b = slope(x + DT / 2 * a)
        c = slope(x + DT / 2 * b)
        x = x + DT / 6 * (a + 2 * b + 2 * c + slope(x + DT * c))
    return states


def train(folder: str, name: str, seed: int, options: dict) -> str:
    """Train a network; return its session's folder."""
    network = NetworkConfig(
        "torch/fc",
        {"layers": [SIZE, 96, 96, SIZE], "net_fields": "now", "opt_fields": "next"},
        loss="MSELoss",
        optimizer="Adam",
        lr=3e-3,
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": options["epoch_nb"]},
        device="cpu",
    )
    view = View(window={"now": ("state", 0), "next": ("state", 1)}, hold_back=False)
    data = DatasetConfig(existing_dir=folder, normalize={"next": "increment"}, view=view)
    training = Training(
        network, data, batch_size=128, seed=seed, rivals="none", quiet=True, validation_every=0,
        session_dir=folder, session_name=f"{name}_{seed}".replace(" ", "_"), **options,
    )  # fmt: skip
    training.execute()
    return str(training.session.path)


def error(session: str, truth: np.ndarray) -> float:
    """Return the root mean square error after 100 steps, in standard deviations."""
    learner = load_learner(session, NetworkConfig(device="cpu"))
    state = truth[:, 0]
    for _ in range(STEPS):
        state = learner.predict({"now": state})["next"]
    return float(np.sqrt(np.square(state - truth[:, STEPS]).mean()) / truth.std())


def compare(case: str, seeds: int) -> float:
    """Print the errors; return that of unrolled training divided by that on single steps."""
    folder = case.replace(" ", "_").replace("%", "percent")
    states = simulate(EPISODES, ROWS, seed=1)
    states += CASES[case] * states.std() * np.random.default_rng(3).normal(size=states.shape)
    episode, step = np.divmod(np.arange(EPISODES * ROWS), ROWS)
    with Dataset.create(folder) as dataset:
        rows = {"state": states.reshape(-1, SIZE), "episode": episode, "step": step}
        dataset.append("training", rows)
    truth, errors = simulate(20, STEPS + 1, seed=2), {}
    print(case)
    for name, options in KINDS.items():
        begin = time.monotonic()
        errors[name] = [error(train(folder, name, seed, options), truth) for seed in range(seeds)]
        seconds = (time.monotonic() - begin) / seeds
        each = ", ".join(f"{value:.3g}" for value in errors[name])
        print(
            f"  {name}: error after {STEPS} steps {np.median(errors[name]):.3g} std ({each}), "
            f"{seconds:.3g} s each"
        )
    return float(np.median(errors["unrolled"]) / np.median(errors["single steps"]))


def claims(seeds: int = 5) -> list[bool]:
    """Print the errors in all cases in the working directory, and whether the claims hold."""
    return [
        claim("error of unrolled training, as a share", compare(case, seeds), at_most=0.7)
        for case in CASES
    ]


def main() -> None:
    """Measure, and print whether the claim holds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_known_args()[0].seeds
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        met = claims(seeds)
        os.chdir("/")
    finish(met)


if __name__ == "__main__":
    main()
