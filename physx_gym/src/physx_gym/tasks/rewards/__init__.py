"""Rewards, and their composition from parts."""

from __future__ import annotations

from physx_gym.tasks.rewards.mixtures import Product, Sum
from physx_gym.tasks.rewards.reward import Minimizing, Reward, Survival, Tracking

__all__ = ["Minimizing", "Product", "Reward", "Sum", "Survival", "Tracking"]
