"""How much of a test runs: few cases as a rule, less with --quick, all if it is asked for."""

from __future__ import annotations

import os


def is_quick():
    """Return whether pytest runs with --quick."""
    return "PHYSX_TEST_QUICK" in os.environ


def campaign():
    """Return `full`, or the number that decides what samples hold: by default, that of the day."""
    return os.environ["PHYSX_CAMPAIGN"]


def size(full, quick):
    """Return how many examples, steps or rows a test has."""
    return quick if is_quick() else full


def trials(full, few):
    """Return how many trials a test makes: all only in a full campaign."""
    return full if campaign() == "full" else few


def seed():
    """Return the seed of random trials, the same in a full campaign, another one each day."""
    return 0 if campaign() == "full" else int(campaign())


def share(cases, parts):
    """Return one of so many parts of a list, another one each day, or the list itself."""
    return cases if campaign() == "full" or parts < 2 else cases[seed() % parts :: parts]
