"""Tickets: what workers of an elastic run present to run an instance; old ones are refused."""

from __future__ import annotations

_INSTANCES = 1 << 32


def make_ticket(instance_id: int, start: int) -> int:
    """Return the ticket for a start of an instance.

    Args:
        instance_id: Number of the instance, from 1.
        start: Which of its starts this is, from 1.
    """
    return start * _INSTANCES + instance_id


def instance_of(ticket: int) -> int:
    """Return the number of the instance that a ticket is for."""
    return ticket % _INSTANCES


def is_ticket(number: int) -> bool:
    """Return whether a number is a ticket; otherwise it is the number of a client."""
    return number >= _INSTANCES
