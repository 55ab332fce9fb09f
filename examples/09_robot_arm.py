"""A robot arm that learns its own dynamics.

Two clients move a Franka Panda at random and store 40 000 samples (q, v, a) -> torque. A network
learns them, and its torque assists a weak joint controller (PD) along trajectories that it has
never seen. Its rivals use no network, or a narrower one; the exact model is the reference.

    python examples/09_robot_arm.py             # a few minutes on 2 cores
    python examples/09_robot_arm.py --small     # a few seconds, to see that it works
    python examples/09_robot_arm.py --picture arm.webp     # a film; arm.png: a picture
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import SEEDS, conclude, config, generate, linear_map, options, samples, trained
from environments.arm import (
    SHOWN,
    TRAJECTORIES,
    ComparedArm,
    Torque,
    draw,
    predicted,
    tracking_error,
)

from physx_core import Comparison, EnvironmentConfig, NetworkConfig, Prediction
from physx_dart import DartArm

ALONE, NETWORK, EXACT = "PD alone", "PD + network, width 256", "PD + exact model"


def show(session: Path, name: str, steps: int) -> Path:
    """Run three arms along a trajectory, one with a trained network; return the recording."""
    recording, nets = session / "tracking.rrd", str(session / "networks")
    arms = EnvironmentConfig(
        ComparedArm,
        env_kwargs={"trajectory": TRAJECTORIES[0]},
        num_clients=len(SHOWN),
        visualizer="rerun",
        visualizer_kwargs={"path": str(recording), "every": 4},
    )
    Prediction(NetworkConfig(), arms, session_dir=nets, session_name=name, step_nb=steps).execute()
    return recording


def main() -> int:
    """Compare the controllers; the exit status tells whether the network beats its best rival."""
    chosen = options(__doc__).parse_args()
    rows, epochs, steps, seeds = (4000, 8, 100, 1) if chosen.small else (40_000, 30, 800, 3)
    session = generate(DartArm, rows, chosen.session_dir, num_clients=2)
    errors: dict[str, list[float]] = {}

    def follow(name: str, torque: Torque) -> None:
        found = [tracking_error(torque, trajectory, steps) for trajectory in TRAJECTORIES]
        print(f"{name:28}" + "".join(f"{error:10.3f}" for error in found), flush=True)
        errors.setdefault(name, []).append(float(np.mean(found)))

    print("error in mrad, on trajectory" + "".join(f"{number:10}" for number in TRAJECTORIES))
    follow(ALONE, "none")
    follow("PD + linear map", linear_map(*samples(session, "training", "state", "torque")))
    follow("PD + exact gravity", "gravity")
    for width in (64, 128, 256):
        sizes = {"layers": [27, width, width, width, 9], "activation": "SiLU"}
        network = config("torch/fc", "state", "torque", epochs, 2e-3, **sizes)
        for seed in SEEDS[:seeds]:
            training = trained(session, network, epochs, seed, batch_size=256)
            follow(f"PD + network, width {width}", predicted(training.learner))
    follow(EXACT, "model")
    draw(show(session, training.session.name, steps), chosen.picture, steps)
    networks = [name for name in errors if "network" in name]
    comparison = Comparison(errors, NETWORK, "error in mrad", networks, references=[EXACT])
    return conclude(comparison, small=chosen.small)


if __name__ == "__main__":
    raise SystemExit(main())
