"""Base classes of engines for articulated bodies: robot models, algorithms and simulations.

An engine implements `RobotEngine` for one robot or object, `Algorithms` for a world in any state,
and `RobotSimulation.advance` for stepping.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
