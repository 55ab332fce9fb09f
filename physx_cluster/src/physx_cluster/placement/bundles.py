"""Bundles: the resources that each client needs from Ray's nodes."""

from __future__ import annotations

import math
from collections.abc import Sequence

Bundle = dict[str, float]
"""Name of a resource to the amount that a client needs or a node has."""

_STEPS = 10_000  # Ray counts ten-thousandths of a resource


def share_of_processors(nodes: Sequence[Bundle], clients: int) -> float:
    """Return the CPUs per client: one, or less if there are fewer CPUs than clients.

    Args:
        nodes: Resources of each node.
        clients: Number of clients that share them.
    """
    total = sum(math.floor(node.get("CPU", 0.0)) for node in nodes)
    if total >= clients or not total:
        return 1.0
    return math.floor(_STEPS / math.ceil(clients / total)) / _STEPS


def find_misfit(nodes: Sequence[Bundle], bundle: Bundle) -> str:
    """Return what no node has enough of for one client; empty if some node has everything.

    Args:
        nodes: Resources of each node.
        bundle: Resources that a client needs.
    """
    if any(all(node.get(name, 0.0) >= need for name, need in bundle.items()) for node in nodes):
        return ""
    most = {name: max((node.get(name, 0.0) for node in nodes), default=0.0) for name in bundle}
    return f"a client needs {describe(bundle)} on one node, and nodes have at most {describe(most)}"


def describe(bundle: Bundle) -> str:
    """Return a bundle in words: "1 CPU and 2 GPU"."""
    return " and ".join(f"{amount:g} {name}" for name, amount in bundle.items())
