"""physx connects C++ physics engines with deep learning.

The public names are imported when they are first used, so that ``import physx_core`` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from physx_core import plugins
    from physx_core.config import DatasetConfig, EnvironmentConfig, NetworkConfig
    from physx_core.dataset import Dataset
    from physx_core.errors import PhysxError
    from physx_core.fields import Field
    from physx_core.interfaces.backend import Backend, Layout, Simulation, State
    from physx_core.interfaces.environment import Environment
    from physx_core.interfaces.network import Network
    from physx_core.interfaces.optimization import Optimization
    from physx_core.interfaces.transformation import Transformation
    from physx_core.interfaces.visualizer import Observer, Visualizer
    from physx_core.pipelines.data_generation import DataGeneration
    from physx_core.pipelines.prediction import Prediction
    from physx_core.pipelines.training import Training
    from physx_core.scene import Factory
    from physx_core.world import Robot, World

__version__ = "0.1.0"

_HOMES = {
    "Backend": "interfaces.backend",
    "DataGeneration": "pipelines.data_generation",
    "Dataset": "dataset",
    "DatasetConfig": "config",
    "Environment": "interfaces.environment",
    "EnvironmentConfig": "config",
    "Factory": "scene",
    "Field": "fields",
    "Layout": "interfaces.backend",
    "Network": "interfaces.network",
    "NetworkConfig": "config",
    "Observer": "interfaces.visualizer",
    "Optimization": "interfaces.optimization",
    "PhysxError": "errors",
    "Prediction": "pipelines.prediction",
    "Robot": "world",
    "Simulation": "interfaces.backend",
    "State": "interfaces.backend",
    "Training": "pipelines.training",
    "Transformation": "interfaces.transformation",
    "Visualizer": "interfaces.visualizer",
    "World": "world",
}

__all__ = [  # noqa: RUF022 - grouped by what they are for
    "Environment", "EnvironmentConfig", "Factory", "Field",
    "Network", "NetworkConfig", "Optimization", "Transformation",
    "Dataset", "DatasetConfig",
    "Observer", "Visualizer",
    "Backend", "Layout", "Robot", "Simulation", "State", "World",
    "DataGeneration", "Prediction", "Training",
    "PhysxError", "plugins",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name == "plugins":
        return importlib.import_module("physx_core.plugins")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"physx_core.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
