"""Checks that a physics engine satisfies its contract."""

from physx_sim.conformance.checks import check_backend

__all__ = ["check_backend"]
