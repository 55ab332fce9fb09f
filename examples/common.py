"""Shared code of the examples: options, training samples, and trained networks."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physx_core import (
    Comparison,
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Result,
    Training,
)

SEEDS = (0, 1, 2)
TOO_SMALL = "Too small to judge: this run only shows that it works. Without --small it compares."


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
    network: str | type,
    given: str | Sequence[str],
    wanted: str,
    epochs: int,
    lr: float,
    options: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> NetworkConfig:
    """Return a network's configuration: Adam, its learning rate falling to 0 over `epochs`."""
    known = {
        "network_kwargs": {**arguments, "net_fields": given, "opt_fields": wanted},
        "loss": "MSELoss",
        "optimizer": "Adam",
        "lr": lr,
        "scheduler": "CosineAnnealingLR",
        "scheduler_kwargs": {"T_max": epochs},
    }
    return NetworkConfig(network, **known | dict(options or {}))


def trained(
    session: Path,
    network: NetworkConfig,
    epochs: int,
    seed: int,
    normalize: bool = True,
    **options: Any,
) -> Training:
    """Train a network on a session's samples; return the training, with its `learner` ready."""
    training = Training(
        network,
        DatasetConfig(existing_dir=str(session), normalize=normalize),
        session_dir=str(session / "networks"),
        epoch_nb=epochs,
        validation_every=0,
        seed=seed,
        quiet=True,
        **{"batch_size": 32, "rivals": [], **options},
    )
    with training:
        training.execute()
    return training


def compared(
    session: Path,
    networks: Mapping[str, tuple[NetworkConfig, int]],
    given: str | Sequence[str],
    rivals: Sequence[str | Callable[..., Any]] = ("all",),
    **options: Any,
) -> tuple[dict[str, list[Result]], dict[str, list[np.ndarray]]]:
    """Train networks on a session's samples with each of `SEEDS`.

    Args:
        session: The session's folder.
        networks: Configuration and number of epochs of each network, by name.
        given: The network's inputs.
        rivals: See `Training.rivals`; they are the same for all networks.
        options: Further options of trainings.

    Returns:
        The result and the predictions for the validation samples of each seed, by the network's
        name.
    """
    names, results, guesses = [given] if isinstance(given, str) else list(given), {}, {}
    tested = dict(zip(names, samples(session, "validation", *names), strict=True))
    for name, (network, epochs) in networks.items():
        tried = []
        for seed in SEEDS:
            own = {"rivals": [] if results or tried else rivals, **options}
            training = trained(session, network, epochs, seed, session_name=f"{name} {seed}", **own)
            tried.append(training.result)
            guesses.setdefault(name, []).extend(
                training.learner.predict_in_training(tested).values()
            )
        results[name] = tried
    return results, guesses


def conclude(comparison: Comparison, *, small: bool) -> int:
    """Print a comparison; return 0 if the network wins, or the run is too small to judge."""
    print(f"\n{comparison.table}\n\n{TOO_SMALL}" if small else f"\n{comparison}")
    return int(not (small or comparison.wins))


def linear_map(inputs: np.ndarray, outputs: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Fit a linear map by least squares, from samples of shape (rows, ...) each."""
    best = np.linalg.lstsq(_columns(inputs), outputs.reshape(len(outputs), -1), rcond=None)[0]
    return lambda given: (_columns(given) @ best).reshape(-1, *outputs.shape[1:])


def _columns(values: np.ndarray) -> np.ndarray:
    return np.column_stack([values.reshape(len(values), -1), np.ones(len(values))])
