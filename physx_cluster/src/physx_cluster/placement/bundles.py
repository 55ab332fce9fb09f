"""Bundles: what each client needs of the nodes that Ray has."""

from __future__ import annotations

import math
from collections.abc import Sequence

Bundle = dict[str, float]
"""Name of a resource to how much of it a client needs, or a node has."""

_STEPS = 10_000  # Ray counts ten-thousandths of a resource


def share_of_processors(nodes: Sequence[Bundle], clients: int) -> float:
    """Return how many processors each client gets: one, or less if there are not as many.

    Args:
        nodes: What each node has.
        clients: How many clients share it.
    """
    total = sum(math.floor(node.get("CPU", 0.0)) for node in nodes)
    if total >= clients or not total:
        return 1.0
    return math.floor(_STEPS / math.ceil(clients / total)) / _STEPS


def find_misfit(nodes: Sequence[Bundle], bundle: Bundle) -> str:
    """Return what no node has enough of for one client, in words; empty if one has all of it.

    Args:
        nodes: What each node has.
        bundle: What a client needs.
    """
    if any(all(node.get(name, 0.0) >= need for name, need in bundle.items()) for node in nodes):
        return ""
    most = {name: max((node.get(name, 0.0) for node in nodes), default=0.0) for name in bundle}
    return (
        f"a client needs {describe(bundle)} of one node, and the nodes have up to {describe(most)}"
    )


def describe(bundle: Bundle) -> str:
    """Return a bundle in words: "1 CPU and 2 GPU"."""
    return " and ".join(f"{amount:g} {name}" for name, amount in bundle.items())
