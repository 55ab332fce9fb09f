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
    from physx_core.interfaces.launcher import ClientHandle, Launcher
    from physx_core.interfaces.network import Network
    from physx_core.interfaces.optimization import Optimization
    from physx_core.interfaces.transformation import Transformation
    from physx_core.interfaces.visualizer import Observer, Visualizer
    from physx_core.motors import Motor, Motors
    from physx_core.pipelines.data_generation import DataGeneration
    from physx_core.pipelines.prediction import Prediction
    from physx_core.pipelines.replay import Replay
    from physx_core.pipelines.training import Training
    from physx_core.scene import Factory
    from physx_core.sensors import (
        ContactSensor,
        EffortSensor,
        Encoder,
        ForceTorqueSensor,
        Imu,
        Sensors,
    )
    from physx_core.world import (
        Box,
        Capsule,
        Cylinder,
        Ground,
        HeightField,
        JointSettings,
        Mesh,
        Robot,
        Sphere,
        Stairs,
        World,
        Wrench,
    )

__version__ = "0.1.0"

_HOMES = {
    "Backend": "interfaces.backend",
    "Box": "world",
    "Capsule": "world",
    "ClientHandle": "interfaces.launcher",
    "ContactSensor": "sensors",
    "Cylinder": "world",
    "DataGeneration": "pipelines.data_generation",
    "Dataset": "dataset",
    "DatasetConfig": "config",
    "EffortSensor": "sensors",
    "Encoder": "sensors",
    "Environment": "interfaces.environment",
    "EnvironmentConfig": "config",
    "Factory": "scene",
    "Field": "fields",
    "ForceTorqueSensor": "sensors",
    "Ground": "world",
    "HeightField": "world",
    "Imu": "sensors",
    "JointSettings": "world",
    "Layout": "interfaces.backend",
    "Launcher": "interfaces.launcher",
    "Mesh": "world",
    "Motor": "motors",
    "Motors": "motors",
    "Network": "interfaces.network",
    "NetworkConfig": "config",
    "Observer": "interfaces.visualizer",
    "Optimization": "interfaces.optimization",
    "PhysxError": "errors",
    "Prediction": "pipelines.prediction",
    "Replay": "pipelines.replay",
    "Robot": "world",
    "Sensors": "sensors",
    "Simulation": "interfaces.backend",
    "Sphere": "world",
    "Stairs": "world",
    "State": "interfaces.backend",
    "Training": "pipelines.training",
    "Transformation": "interfaces.transformation",
    "Visualizer": "interfaces.visualizer",
    "World": "world",
    "Wrench": "world",
}

__all__ = [  # noqa: RUF022 - grouped by what they are for
    "Environment", "EnvironmentConfig", "Factory", "Field",
    "Network", "NetworkConfig", "Optimization", "Transformation",
    "Dataset", "DatasetConfig",
    "Observer", "Visualizer",
    "Backend", "Layout", "Simulation", "State",
    "Robot", "JointSettings", "World", "Wrench",
    "Box", "Capsule", "Cylinder", "Mesh", "Sphere", "Ground", "HeightField", "Stairs",
    "Motor", "Motors", "Sensors",
    "ContactSensor", "EffortSensor", "Encoder", "ForceTorqueSensor", "Imu",
    "DataGeneration", "Prediction", "Replay", "Training",
    "ClientHandle", "Launcher", "PhysxError", "plugins",
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
