"""Unrolled training against training on single steps: the error of a rollout of 100 steps.

Lorenz-96 with 8 variables and F = 8, in steps of 0.01 (100 of them are about 1.7 Lyapunov times),
and a damped cloth of 6 by 6 masses that hangs from two corners, in steps of 0.05 s. A fully
connected network learns the change in a step from 60 episodes of 60 rows: exact ones, and of
Lorenz-96 also measured ones, with an error of 1 % of the standard deviation. Each network predicts
100 steps of 20 unseen episodes from their first states; its error is the root mean square over
them, in standard deviations. Unrolled training (1, 2, 4 and 8 steps, more by epoch) competes with
training on single steps for half as many epochs more; the seconds are those of one training.

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
SIDE, STIFFNESS, DAMPING, GRAVITY, SUBSTEP, SUBSTEPS = 6, 100.0, 0.3, 2.0, 0.005, 10
EPISODES, ROWS = 60, 60
SCHEDULE = [1] * 50 + [2] * 25 + [4] * 25 + [8] * 20
SINGLE = 180
KINDS = {
    "single steps": {"epoch_nb": SINGLE},
    "unrolled": {"epoch_nb": len(SCHEDULE), "unroll": SCHEDULE},
}


def slope(x: np.ndarray) -> np.ndarray:
    """Return dx/dt of Lorenz-96."""
    return (np.roll(x, -1, 1) - np.roll(x, 2, 1)) * np.roll(x, 1, 1) - x + FORCING


def lorenz(episodes: int, rows: int, seed: int) -> np.ndarray:
    """Return states of Lorenz-96, shape (episodes, rows, SIZE), once the start is forgotten."""
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


def cloth(episodes: int, rows: int, seed: int) -> np.ndarray:
    """Return displacements and velocities of a cloth, shape (episodes, rows, 6 SIDE^2).

    The masses begin hanging, each with a smooth random velocity.
    """
    place = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    across = [(place[:, :-1], place[:, 1:]), (place[:-1], place[1:])]
    first, last = (np.concatenate([pair[k].ravel() for pair in across]) for k in (0, 1))
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, SIDE)] * 2), axis=-1).reshape(-1, 2)
    rest = np.pad(grid, ((0, 0), (0, 1)))
    length = np.linalg.norm(rest[last] - rest[first], axis=1)[:, None]
    pinned = place[-1, [0, -1]]

    def advance(x: np.ndarray, v: np.ndarray, damping: float, count: int) -> None:
        for _ in range(count):
            edge = x[:, last] - x[:, first]
            size = np.linalg.norm(edge, axis=2, keepdims=True)
            pull = STIFFNESS * SIDE * (size - length) / size * edge
            force = np.zeros_like(x) - [0, GRAVITY, 0] - damping * v
            for of, sign in ((first, 1), (last, -1)):
                np.add.at(force, (slice(None), of), sign * pull)
            v += SUBSTEP * force
            v[:, pinned] = 0
            x += SUBSTEP * v

    x = rest[None].copy()
    advance(x, np.zeros_like(x), 5.0, 4000)
    hanging = x[0].copy()
    waves = np.random.default_rng(seed).normal(size=(episodes, 3, 3, 3))
    modes = np.cos(np.pi * np.arange(3)[:, None] * grid.T[:, None])
    x = np.repeat(hanging[None], episodes, axis=0)
    v = np.einsum("eijk,in,jn->enk", waves, *modes) * [0.1, 0.1, 0.5]
    v[:, pinned] = 0
    states = np.empty((episodes, rows, 2, *rest.shape))
    for row in range(rows):
        states[:, row] = np.stack([x - hanging, v], axis=1)
        advance(x, v, DAMPING, SUBSTEPS)
    return states.reshape(episodes, rows, -1)


CASES = {
    "Lorenz-96, exact states": (lorenz, 0.0),
    "Lorenz-96, states measured with an error of 1 %": (lorenz, 0.01),
    "cloth, exact states": (cloth, 0.0),
}


def train(folder: str, size: int, name: str, seed: int, options: dict) -> str:
    """Train a network; return its session's folder."""
    network = NetworkConfig(
        "torch/fc",
        {"layers": [size, 96, 96, size], "net_fields": "now", "opt_fields": "next"},
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
    folder = "".join(each if each.isalnum() else "_" for each in case)
    simulate, noise = CASES[case]
    states = simulate(EPISODES, ROWS, seed=1)
    size = states.shape[-1]
    states += noise * states.std((0, 1)) * np.random.default_rng(3).normal(size=states.shape)
    episode, step = np.divmod(np.arange(EPISODES * ROWS), ROWS)
    with Dataset.create(folder) as dataset:
        rows = {"state": states.reshape(-1, size), "episode": episode, "step": step}
        dataset.append("training", rows)
    truth, errors = simulate(20, STEPS + 1, seed=2), {}
    print(case)
    for name, options in KINDS.items():
        begin = time.monotonic()
        folders = [train(folder, size, name, seed, options) for seed in range(seeds)]
        errors[name] = [error(each, truth) for each in folders]
        seconds = (time.monotonic() - begin) / seeds
        each = ", ".join(f"{value:.3g}" for value in errors[name])
        print(
            f"  {name}: error after {STEPS} steps {np.median(errors[name]):.3g} std ({each}), "
            f"{seconds:.3g} s each"
        )
    return float(np.median(errors["unrolled"]) / np.median(errors["single steps"]))


def claims(seeds: int = 5, only: str = "") -> list[bool]:
    """Print the errors in cases in the working directory, and whether the claims hold."""
    return [
        claim("error of unrolled training, as a share", compare(case, seeds), at_most=0.7)
        for case in CASES
        if only in case
    ]


def main() -> None:
    """Measure, and print whether the claim holds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="a word of the cases' names")
    given = parser.parse_known_args()[0]
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        met = claims(given.seeds, given.only)
        os.chdir("/")
    finish(met)


if __name__ == "__main__":
    main()
