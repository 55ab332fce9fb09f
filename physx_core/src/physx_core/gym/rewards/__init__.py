"""Rewards that are put together from parts."""

from __future__ import annotations

from physx_core.gym.rewards.combining import Product, Sum
from physx_core.gym.rewards.reward import Minimizing, Reward, Survival, Tracking

__all__ = ["Minimizing", "Product", "Reward", "Sum", "Survival", "Tracking"]
