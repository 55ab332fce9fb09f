"""``physx agree``: compare engines on a task: how far they agree, and why they differ."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from physx_agree import agree, store_agreement
from physx_core.cli import options_from, show
from physx_core.errors import ConfigError


@dataclass
class Agree:
    """Run a task with the same seeds and policies on several engines, and say why they differ."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Id of the environment, "module:id", "module:Class", or "script.py:function"."""
    engines: tuple[str, ...] = ("dart", "pinocchio", "mujoco")
    """Engines; the others are compared with the first."""
    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Session or checkpoint of a policy's network; several times: is their ranking the same? By
    default, actions are drawn at random."""
    episodes: int = 10
    """Number of episodes of each policy on each engine."""
    seed: int = 10_000
    """Seed of the first episode; each further episode adds 1."""
    metric: str = "return"
    """What is compared: return, length, or a name of the information of steps."""
    steps: int = 1000
    """Number of physics steps of the first episode that are repeated on all engines."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Further options of the environment."""
    json: bool = False
    """Print JSON instead of text."""
    output: str | None = None
    """Folder that keeps the result, for physx report."""
    trust: bool = False
    """Import whatever the checkpoints name, not only components of installed plugins."""


def run(words: Sequence[str]) -> None:
    """Print the agreement, and store it if requested."""
    options = options_from(Agree, words, "agree")
    if options.episodes < 1:
        raise ConfigError(f"--episodes is {options.episodes} but must be at least 1.")
    begin = time.monotonic()
    found = agree(
        options.task,
        options.engines,
        options.policy,
        seeds=range(options.seed, options.seed + options.episodes),
        metric=options.metric,
        steps=options.steps,
        env_kwargs=options.env_kwargs,
        trust=options.trust,
    )
    show(found, as_json=options.json)
    if options.output is not None:
        store_agreement(options.output, found, time.monotonic() - begin)
        if not options.json:
            show(f"\nresult: {options.output}; physx report {options.output} makes a page of it")
