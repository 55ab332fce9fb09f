"""Evaluation: how ``physx evaluate`` says how good a network is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Evaluation:
    """How networks of a kind are evaluated; plugins offer theirs with ``physx_evaluations``.

    The core evaluates a network of no other kind: see `physx_core.evaluate`.

    Attributes:
        applies: Whether a network is of this kind, by the names of its inputs and targets.
        run: Does what the command line says: the words after ``physx evaluate``.
    """

    applies: Callable[[Sequence[str]], bool]
    run: Callable[[Sequence[str]], None]
