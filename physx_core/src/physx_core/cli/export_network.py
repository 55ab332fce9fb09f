"""``physx export-network``: export a session's network to a file that runs without physx."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.config import NetworkConfig
from physx_core.pipelines.learner import restored


@dataclass
class ExportNetwork:
    """Write a session's network, with its normalization, as one file for other programs.

    It reads and gives fields in physical units, for any number of samples.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SESSION")]
    """The session's folder, or that of a checkpoint."""
    to: str
    """Form of the file: "onnx", "torchscript" or "pt2" for networks of PyTorch."""
    output: str | None = None
    """The file; by default it lies in the session's folder, with the checkpoint's name."""
    network_name: str = "network"
    """Name of the checkpoints in the session."""
    which_network: int = -1
    """Number of the checkpoint; -1: the last."""


def run(words: Sequence[str]) -> None:
    """Export as the words say and print what was written.

    Raises:
        CheckpointError: There is no such checkpoint.
        ConfigError: The network cannot be written in this form.
        MissingLibraryError: A library that the form needs is not installed.
    """
    options = tyro.cli(ExportNetwork, args=words, prog="physx export-network")
    place = Path(options.directory)
    path = checkpoint.find(place, options.network_name, options.which_network)
    learner = restored(NetworkConfig(device="cpu"), path)
    file = Path(options.output) if options.output else place / f"{path.name}.{options.to}"
    learner.export(file, options.to)
    network = learner.network
    print(f"{', '.join(network.net_fields)} -> {', '.join(network.pred_fields)}: {file}")
