"""An environment whose action is how long the step takes, in s."""

from __future__ import annotations

import time

import gymnasium
import numpy as np
from gymnasium import spaces


class Slow(gymnasium.Env):
    observation_space = action_space = spaces.Box(0, 1000, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        time.sleep(float(action[0]))
        return action, 0.0, False, False, {}
