"""What the examples share: their options, samples to learn from, and networks that learned them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)

SEEDS = (0, 1, 2)


def options(doc: str) -> argparse.ArgumentParser:
    """Return the options that all examples have; more can be added."""
    parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="some seconds, to see that it works")
    parser.add_argument("--session-dir", type=Path, default=Path("sessions"))
    parser.add_argument("--picture", type=Path, help="where to draw the picture")
    torch.set_num_threads(1)  # enough for small networks, and no waiting on a busy machine
    return parser


def generate(environment: type, samples: int, folder: Path, **config: Any) -> Path:
    """Make samples to learn from, and a fifth as many to test with; return the session's path."""
    options = {"session_name": environment.__name__.lower(), "session_dir": str(folder)}
    for mode, rows in (("training", samples), ("validation", samples // 5)):
        made = EnvironmentConfig(environment, seed=0, **config)
        generation = DataGeneration(made, mode=mode, batch_nb=1, batch_size=rows, **options)
        generation.execute()
        path = Path(generation.session.path)
        options |= {"session_name": path.name, "new_session": False}
    return path


def samples(session: Path, mode: str, *fields: str) -> list[np.ndarray]:
    """Return the stored rows of fields, shape (rows, ...) each."""
    with Dataset.open(session) as dataset:
        return [dataset[mode][field][:] for field in fields]


def config(
    network: str | type, given: str, wanted: str, epochs: int, lr: float, **arguments: Any
) -> NetworkConfig:
    """Return what trains a network by Adam, its learning rate falling to 0 in so many epochs."""
    return NetworkConfig(
        network,
        network_kwargs={**arguments, "net_fields": given, "opt_fields": wanted},
        loss="MSELoss",
        optimizer="Adam",
        lr=lr,
        scheduler="CosineAnnealingLR",
        scheduler_kwargs={"T_max": epochs},
    )


def trained(
    session: Path, network: NetworkConfig, epochs: int, seed: int, **options: Any
) -> Training:
    """Train a network with a session's samples; return what trained it, its `learner` ready."""
    training = Training(
        network,
        DatasetConfig(existing_dir=str(session), normalize=True),
        session_dir=str(session / "networks"),
        epoch_nb=epochs,
        validation_every=0,
        seed=seed,
        quiet=True,
        **{"batch_size": 32, **options},
    )
    with training:
        training.execute()
    return training


def learned(
    session: Path, network: NetworkConfig, given: str, epochs: int, seed: int, **options: Any
) -> np.ndarray:
    """Train a network with a session's samples; return its predictions for those of validation."""
    learner = trained(session, network, epochs, seed, **options).learner
    (tested,) = samples(session, "validation", given)
    (guess,) = learner.predict_in_training({given: tested}).values()
    return guess
