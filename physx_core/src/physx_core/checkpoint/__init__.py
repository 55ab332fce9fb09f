"""Checkpoint: a folder with a network's parameters and everything that is needed to use them.

``checkpoint.toml`` names the network, its transformation, its fields and their normalization; the
network's library writes the parameters beside it. Nothing in it is code. It lists the size and the
CRC-32 of each file in the folder and ends with a CRC-32 of everything before that, so that a file
that was cut, damaged or edited by hand is noticed before it is used.

The checkpoints of a training are numbered in the order of writing; it can be resumed from the last.
Beside them is ``<name>_best``, the network of the epoch with the smallest loss. A checkpoint gets
its name when everything in it is on the disk. The best one is moved aside for the next one, which
cannot replace it in one step; in between, and after a crash there, the one moved aside is read.
"""

from __future__ import annotations

from physx_core.checkpoint.description import (
    BEST,
    BUFFER,
    DESCRIPTION,
    FORMAT_VERSION,
    NAME,
    SAMPLER,
    Checkpoint,
    Progress,
)
from physx_core.checkpoint.reading import (
    check_unchanged,
    find,
    list_all,
    list_numbers,
    list_within_epochs,
    read,
    read_buffer,
    read_sampler,
)
from physx_core.checkpoint.writing import check_session, rehearse, remove, save

__all__ = [
    "BEST",
    "BUFFER",
    "DESCRIPTION",
    "FORMAT_VERSION",
    "NAME",
    "SAMPLER",
    "Checkpoint",
    "Progress",
    "check_session",
    "check_unchanged",
    "find",
    "list_all",
    "list_numbers",
    "list_within_epochs",
    "read",
    "read_buffer",
    "read_sampler",
    "rehearse",
    "remove",
    "save",
]
