"""Online training: learn the heat equation while simulating it where the network is wrong.

Heat spreads from a spot; narrow spots that stay sharp are rare, and they are the hard part. Two
clients simulate; a reservoir mixes the samples of many simulations, and the network learns while
the next ones run. `physx/active` simulates more where the loss is high. Its largest errors on
unseen simulations are compared with those for random parameters, and for simulations that are all
stored first, with networks of two widths; each gets as many simulations and batches.

    python examples/14_online_training.py --picture online.png
"""

from __future__ import annotations

import sys

import numpy as np
from common import SEEDS, conclude, generate, linear_map, options, samples, trained
from environments.heat import CELLS, FRAMES, Heat
from environments.heat_picture import draw

from physx_core import Comparison, Dataset, EnvironmentConfig, NetworkConfig, Training

BATCH, VIEWS, WIDTH = 32, 8, 128


def network(width: int) -> NetworkConfig:
    how = {"layers": [5, *[width] * 3, CELLS**2], "activation": "SiLU", "opt_fields": "temperature"}
    return NetworkConfig("torch/fc", how, loss="MSELoss", optimizer="Adam", lr=1e-3)


def online(sampler, rows, seed, folder, given):
    """Train while simulating; return the session's parameters, and predictions."""
    environment = EnvironmentConfig(Heat, num_clients=2, seed=seed, sampler=sampler)
    buffer = {"capacity": rows // 2, "watermark": rows // 10, "views": VIEWS}
    with Training(
        network(WIDTH), None, environment, epoch_nb=1, batch_nb=VIEWS * rows // BATCH,
        batch_size=BATCH, seed=seed, session_dir=str(folder), session_name="online", quiet=True,
        online="physx/reservoir", online_kwargs=buffer,
    ) as training:  # fmt: skip
        training.execute()
        (guess,) = training.learner.predict_in_training({"input": given}).values()
    with Dataset.open(training.session.path) as dataset:
        table = dataset.episode_table(["training"])
    is_episode = table["episode"] >= 0  # not the record of the samples before the first one
    return [table[name][is_episode] for name in ("width", "diffusivity")], guess


def main() -> int:
    """Train in all ways; return whether choosing the simulations was no better."""
    chosen = options(__doc__).parse_args()
    simulations, seeds = (32, SEEDS[:1]) if chosen.small else (1024, SEEDS)
    rows, folder, errors, found = simulations * FRAMES, chosen.session_dir, {}, []
    session = generate(Heat, rows, folder, num_clients=2)
    given, exact = samples(session, "validation", "input", "temperature")

    def note(name, guess):
        error = np.sqrt(((guess - exact) ** 2).mean((1, 2)) / (exact**2).mean())
        errors.setdefault(name, []).append((error.mean(), np.quantile(error, 0.99)))
        return error

    note("a linear map", linear_map(*samples(session, "training", "input", "temperature"))(given))
    for seed in seeds:
        for width in (WIDTH, 4 * WIDTH):
            learner = trained(session, network(width), VIEWS, seed, batch_size=BATCH).learner
            (guess,) = learner.predict_in_training({"input": given}).values()
            note(f"stored first, {width} wide", guess)
        for sampler in ("physx/uniform", "physx/active"):
            sets, guess = online(sampler, rows, seed, folder, given)
            found.append((sampler, sets, note(sampler, guess)))
    means, tails = ({n: [pair[k] for pair in e] for n, e in errors.items()} for k in (0, 1))
    print(f"\n{Comparison(means, 'physx/active', 'mean error').table}")
    if chosen.picture:
        draw(chosen.picture, found[-2:], given)
    comparison = Comparison(tails, "physx/active", "99 % of errors are below")
    return conclude(comparison, small=chosen.small)


if __name__ == "__main__":
    sys.exit(main())
