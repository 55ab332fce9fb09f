"""``physx report``: write what a run found to one HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli import options_from
from physx_report import show


@dataclass
class Report:
    """Write what a run found to one HTML page.

    It says how good the network is and compared with what, where it is good and where it is bad,
    what was simulated, and how to repeat the run.
    """

    session: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SESSION")]
    """The session's folder."""
    output: str | None = None
    """The page; by default report.html in the session's folder."""
    trust: bool = False
    """Import whatever code the session's files name."""


def run(words: Sequence[str]) -> None:
    """Write the page and print its name, or show it in a notebook."""
    options = options_from(Report, words, "report")
    show(options.session, options.output, trust=options.trust)
