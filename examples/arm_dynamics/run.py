"""The main job: learn the inverse dynamics of a robot arm, and let the arm follow with it.

1. Two clients simulate the Franka Panda in DART under random smooth motions; the samples
   (q, v, a) -> torque go into HDF5.
2. A fully connected network learns them.
3. The arm follows trajectories that it has never seen, under a weak joint controller: alone, with
   the network's torque fed forward, and with Pinocchio's exact inverse dynamics in its place.
4. Rerun shows the three arms, each with its translucent reference.

    python examples/arm_dynamics/run.py             # a few minutes on 2 cores
    python examples/arm_dynamics/run.py --small     # some seconds, to see that it works
    python examples/arm_dynamics/run.py --picture docs/arm.png     # the picture of the README
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physx_core import (
    DataGeneration,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    PhysxError,
    Prediction,
    Training,
)
from physx_dart import DartArm
from physx_rerun import render_picture

VARIANTS = {"PD alone": "none", "PD + network": "network", "PD + exact model": "model"}
TRAJECTORIES = (5, 6, 7)


@dataclass(frozen=True)
class Size:
    """How much is done."""

    samples: int
    validation_samples: int
    epochs: int
    tracking_steps: int
    least_gain: float


FULL = Size(40_000, 4_000, 30, 800, least_gain=5.0)
SMALL = Size(4_000, 500, 8, 200, least_gain=1.0)
BATCH = 500


class ComparedArm(DartArm):
    """The arm that tracks; each instance gets another feed-forward."""

    def __init__(self, **kwargs) -> None:
        super().__init__(task="track", **kwargs)
        self.variant, self.feedforward = list(VARIANTS.items())[self.instance_id - 1]

    def init_visualization(self) -> None:
        self.factory.set_view(self.variant)
        super().init_visualization()


class Tracking(Prediction):
    """Keeps the tracking errors of all instances."""

    def prediction_begin(self) -> None:
        super().prediction_begin()
        self.errors = []

    def sample_end(self) -> None:
        super().sample_end()
        self.errors.append(self.batch["tracking_error"].copy())


def generate(size: Size, sessions: str, clients: int) -> str:
    """Make the samples and return the session's name."""
    config = EnvironmentConfig("dart/arm", num_clients=clients, seed=0)
    training = DataGeneration(
        config,
        session_dir=sessions,
        session_name="arm",
        batch_nb=size.samples // BATCH,
        batch_size=BATCH,
    )
    begin = time.perf_counter()
    training.execute()
    duration = time.perf_counter() - begin
    rate = size.samples / duration
    print(f"{size.samples} samples by {clients} clients in {duration:.1f} s: {rate:.0f} samples/s")
    DataGeneration(
        config,
        session_dir=sessions,
        session_name=training.session.name,
        new_session=False,
        batch_nb=size.validation_samples // BATCH,
        batch_size=BATCH,
        mode="validation",
    ).execute()
    return training.session.name


def train(size: Size, sessions: str, session: str) -> None:
    """Train the network in the session of the samples."""
    network = NetworkConfig(
        "torch/fc",
        network_kwargs={
            "layers": [27, 256, 256, 9],
            "net_fields": "state",
            "opt_fields": "torque",
            "activation": "SiLU",
        },
        loss="MSELoss",
        optimizer="Adam",
        lr=2e-3,
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": size.epochs},
    )
    training = Training(
        network,
        DatasetConfig(normalize=True),
        session_dir=sessions,
        session_name=session,
        new_session=False,
        epoch_nb=size.epochs,
        batch_size=256,
        seed=0,
    )
    training.execute()
    print(
        f"{size.epochs} epochs: training loss {training.training_loss:.2e}, "
        f"validation loss {training.validation_loss:.2e}"
    )


def track(size: Size, sessions: str, session: str, trajectory: int, recording: Path) -> np.ndarray:
    """Follow one trajectory with all variants at once and return their mean errors in rad."""
    shown = trajectory == TRAJECTORIES[0]
    config = EnvironmentConfig(
        ComparedArm,
        env_kwargs={"trajectory": trajectory, "draw_every": 4},
        num_clients=len(VARIANTS),
        visualizer="rerun" if shown else None,
        visualizer_kwargs={"path": str(recording)} if shown else {},
        seed=0,
    )
    tracking = Tracking(
        NetworkConfig(),
        config,
        session_dir=sessions,
        session_name=session,
        step_nb=size.tracking_steps,
        record=shown,
    )
    tracking.execute()
    return np.mean(tracking.errors, axis=0)


def print_table(errors: dict[int, np.ndarray]) -> float:
    """Print the mean tracking errors and return the network's least gain over PD alone."""
    print("\nMean tracking error of the seven joints in mrad, and how many times smaller than PD:")
    print("trajectory  " + "".join(f"{name:>22}" for name in VARIANTS))
    for trajectory, row in errors.items():
        cells = [f"{1e3 * row[0]:.3f}"]
        cells += [f"{1e3 * error:.3f} ({row[0] / error:6.1f}x)" for error in row[1:]]
        print(f"{trajectory:<12}" + "".join(f"{cell:>22}" for cell in cells))
    return min(row[0] / row[1] for row in errors.values())


def draw(recording: Path, picture: Path, step: int) -> None:
    """Draw the recording without a screen, or say what is missing for it."""
    try:
        render_picture(recording, picture, at=step)
        print(f"picture:   {picture}")
    except PhysxError as error:
        print(f"picture:   not drawn. {error}")


def main() -> int:
    """Do the job; the exit status says whether the network helped enough."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="some seconds instead of minutes")
    parser.add_argument("--clients", type=int, default=2, help="processes that simulate")
    parser.add_argument("--session-dir", default="sessions", help="folder of the sessions")
    parser.add_argument("--picture", type=Path, help="picture to draw; tracking.png by default")
    options = parser.parse_args()
    size = SMALL if options.small else FULL
    session = generate(size, options.session_dir, options.clients)
    folder = Path(options.session_dir) / session
    train(size, options.session_dir, session)
    recording = folder / "tracking.rrd"
    errors = {
        number: track(size, options.session_dir, session, number, recording)
        for number in TRAJECTORIES
    }
    gain = print_table(errors)
    print(f"\nsession:   {folder}\nrecording: {recording}  (physx view {recording}, or rerun)")
    draw(recording, options.picture or folder / "tracking.png", size.tracking_steps // 2)
    if gain < size.least_gain:
        print(f"The network is only {gain:.1f} times better than PD alone.")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
