"""Your own network, with the problem's symmetries built in.

The spread of a cloud depends neither on the order of its points nor on its position. A deep set, a
plain PyTorch class named by its module, has these symmetries built in. Its rivals are fully
connected layers of three widths, which have to learn them: one has as many parameters, one has
more. All learn from the same samples.

    python examples/04_own_network.py
"""

from __future__ import annotations

import sys

from common import compared, conclude, generate, options, samples
from environments.cloud import POINTS, IndependentCloud, network
from matplotlib.figure import Figure
from networks.deep_set import DeepSet

from physx_core import Comparison, NetworkConfig

WIDTH = 64
OWN = NetworkConfig(
    "networks.deep_set:DeepSet",
    network_kwargs={"width": WIDTH, "outputs": 3},
    loss="MSELoss",
    optimizer="Adam",
    lr=2e-3,
)


def draw(path, right, guesses) -> None:
    """Plot guesses over the truth, one diagram per network."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, (name, guess) in zip(figure.subplots(1, 3), guesses.items(), strict=True):
        axes.plot(right, guess, ".", ms=2)
        axes.plot([0, right.max()], [0, right.max()], "k", lw=0.8)
        axes.set(title=name, xlabel="spread in m", xlim=(0, 1.8), ylim=(0, 1.8))
    figure.savefig(path)


def main() -> int:
    asked = options(__doc__).parse_args()
    rows, epochs = (300, 3) if asked.small else (20_000, 12)
    stored = generate(IndependentCloud, rows, asked.session_dir, num_clients=2)
    networks = {}
    for width in (32, 97, 256):
        count = width**2 + (3 * POINTS + 5) * width + 3
        networks[f"FC, {count} parameters"] = network(width), epochs
    count = sum(each.numel() for each in DeepSet(WIDTH, 3).parameters())
    networks[f"deep set, {count} parameters"] = OWN, epochs
    results, guesses = compared(stored, networks, "input", batch_size=64)
    if asked.picture:
        (right,) = samples(stored, "validation", "ground_truth")
        names = [list(guesses)[k] for k in (0, 1, 3)]
        draw(asked.picture, right, {name: guesses[name][0] for name in names})
    comparison = Comparison.of(results, "error/ground_truth/relative_l2")
    return conclude(comparison, small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
