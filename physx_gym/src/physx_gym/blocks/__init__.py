"""Blocks of pipelines: observers and controllers, each with its own period."""

from __future__ import annotations

from physx_gym.blocks.block import Block, ControllerBlock, ObserverBlock
from physx_gym.blocks.body_observer import BodyObserver
from physx_gym.blocks.mahony_filter import MahonyFilter
from physx_gym.blocks.motor_safety_limit import MotorSafetyLimit
from physx_gym.blocks.pd_adapter import PDAdapter
from physx_gym.blocks.pd_controller import PDController
from physx_gym.blocks.quantity_observer import QuantityObserver
from physx_gym.blocks.targets import Targets

__all__ = [
    "Block",
    "BodyObserver",
    "ControllerBlock",
    "MahonyFilter",
    "MotorSafetyLimit",
    "ObserverBlock",
    "PDAdapter",
    "PDController",
    "QuantityObserver",
    "Targets",
]
