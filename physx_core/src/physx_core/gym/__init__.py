"""Robots as Gymnasium environments, on any engine.

The public names are imported when they are first used. Importing the package registers its
environments with Gymnasium, ``physx/Cartpole-v0`` and others, and has OpenMP's threads rest soon,
so that a policy's network leaves the processor to them: import it before the network's library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from physx_core.gym.registration import register
from physx_core.openmp import rest_soon

if TYPE_CHECKING:
    from physx_core.gym.blocks import (
        Block,
        BodyObserver,
        ControllerBlock,
        MahonyFilter,
        MotorSafetyLimit,
        ObserverBlock,
        PDAdapter,
        PDController,
        QuantityObserver,
    )
    from physx_core.gym.bridge import GymEnvironment
    from physx_core.gym.layer import Layer, PipelineEnv
    from physx_core.gym.layers.composed import ComposedEnv
    from physx_core.gym.layers.controlled import ControlledEnv
    from physx_core.gym.layers.observed import ObservedEnv
    from physx_core.gym.log import Log
    from physx_core.gym.log_file import read_log
    from physx_core.gym.pipeline import build_pipeline, load_pipeline
    from physx_core.gym.plotting import plot
    from physx_core.gym.policy import Policy
    from physx_core.gym.replaying import replay
    from physx_core.gym.robot_env import RobotEnv
    from physx_core.gym.simulator import Simulator
    from physx_core.gym.states import RobotState, StepperState
    from physx_core.gym.trajectory import Trajectory
    from physx_core.gym.vector import ParallelVectorEnv

_HOMES = {
    "Block": "blocks",
    "BodyObserver": "blocks",
    "ComposedEnv": "layers.composed",
    "ControlledEnv": "layers.controlled",
    "ControllerBlock": "blocks",
    "GymEnvironment": "bridge",
    "Layer": "layer",
    "Log": "log",
    "MahonyFilter": "blocks",
    "MotorSafetyLimit": "blocks",
    "ObservedEnv": "layers.observed",
    "ObserverBlock": "blocks",
    "PDAdapter": "blocks",
    "PDController": "blocks",
    "ParallelVectorEnv": "vector",
    "PipelineEnv": "layer",
    "Policy": "policy",
    "QuantityObserver": "blocks",
    "RobotEnv": "robot_env",
    "RobotState": "states",
    "Simulator": "simulator",
    "StepperState": "states",
    "Trajectory": "trajectory",
    "build_pipeline": "pipeline",
    "load_pipeline": "pipeline",
    "plot": "plotting",
    "read_log": "log_file",
    "replay": "replaying",
}

__all__ = [
    "Block",
    "BodyObserver",
    "ComposedEnv",
    "ControlledEnv",
    "ControllerBlock",
    "GymEnvironment",
    "Layer",
    "Log",
    "MahonyFilter",
    "MotorSafetyLimit",
    "ObservedEnv",
    "ObserverBlock",
    "PDAdapter",
    "PDController",
    "ParallelVectorEnv",
    "PipelineEnv",
    "Policy",
    "QuantityObserver",
    "RobotEnv",
    "RobotState",
    "Simulator",
    "StepperState",
    "Trajectory",
    "build_pipeline",
    "load_pipeline",
    "plot",
    "read_log",
    "replay",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"physx_core.gym.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *__all__})


register()
rest_soon()
