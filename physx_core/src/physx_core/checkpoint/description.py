"""Parts of a checkpoint, and the names of its files and folders."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.fields import Field
from physx_core.normalization import Normalization

FORMAT_VERSION = 3
"""Version of the description; earlier ones have the normalization as text, and are refused."""
NAME = "network"
"""Name of the checkpoints unless another one is given."""
BEST = "best"
DESCRIPTION = "checkpoint.toml"
BUFFER = "buffer.bin"
"""File with the state of the buffer that draws the batches: 8-byte integers."""
WHOLE = np.dtype("<i8")
NORMALIZATION = "normalization.safetensors"
"""File with the normalization, if any: arrays named ``<field>/<statistic>``."""
SAMPLER = "sampler.bin"
"""File with the state of the sampler that learns from the training: 8-byte floats."""
REAL = np.dtype("<f8")
STREAMS = "streams.bin"
"""File with what streams of environments need to go on from states."""
LARGEST_STREAMS = 2**32
KEPT = (
    "network",
    "network_kwargs",
    "transformation",
    "transformation_kwargs",
    "data_type",
)
LARGEST = 2**28
END = '\n[checksum]\ncrc32 = "{:08x}"\n'
NUMBER = "(0|[1-9][0-9]*)"
ADVICE = "Restore it from a backup, or use another checkpoint."


@dataclass(frozen=True)
class Progress:
    """Progress of a training when its checkpoint was written.

    Attributes:
        epoch: Number of finished epochs.
        batch: Number of finished batches of the next epoch.
        batches_read: Number of batches of the dataset that were learned from, in all epochs.
        seed: Seed of the training.
        blocks: Number of batches whose rows environments generated.
        best: State of `BestEpoch`.
        record: State of `TrainingRecord`.
        snapshots: The stored samples that it learns from: see `Batches.snapshot`, by mode.
        last_batch: The last batch of stored samples that it learned from: its ``number``, the
            names of its ``fields``, and their ``digest``; empty if there is none.
        options: Options that a resumed training must have, as returned by `bound_options`; empty
            if an older physx wrote the checkpoint.
        data: The data that the network was trained on, as returned by `record_data`; likewise.
    """

    epoch: int
    batch: int
    batches_read: int
    seed: int
    blocks: int = 0
    best: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    snapshots: dict[str, Any] = field(default_factory=dict)
    last_batch: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Checkpoint:
    """Description of a checkpoint.

    Attributes:
        path: The checkpoint's folder.
        network: References and arguments of network and transformation, as in `NetworkConfig`.
        fields: The network's input and target fields by name.
        normalization: Their normalization by name; empty if nothing was normalized.
        progress: Progress of the training.
        crc: CRC-32 of the description.
        notice: Which later checkpoints it replaces, and why; empty if it is the requested one.
    """

    path: Path
    network: dict[str, Any]
    fields: dict[str, Field]
    normalization: dict[str, Normalization]
    progress: Progress
    crc: int
    notice: str = ""


class UnreadableError(Exception):
    """A checkpoint cannot be read, for the given reason: a sentence without its final period."""

    def __init__(self, reason: str, advice: str = ADVICE) -> None:
        super().__init__(reason)
        self.advice = advice


def partial_path(path: Path) -> Path:
    """Return the folder of a checkpoint while it is being written or removed."""
    return path.parent / f".{path.name}.partial"


def former_path(path: Path) -> Path:
    """Return the folder of a checkpoint while another one takes its name."""
    return path.parent / f".{path.name}.former"


def measure(path: Path) -> dict[str, Any]:
    """Return the size and checksum of a file, in the form used by descriptions."""
    nbytes = crc = 0
    for block in files.read_blocks(path):
        nbytes, crc = nbytes + len(block), crc32(block, crc)
    return {"nbytes": nbytes, "crc32": f"{crc:08x}"}
