"""A deformable body: learn how a beam bends, and put what was learned in the solver's place.

1. Two clients solve a hyperelastic beam (Neo-Hookean, clamped at one end) under random forces on
   its surface with the finite-element library felupe; samples forces -> displacement go into HDF5.
2. A fully connected network and a UNet learn them.
3. Both predict the displacements under forces that they have never seen; each prediction is put
   back into the running environment, which compares it with the solver's.
4. Rerun shows the solver's beam, solid, and the network's, as a wire frame over it.

Prints how the samples were made, the mean relative displacement error of both networks, and how
many times faster than the solver they are. Needs felupe and scipy (requirements.txt).

    python examples/beam/run.py             # some minutes on 2 cores
    python examples/beam/run.py --small     # less than a minute, to see that it works
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from beam import NODES, Beam, relative_error

from physx_core import (
    DataGeneration,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    PhysxError,
    Prediction,
    Training,
)
from physx_rerun import render_picture


@dataclass(frozen=True)
class Size:
    """How much is done."""

    samples: int
    validation_samples: int
    fc_epochs: int
    unet_epochs: int
    steps: int
    greatest_error: float


FULL = Size(2400, 200, 60, 30, 100, greatest_error=0.05)
SMALL = Size(60, 20, 10, 2, 10, greatest_error=float("inf"))
VALUES = int(np.prod(NODES)) * 3
FIELDS = {"net_fields": "forces", "opt_fields": "displacement"}


class Comparison(Prediction):
    """Keeps errors, and the times that solver and network take for the same forces."""

    def prediction_begin(self) -> None:
        super().prediction_begin()
        self.errors, self.lengths, self.solver_seconds, self.network_seconds = [], [], [], []

    def sample_end(self) -> None:
        super().sample_end()
        exact = self.batch["displacement"][0]
        self.errors.append(relative_error(self.prediction["displacement"][0], exact))
        self.lengths.append(np.linalg.norm(exact))
        self.solver_seconds.append(float(self.batch["solver_seconds"][0]))
        begin = time.perf_counter()
        self.learner.predict(self.batch)
        self.network_seconds.append(time.perf_counter() - begin)


def generate(size: Size, sessions: str, clients: int) -> str:
    """Make the samples and return the session's name."""
    config = EnvironmentConfig(Beam, num_clients=clients, seed=0)
    training = DataGeneration(
        config,
        session_dir=sessions,
        session_name="beam",
        batch_nb=size.samples // 20,
        batch_size=20,
    )
    begin = time.perf_counter()
    training.execute()
    duration = time.perf_counter() - begin
    print(
        f"{size.samples} samples by {clients} clients in {duration:.0f} s: "
        f"{size.samples / duration:.1f} samples/s"
    )
    DataGeneration(
        config,
        session_dir=sessions,
        session_name=training.session.name,
        new_session=False,
        batch_nb=size.validation_samples // 20,
        batch_size=20,
        mode="validation",
    ).execute()
    return training.session.name


def networks(size: Size) -> dict[str, tuple[NetworkConfig, int]]:
    """Return the networks to train, and for how many epochs."""
    learning = {"loss": "MSELoss", "optimizer": "Adam", "lr": 2e-3}
    layers = [VALUES, 256, 256, VALUES]
    fc = NetworkConfig(
        "torch/fc",
        network_name="fc",
        network_kwargs={**FIELDS, "layers": layers, "activation": "SiLU"},
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": size.fc_epochs},
        **learning,
    )
    unet = NetworkConfig(
        "torch/unet",
        network_name="unet",
        network_kwargs={
            **FIELDS,
            "nb_dims": 3,
            "nb_input_channels": 3,
            "nb_output_channels": 3,
            "nb_first_layer_channels": 16,
            "nb_steps": 2,
            "border_mode": "same",
            "two_sublayers": False,
            "activation": "SiLU",
            "positions": True,  # the beam is held at one end
        },
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": size.unet_epochs},
        **learning,
    )
    return {"FC": (fc, size.fc_epochs), "UNet": (unet, size.unet_epochs)}


def train(name: str, network: NetworkConfig, epochs: int, sessions: str, session: str) -> None:
    """Train one network in the session of the samples."""
    training = Training(
        network,
        DatasetConfig(normalize=True),
        session_dir=sessions,
        session_name=session,
        new_session=False,
        epoch_nb=epochs,
        batch_size=16,
        seed=0,
    )
    begin = time.perf_counter()
    with training:
        training.execute()
        parameters = training.learner.network.nb_parameters()
    print(
        f"{name}: {parameters} parameters, {epochs} epochs in {time.perf_counter() - begin:.0f} s, "
        f"validation loss {training.validation_loss:.1e}"
    )


def compare(network: NetworkConfig, steps: int, sessions: str, session: str) -> Comparison:
    """Let one network predict under forces that it has never seen."""
    recording = Path(sessions) / session / f"{network.network_name}.rrd"
    config = EnvironmentConfig(
        Beam,
        as_tcp_ip_client=False,
        visualizer="rerun",
        visualizer_kwargs={"path": str(recording)},
        seed=1,
    )
    comparison = Comparison(
        NetworkConfig(network_name=network.network_name),
        config,
        session_dir=sessions,
        session_name=session,
        step_nb=steps,
    )
    comparison.execute()
    return comparison


def print_table(results: dict[str, Comparison]) -> None:
    """Print errors and times."""
    print("\nUnder unseen forces: mean relative displacement error, and median times")
    print(f"{'':8}{'error':>10}{'worst':>10}{'solver':>12}{'network':>12}{'speed-up':>10}")
    for name, result in results.items():
        solver, network = np.median(result.solver_seconds), np.median(result.network_seconds)
        times = f"{1e3 * solver:>9.1f} ms{1e3 * network:>9.2f} ms{solver / network:>9.0f}x"
        errors = f"{np.mean(result.errors):>10.2%}{np.max(result.errors):>10.2%}"
        print(f"{name:8}{errors}{times}")


def draw(recording: Path, picture: Path, step: int) -> None:
    """Draw the recording without a screen, or say what is missing for it."""
    try:
        render_picture(recording, picture, at=step)
        print(f"picture:   {picture}")
    except PhysxError as error:
        print(f"picture:   not drawn. {error}")


def main() -> int:
    """Do the job; the exit status says whether the better network is good enough."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="less than a minute")
    parser.add_argument("--clients", type=int, default=2, help="processes that solve")
    parser.add_argument("--session-dir", default="sessions", help="folder of the sessions")
    options = parser.parse_args()
    torch.set_num_threads(1)  # enough for networks of this size, and no waiting on a busy machine
    begin = time.perf_counter()
    size = SMALL if options.small else FULL
    session = generate(size, options.session_dir, options.clients)
    results = {}
    for name, (network, epochs) in networks(size).items():
        train(name, network, epochs, options.session_dir, session)
        results[name] = compare(network, size.steps, options.session_dir, session)
    print_table(results)
    best = min(results, key=lambda name: np.mean(results[name].errors))
    folder = Path(options.session_dir) / session
    recording = folder / f"{best.lower()}.rrd"
    print(f"\nsession:   {folder}\nrecording: {recording}  (physx view {recording}, or rerun)")
    draw(recording, folder / "beam.png", int(np.argmax(results[best].lengths)) + 1)
    print(f"All of it took {time.perf_counter() - begin:.0f} s.")
    error = float(np.mean(results[best].errors))
    if error > size.greatest_error:
        print(f"The better network is {error:.1%} off, more than {size.greatest_error:.0%}.")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
