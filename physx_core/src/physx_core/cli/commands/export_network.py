"""``physx export-network``: export a session's network to a file that runs without physx."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.cli.options import options_from
from physx_core.cli.output import show
from physx_core.config import NetworkConfig
from physx_core.pipelines.learning.loading import load_learner


@dataclass
class ExportNetwork:
    """Write a session's network, with its normalization, as one file for other programs.

    Inputs and outputs are in physical units, for any number of samples.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SESSION")]
    """The session's folder, or a checkpoint's folder."""
    to: str
    """Format of the file: "onnx", "torchscript" or "pt2" for PyTorch networks."""
    output: str | None = None
    """The file; by default in the session's folder, named after the checkpoint."""
    network_name: str | None = None
    """Name of the checkpoints in the session, if there are several."""
    which_network: int = -1
    """Number of the checkpoint; -1: the last."""
    network: Annotated[str | None, tyro.conf.arg(name="network.network")] = None
    """The network's reference, if it is not a component of an installed plugin."""
    trust: bool = False
    """Import whatever code the checkpoint names."""


def run(words: Sequence[str]) -> None:
    """Export a network and print its fields and the file."""
    options = options_from(ExportNetwork, words, "export-network")
    place = Path(options.directory)
    path = checkpoint.find(place, options.network_name, options.which_network).path
    config = NetworkConfig(options.network, device="cpu")
    learner = load_learner(path, config, trust=options.trust)
    file = Path(options.output) if options.output else place / f"{path.name}.{options.to}"
    learner.export(file, options.to)
    network = learner.network
    show(f"{', '.join(network.net_fields)} -> {', '.join(network.pred_fields)}: {file}")
