"""Networks that know the structure of their data, against a fully connected one of equal size.

* The Fourier neural operator of `neuraloperator` learns the heat equation on a ring.
* A graph network made of layers of `torch-geometric` learns it on an irregular mesh.
* The UNet of physx_torch makes blurred pictures sharp.

The first two are plain PyTorch modules that know nothing of physx: they are named in the
configuration as "package.module:Class", with their arguments. Prints for each problem a table:
parameters, seconds of training, and the mean relative error with samples never seen.

Needs neuraloperator and torch-geometric (requirements.txt) for the problems ring and plate.

    python examples/operators/run.py                   # some minutes on 2 cores
    python examples/operators/run.py --small ring       # one problem, to see that it works
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass

import numpy as np
import torch
from environments import PIXELS, PLATE, POINTS, Picture, Plate, Ring

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)


@dataclass(frozen=True)
class Problem:
    """What is learned, and the network that is made for it."""

    title: str
    environment: type
    fields: tuple[str, str]
    values: tuple[int, int]
    name: str
    network: str
    network_kwargs: dict
    epochs: int


PROBLEMS = {
    "ring": Problem(
        "Heat equation on a ring: temperature and conductivity -> temperature later",
        Ring,
        ("before", "after"),
        (2 * POINTS, POINTS),
        "Fourier neural operator",
        "neuralop.models:FNO",
        {
            "n_modes": [24],
            "in_channels": 2,
            "out_channels": 1,
            "hidden_channels": 24,
            "n_layers": 3,
        },
        epochs=40,
    ),
    "plate": Problem(
        "Heat equation on a mesh of triangles: temperature and conductivity -> temperature later",
        Plate,
        ("before", "after"),
        (2 * PLATE**2, PLATE**2),
        "graph network",
        "graph:GraphNetwork",
        {"channels": 32, "layers": 4},
        epochs=25,
    ),
    "picture": Problem(
        "Pictures of discs: blurred -> sharp",
        Picture,
        ("blurred", "sharp"),
        (PIXELS**2, PIXELS**2),
        "UNet",
        "torch/unet",
        {
            "nb_dims": 2,
            "nb_input_channels": 1,
            "nb_output_channels": 1,
            "nb_first_layer_channels": 16,
            "nb_steps": 2,
            "border_mode": "same",
        },
        epochs=12,
    ),
}


def fully_connected(problem: Problem, parameters: int) -> dict:
    """Return the arguments of the FC with two hidden layers that has about as many parameters."""
    inputs, outputs = problem.values
    linear = inputs + outputs + 2
    width = (math.sqrt(linear**2 + 4 * (parameters - outputs)) - linear) / 2
    return {"layers": [inputs, round(width), round(width), outputs], "activation": "SiLU"}


def generate(problem: Problem, samples: int, sessions: str) -> str:
    """Make samples to learn from and a fifth as many to test with; return the session's name."""
    session, new = problem.environment.__name__.lower(), True
    for mode, count in (("training", samples), ("validation", samples // 5)):
        generation = DataGeneration(
            EnvironmentConfig(problem.environment, as_tcp_ip_client=False, seed=0),
            session_dir=sessions,
            session_name=session,
            new_session=new,
            batch_nb=1,
            batch_size=count,
            mode=mode,
        )
        generation.execute()
        session, new = generation.session.name, False
    return session


def learn(
    problem: Problem, network: str, network_kwargs: dict, epochs: int, sessions: str, session: str
) -> tuple[int, float, float]:
    """Train a network; return its parameters, the seconds it took, and its error when tested."""
    net_field, opt_field = problem.fields
    config = NetworkConfig(
        network,
        network_kwargs={**network_kwargs, "net_fields": net_field, "opt_fields": opt_field},
        loss="MSELoss",
        optimizer="Adam",
        lr=2e-3,
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": epochs},
    )
    training = Training(
        config,
        DatasetConfig(normalize=True),
        session_dir=sessions,
        session_name=session,
        new_session=False,
        epoch_nb=epochs,
        batch_size=32,
        validation_every=0,
        seed=0,
    )
    with training:
        begin = time.perf_counter()
        training.execute()
        seconds = time.perf_counter() - begin
        stored = training.data.dataset["validation"]
        tested, exact = {net_field: stored[net_field][:]}, stored[opt_field][:]
        guess = training.learner.predict_in_training(tested)[opt_field]
        return training.learner.network.nb_parameters(), seconds, relative_error(guess, exact)


def relative_error(guess: np.ndarray, exact: np.ndarray) -> float:
    """Return the mean over the samples of the error's norm by the norm of what is right."""
    axes = tuple(range(1, exact.ndim))
    return float(np.mean(norm(guess - exact, axes) / norm(exact, axes)))


def norm(values: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Return the Euclidean norm of each sample."""
    return np.sqrt((values.astype(float) ** 2).sum(axis=axes))


def solve(problem: Problem, samples: int, epochs: int, sessions: str) -> float:
    """Print the problem's table and return how many times smaller the error is than FC's."""
    session = generate(problem, samples, sessions)
    place = epochs, sessions, session
    own = learn(problem, problem.network, problem.network_kwargs, *place)
    same_size = learn(problem, "torch/fc", fully_connected(problem, own[0]), *place)
    print(f"\n{problem.title}\n{samples} samples, {epochs} epochs")
    print(f"{'':26}{'parameters':>12}{'seconds':>10}{'error':>10}")
    for name, (parameters, seconds, error) in ((problem.name, own), ("FC", same_size)):
        print(f"{name:26}{parameters:>12}{seconds:>10.1f}{error:>10.2%}")
    with Dataset.open(f"{sessions}/{session}") as dataset:
        given, wanted = (dataset["validation"][name][:] for name in problem.fields)
    if given.shape == wanted.shape:
        print(f"{'left as it is':48}{relative_error(given, wanted):>10.2%}")
    return same_size[2] / own[2]


def main() -> int:
    """Solve the problems; the exit status says whether each special network beats FC."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problems", nargs="*", default=list(PROBLEMS), help=", ".join(PROBLEMS))
    parser.add_argument("--small", action="store_true", help="some seconds instead of minutes")
    parser.add_argument("--session-dir", default="sessions", help="folder of the sessions")
    options = parser.parse_args()
    torch.set_num_threads(1)  # enough for networks of this size, and no waiting on a busy machine
    gains = {}
    for name in options.problems:
        problem = PROBLEMS[name]
        samples, epochs = (200, 3) if options.small else (2000, problem.epochs)
        gains[name] = solve(problem, samples, epochs, options.session_dir)
    print("\nError of FC by that of the special network:", end=" ")
    print(", ".join(f"{name} {gain:.1f}" for name, gain in gains.items()))
    return 0 if options.small or min(gains.values()) > 1 else 1


if __name__ == "__main__":
    raise SystemExit(main())
