"""Learning the heat equation while two clients simulate it.

Each simulation has other parameters. A reservoir mixes the samples of many simulations, and each
is used several times; `physx/active` simulates more where the network is still wrong. Prints what
both samplers led to, and draws which simulations were made and where the errors are.

Needs matplotlib.

    python examples/online/run.py                     # a minute on 2 cores; online.png
    python examples/online/run.py --small
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from heat import CELLS, FRAMES, Heat

from physx_core import DataGeneration, Dataset, EnvironmentConfig, NetworkConfig, Training

SAMPLERS = "physx/uniform", "physx/active"
BATCH, VIEWS = 32, 8
NETWORK = NetworkConfig(
    "torch/fc",
    network_kwargs={
        "layers": [5, 128, 128, 128, CELLS**2],
        "activation": "SiLU",
        "opt_fields": "temperature",
    },
    loss="MSELoss",
    optimizer="Adam",
    lr=1e-3,
)


def unseen(folder: str, simulations: int) -> dict[str, np.ndarray]:
    """Return samples of simulations that no network learns from, and their parameters."""
    config = EnvironmentConfig(Heat, as_tcp_ip_client=True, num_clients=2, seed=1)
    with DataGeneration(
        config, batch_nb=1, batch_size=simulations * FRAMES, session_dir=folder, quiet=True
    ) as generation:
        generation.execute()
        path = generation.session.path
    with Dataset.open(path) as dataset:
        return {name: view[:] for name, view in dataset["training"].items()}


def train(sampler: str, folder: str, simulations: int) -> tuple[Training, dict[str, np.ndarray]]:
    """Train while two clients simulate; return the training, and the parameters they got."""
    rows = simulations * FRAMES
    config = EnvironmentConfig(Heat, as_tcp_ip_client=True, num_clients=2, seed=0, sampler=sampler)
    training = Training(
        NETWORK,
        None,
        config,
        epoch_nb=1,
        batch_nb=VIEWS * rows // BATCH,
        batch_size=BATCH,
        seed=0,
        session_dir=folder,
        session_name=sampler.partition("/")[2],
        online="physx/reservoir",
        online_kwargs={"capacity": rows // 2, "watermark": rows // 10, "views": VIEWS},
    )
    training.execute()
    with Dataset.open(training.session.path) as dataset:
        return training, {name: view[:] for name, view in dataset["parameters"].items()}


def errors(training: Training, data: dict[str, np.ndarray]) -> np.ndarray:
    """Return the error of each sample, as root of the mean square over the cells."""
    predicted = training.learner.predict_in_training({"input": data["input"]})["temperature"]
    return np.sqrt(np.mean((predicted - data["temperature"]) ** 2, axis=(1, 2)))


def draw(path: Path, found: dict[str, tuple[dict, np.ndarray]], data: dict) -> None:
    """Draw width and diffusivity of the simulations, and the errors over them."""
    low, high = np.array([[each.low[0], each.high[0]] for each in Heat.PARAMETERS[2:]]).T
    width, diffusivity = (low + (data["input"][:, 2:4] + 1) / 2 * (high - low)).T
    figure, panels = plt.subplots(
        2, 2, figsize=(8, 6.5), sharex=True, sharey=True, layout="constrained"
    )
    largest = max(np.quantile(error, 0.99) for _, error in found.values())
    for (above, below), (sampler, (sets, error)) in zip(panels.T, found.items(), strict=True):
        above.scatter(sets["width"], sets["diffusivity"], s=6, color="tab:blue")
        above.set_title(f"{sampler}: simulations")
        shown = below.scatter(width, diffusivity, c=error, s=6, vmin=0, vmax=largest)
        below.set_title(f"errors, 99 % below {np.quantile(error, 0.99):.3g} K")
        below.set_xlabel("width (m)")
    for row in panels:
        row[0].set_ylabel("diffusivity (m²/s)")
    figure.colorbar(shown, ax=panels, label="error (K)")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train with both samplers, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="few simulations")
    parser.add_argument("--sessions", default="sessions", help="folder of the sessions")
    parser.add_argument("--picture", type=Path, default=Path("online.png"))
    chosen = parser.parse_args()
    simulations = 64 if chosen.small else 512
    data, found = unseen(chosen.sessions, 100 if chosen.small else 500), {}
    for sampler in SAMPLERS:
        training, sets = train(sampler, chosen.sessions, simulations)
        error = errors(training, data)
        found[sampler] = sets, error
        print(
            f"{sampler}: {len(sets['width'])} simulations, mean error {error.mean():.3g} K, "
            f"99 % of the samples below {np.quantile(error, 0.99):.3g} K"
        )
    draw(chosen.picture, found, data)
    print(f"picture: {chosen.picture}")


if __name__ == "__main__":
    main()
