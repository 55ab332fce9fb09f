"""Domain randomization: properties of the world that episodes draw from ranges."""

from __future__ import annotations

from physx_gym.tasks.randomizations.devices import RandomDelays, RandomGains, RandomNoise
from physx_gym.tasks.randomizations.randomization import Randomization
from physx_gym.tasks.randomizations.worlds import RandomFriction, RandomMasses, RandomPushes

__all__ = [
    "RandomDelays",
    "RandomFriction",
    "RandomGains",
    "RandomMasses",
    "RandomNoise",
    "RandomPushes",
    "Randomization",
]
