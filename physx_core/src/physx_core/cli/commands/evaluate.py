"""``physx evaluate``: evaluate a session's network against baselines, or a policy on episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint, plugins
from physx_core.cli.options import options_from
from physx_core.cli.output import show
from physx_core.components import Evaluation
from physx_core.pipelines import evaluate

_LAST = -1


@dataclass
class Evaluate:
    """Say how good a session's last network is, compared with predictions that need no network.

    If it predicts the same quantity as one of its inputs, its predictions are also fed back from
    the beginning of episodes. A policy has other options: physx evaluate SESSION --help.
    """

    session: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SESSION")]
    """The session's folder."""
    data: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[DATASET]")] = None
    """A dataset from which it did not learn, also of another resolution; by default the samples
    that were held back in the training."""
    mode: str | None = None
    """Mode of that dataset; by default that of the training."""
    steps: int | None = None
    """Largest number of rows to predict; by default to the end of the episodes."""
    invariants: tuple[str, ...] = ()
    """Functions "module:function" or "script.py:function" of what the physics keeps: each gets
    values and parameters by name, and returns a number for each row."""
    json: bool = False
    """Print JSON instead of text."""
    trust: bool = False
    """Import whatever code the checkpoint names, not only components of installed plugins."""


def run(words: Sequence[str]) -> None:
    """Print how good the network is that the first word names."""
    other = _other(Path(words[0])) if words and not words[0].startswith("-") else None
    if other is not None:
        other.run(words)
        return
    options = options_from(Evaluate, words, "evaluate")
    result = evaluate(
        options.session,
        options.data,
        mode=options.mode,
        steps=options.steps,
        invariants=options.invariants,
        trust=options.trust,
    )
    show(result, as_json=options.json)


def _other(session: Path) -> Evaluation | None:
    """Return how a plugin evaluates the network, if it is of a kind that a plugin knows.

    Raises:
        CheckpointError: If there is no network, or it is damaged.
    """
    fields = list(checkpoint.find(session, None, _LAST).fields)
    found = plugins.resolve_all("evaluation").values()
    return next((each for each in found if each.applies(fields)), None)
