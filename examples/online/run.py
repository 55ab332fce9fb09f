"""Learning the heat equation while two clients simulate it.

Each simulation has other parameters. A reservoir mixes the samples of many simulations, and each
is used several times; `physx/active` simulates more where the network is still wrong. Prints what
both samplers led to, and draws which simulations were made and where the errors are.

Needs matplotlib.

    python examples/online/run.py                     # a minute on 2 cores; online.png
    python examples/online/run.py --small
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from heat import CELLS, FRAMES, Heat

from physx_core import DataGeneration, Dataset, EnvironmentConfig, NetworkConfig, Training

SAMPLERS = "physx/uniform", "physx/active"
BATCH, VIEWS = 32, 16
LAYERS = [5, 128, 128, 128, CELLS**2]
KWARGS = {"layers": LAYERS, "activation": "SiLU", "opt_fields": "temperature"}
NETWORK = NetworkConfig("torch/fc", KWARGS, loss="MSELoss", optimizer="Adam", lr=1e-3)


def read(path: Path, mode: str) -> dict[str, np.ndarray]:
    """Return what a session has stored of a mode."""
    with Dataset.open(path) as dataset:
        return {name: view[:] for name, view in dataset[mode].items()}


def unseen(folder: str, simulations: int) -> dict[str, np.ndarray]:
    """Return samples of simulations that no network learns from."""
    config = EnvironmentConfig(Heat, num_clients=2, seed=1)
    options = {"batch_nb": 1, "batch_size": simulations * FRAMES, "quiet": True}
    generation = DataGeneration(config, session_dir=folder, **options)
    generation.execute()
    return read(generation.session.path, "training")


def train(sampler: str, folder: str, rows: int, data: dict) -> tuple[dict, np.ndarray]:
    """Train while two clients simulate; return their parameters, and the error of each sample."""
    environment = EnvironmentConfig(Heat, num_clients=2, seed=0, sampler=sampler)
    buffer = {"capacity": rows // 2, "watermark": rows // 10, "views": VIEWS}
    training = Training(
        NETWORK, None, environment, epoch_nb=1, batch_nb=VIEWS * rows // BATCH, batch_size=BATCH,
        seed=0, session_dir=folder, session_name=sampler.partition("/")[2],
        online="physx/reservoir", online_kwargs=buffer,
    )  # fmt: skip
    training.execute()
    predicted = training.learner.predict_in_training({"input": data["input"]})["temperature"]
    error = np.sqrt(np.mean((predicted - data["temperature"]) ** 2, axis=(1, 2)))
    return read(training.session.path, "parameters"), error


def draw(path: Path, found: dict[str, tuple[dict, np.ndarray]], data: dict) -> None:
    """Draw width and diffusivity of the simulations, and the errors over them."""
    low, high = np.array([[each.low[0], each.high[0]] for each in Heat.PARAMETERS[2:]]).T
    width, diffusivity = (low + (data["input"][:, 2:4] + 1) / 2 * (high - low)).T
    options = {"sharex": True, "sharey": True, "figsize": (8, 6), "layout": "constrained"}
    figure, panels = plt.subplots(2, 2, **options)
    largest = max(np.quantile(error, 0.998) for _, error in found.values())
    for (above, below), (sampler, (sets, error)) in zip(panels.T, found.items(), strict=True):
        above.scatter(sets["width"], sets["diffusivity"], s=6)
        above.set_title(f"{sampler}: simulations")
        order = np.argsort(error)  # the largest on top
        colors = {"c": error[order], "vmin": 0, "vmax": largest, "cmap": "viridis_r"}
        shown = below.scatter(width[order], diffusivity[order], s=6, **colors)
        title = f"99 % of errors below {np.quantile(error, 0.99):.3f} K"
        below.set(title=title, xlabel="width of the spot (m)")
    for row in panels:
        row[0].set_ylabel("diffusivity (m²/s)")
    figure.colorbar(shown, ax=panels[1], label="error (K)")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train with both samplers, and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="few simulations")
    parser.add_argument("--sessions", default="sessions", help="folder of the sessions")
    parser.add_argument("--picture", type=Path, default=Path("online.png"))
    chosen = parser.parse_args()
    simulations, found = (32, {}) if chosen.small else (256, {})
    data = unseen(chosen.sessions, 50 if chosen.small else 500)
    for sampler in SAMPLERS:
        sets, error = found[sampler] = train(sampler, chosen.sessions, simulations * FRAMES, data)
        print(
            f"{sampler}: {len(sets['width'])} simulations, mean error {error.mean():.4f} K, "
            f"99 % of the samples below {np.quantile(error, 0.99):.4f} K"
        )
    draw(chosen.picture, found, data)
    print(f"picture: {chosen.picture}")


if __name__ == "__main__":
    main()
