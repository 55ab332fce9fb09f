"""Samples from your own loop, without an environment.

A few lines of NumPy that know nothing about physx simulate a pendulum with large swings. Each block
of samples goes into a dataset as soon as it is computed, and is safe from then on, whatever happens
to the program. Everything else works as with any other dataset. A network learns where the pendulum
is one second later, and is compared with cheaper rivals: the theory of small swings, a linear map,
and narrower networks.

    python examples/15_own_loop.py
    physx info sessions/pendulum
"""

from __future__ import annotations

import sys

import numpy as np
from common import compared, conclude, config, options, samples
from matplotlib.figure import Figure

from physx_core import Comparison, Dataset

FREQUENCY, STEPS = np.sqrt(9.81), 200  # small swings at 1 m, in rad/s; steps per second
TURN = np.array([[np.cos(FREQUENCY), -np.sin(FREQUENCY) * FREQUENCY],
                 [np.sin(FREQUENCY) / FREQUENCY, np.cos(FREQUENCY)]])  # fmt: skip


def swing(state: np.ndarray) -> np.ndarray:
    """Return angle and angular velocity one second later, shape (pendulums, 2), in rad, rad/s."""
    angle, velocity = state.T.copy()
    for _ in range(STEPS):  # leapfrog
        velocity -= 0.5 / STEPS * FREQUENCY**2 * np.sin(angle)
        angle += velocity / STEPS
        velocity -= 0.5 / STEPS * FREQUENCY**2 * np.sin(angle)
    return np.stack([angle, velocity], axis=1)


def theory_of_small_swings(given: dict[str, np.ndarray]) -> np.ndarray:
    """Return the state one second later if the sine of the angle were the angle."""
    return given["state"] @ TURN


def draw(path, state, later) -> None:
    """Draw the angle after one second over the initial state, as each model predicts it."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, (name, found) in zip(figure.subplots(1, len(later)), later.items(), strict=True):
        dots = axes.scatter(*state.T, c=found[:, 0], s=3, cmap="twilight", vmin=-3, vmax=3)
        axes.set(title=name, xlabel="angle in rad", ylabel="velocity in rad/s")
    figure.colorbar(dots, label="angle a second later in rad")
    figure.savefig(path)


def main() -> int:
    asked = options(__doc__).parse_args()
    blocks, epochs = (3, 2) if asked.small else (100, 30)
    folder, rng = asked.session_dir / "pendulum", np.random.default_rng(0)
    with Dataset.create(folder) as dataset:
        for block in range(blocks):
            state = rng.uniform([-2.5, -3.0], [2.5, 3.0], (100, 2))
            mode = "validation" if block % 5 == 4 or block == blocks - 1 else "training"
            dataset.append(mode, {"state": state, "later": swing(state)})

    networks = {}
    for width in (8, 16, 64):
        sizes = {"layers": [2, width, width, 2], "activation": "Tanh"}
        made = config("torch/fc", "state", "later", epochs, 0.01, **sizes)
        networks[f"FC, width {width}"] = made, epochs
    rivals = ["all", theory_of_small_swings]
    results, guesses = compared(folder, networks, "state", rivals, batch_size=128)
    if asked.picture:
        state, right = samples(folder, "validation", "state", "later")
        theory = theory_of_small_swings({"state": state})
        shown = {"exact": right, "theory of small swings": theory}
        draw(asked.picture, state, shown | {"FC, width 64": guesses["FC, width 64"][0]})
    return conclude(Comparison.of(results, "error/later/relative_l2"), small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
