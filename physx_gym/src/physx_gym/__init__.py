"""Robots as Gymnasium environments, on any engine.

Public names are imported on first use. Importing the package registers its environments with
Gymnasium (``physx/Cartpole-v0`` and others) and limits how long OpenMP threads spin, so that a
policy's network leaves the processors to the environments. Import the package before the network's
library.
"""

from __future__ import annotations

import lazy_loader

from physx_core import limit_openmp_spin
from physx_gym.registration import register

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register()
limit_openmp_spin()
