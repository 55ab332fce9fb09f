"""Shared code of the examples: options, training samples, and trained networks."""

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
    """Return a parser with the options of all examples; an example can add more."""
    parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="a quick run of some seconds")
    parser.add_argument("--session-dir", type=Path, default=Path("sessions"))
    parser.add_argument("--picture", type=Path, help="where to draw the picture")
    torch.set_num_threads(1)  # enough for small networks; avoids waits on a busy machine
    return parser


def generate(environment: type, samples: int, folder: Path, **config: Any) -> Path:
    """Generate training samples, and a fifth as many for validation; return the session's path."""
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
    """Return a network's configuration: Adam, its learning rate falling to 0 over `epochs`."""
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
    """Train a network on a session's samples; return the training, with its `learner` ready."""
    training = Training(
        network,
        DatasetConfig(existing_dir=str(session), normalize=True),
        session_dir=str(session / "networks"),
        epoch_nb=epochs,
        validation_every=0,
        rivals="none",
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
    """Train a network on a session's samples; return its predictions for the validation samples."""
    learner = trained(session, network, epochs, seed, **options).learner
    (tested,) = samples(session, "validation", given)
    (guess,) = learner.predict_in_training({given: tested}).values()
    return guess
