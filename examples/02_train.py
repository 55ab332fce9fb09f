"""Training on stored samples, interrupted and resumed.

Fully connected layers learn the spread of a cloud from the coordinates of its points. The training
stops after a third of its epochs, as after Ctrl-C, and is resumed: the network is bit-identical to
one trained without interruption. Then networks from three seeds are compared with what needs none:
the mean of all samples, a linear map, the nearest sample, and one rival of our own, a linear map of
all products of two coordinates.

    python examples/02_train.py
    physx stats sessions/train
"""

from __future__ import annotations

import sys

import numpy as np
from common import compared, conclude, generate, linear_map, options, samples
from environments.cloud import IndependentCloud, network
from matplotlib.figure import Figure

from physx_core import Comparison, DatasetConfig, Training, read_scalars


def products(clouds: np.ndarray) -> np.ndarray:
    """Return all coordinates and all products of two of them, shape (rows, features)."""
    flat = clouds.reshape(len(clouds), -1)
    first, second = np.triu_indices(flat.shape[1])
    return np.hstack([flat, flat[:, first] * flat[:, second]])


def draw(path, session, right, guess) -> None:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    losses, compared = figure.subplots(1, 2)
    for name in ("loss/training", "loss/validation"):
        curve = read_scalars(session)["epoch", name]
        losses.semilogy(list(curve), list(curve.values()), label=name)
    losses.set(xlabel="epoch", ylabel="mean squared error (normalized)")
    losses.legend()
    compared.plot(right, guess, ".", [0, 1.8], [0, 1.8], "k", ms=2, lw=0.8)
    compared.set(xlabel="spread in m, along the three axes", ylabel="what the network says")
    figure.savefig(path)


def main() -> int:
    asked = options(__doc__).parse_args()
    rows, epochs = (300, 3) if asked.small else (20_000, 12)
    stored = generate(IndependentCloud, rows, asked.session_dir, as_tcp_ip_client=False)
    inputs, outputs = samples(stored, "training", "input", "ground_truth")
    clouds, right = samples(stored, "validation", "input", "ground_truth")

    data, name = DatasetConfig(existing_dir=str(stored), normalize=True), "train"
    for until in (epochs // 3, epochs):
        training = Training(
            network(), data, epoch_nb=until, batch_size=64, seed=0,
            session_name=name, session_dir=str(asked.session_dir), resume=until == epochs,
        )  # fmt: skip
        with training:
            training.execute()
            resumed = training.learner.predict_in_training({"input": clouds})["prediction"]
        name = training.session.name
        print(f"after {until:2} epochs: loss {training.validation_loss:.4f}, held-back samples")
    fitted = linear_map(products(inputs), outputs)

    def map_of_products(given):
        return fitted(products(given["input"]))

    networks, rivals = {"network": (network(), epochs)}, ["all", map_of_products]
    results, guesses = compared(stored, networks, "input", rivals, batch_size=64)
    print(f"the same as a training in one go: {np.array_equal(resumed, guesses['network'][0])}")
    if asked.picture:
        draw(asked.picture, training.session.path, right, guesses["network"][0])
    comparison = Comparison.of(results, "error/ground_truth/relative_l2")
    return conclude(comparison, small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
