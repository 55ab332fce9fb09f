"""``physx compact``: free the disk space of failed, lost and unfinished episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli.options import options_from
from physx_core.cli.output import show
from physx_core.dataset import Dataset


@dataclass
class Compact:
    """Remove the rows of failed, lost and unfinished episodes, and put the others in order.

    What a dataset contains does not change. Rows that belong to no episode are left alone.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder; nothing else may write to it."""
    mode: str | None = None
    """Compact only this mode."""


def run(words: Sequence[str]) -> None:
    """Compact a dataset, and print how much disk space that freed."""
    options = options_from(Compact, words, "compact")
    with Dataset.open(options.directory, writable=True) as dataset:
        freed = dataset.compact(options.mode)
    more = "in order now; the files take more space:"
    size = f"{abs(freed) / 1e6:.1f} MB"
    show(f"{'freed' if freed > 0 else more} {size}" if freed else "there was nothing to free")
