"""Checkpoint: a folder with a network's parameters and everything needed to use them.

``checkpoint.toml`` names the network, its transformation, its fields, and their normalization; the
network's library writes the parameters next to it. It contains no code. It lists the size and
CRC-32 of each file in the folder and ends with a CRC-32 of everything before that, so a file that
was truncated, damaged, or edited by hand is detected before it is used.

A training's checkpoints are numbered in the order of writing; the training can be resumed from the
last one. ``<name>_best``, in the same folder, is the network of the epoch with the smallest loss. A
checkpoint gets its name when everything in it is on the disk. The best one is moved aside for its
successor, which cannot replace it in one step; in between, and after a crash at that point, the one
moved aside is read.
"""

from __future__ import annotations

from physx_core.checkpoint.description import (
    BEST,
    BUFFER,
    DESCRIPTION,
    FORMAT_VERSION,
    NAME,
    SAMPLER,
    STREAMS,
    Checkpoint,
    Progress,
)
from physx_core.checkpoint.reading import (
    check_unchanged,
    find,
    has_streams,
    is_one,
    list_all,
    list_numbers,
    list_within_epochs,
    read,
    read_buffer,
    read_sampler,
    read_streams,
)
from physx_core.checkpoint.writing import check_session, dry_run_save, remove, save

__all__ = [
    "BEST",
    "BUFFER",
    "DESCRIPTION",
    "FORMAT_VERSION",
    "NAME",
    "SAMPLER",
    "STREAMS",
    "Checkpoint",
    "Progress",
    "check_session",
    "check_unchanged",
    "dry_run_save",
    "find",
    "has_streams",
    "is_one",
    "list_all",
    "list_numbers",
    "list_within_epochs",
    "read",
    "read_buffer",
    "read_sampler",
    "read_streams",
    "remove",
    "save",
]
