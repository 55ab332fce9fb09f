"""Environments for the tests of godot-rl, found by the path of this file too."""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces


class Cart(gymnasium.Env):
    """Counts its steps; everything that a message of godot-rl can hold is in its spaces.

    It terminates at 1000 m, and is truncated after `length` steps.
    """

    def __init__(self, length=1000, fails_at=-1, name="cart"):
        self.observation_space = spaces.Dict(
            {
                "position": spaces.Box(-10, 10, (2,), np.float64),
                "camera": spaces.Box(0, 255, (2, 3, 3), np.uint8),
                "level": spaces.Discrete(5, start=1),
            }
        )
        self.action_space = spaces.Dict(
            {
                "force": spaces.Box(np.array([-2.0, 0.0]), np.array([4.0, 1.0]), dtype=np.float64),
                "gear": spaces.Discrete(3),
            }
        )
        self.length, self.fails_at, self.name = length, fails_at, name
        self.steps = self.episodes = self.closed = 0
        self.actions = []
        self.position = np.zeros(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.episodes += 1
        self.position = self.np_random.random(2)
        return self.observed(), {"episode": self.episodes, "array": np.arange(2), "odd": object()}

    def step(self, action):
        self.steps += 1
        self.actions.append(action)
        if self.steps == self.fails_at:
            raise ArithmeticError("the cart fell over")
        self.position = self.position + action["force"]
        done = bool(self.position[0] > 1000)
        return self.observed(), 0.5, done, self.steps >= self.length, {"gear": action["gear"]}

    def observed(self):
        camera = np.full((2, 3, 3), self.steps, np.uint8)
        camera[0, 0] = (255, 1, 16)
        return {"position": self.position, "camera": camera, "level": 1 + self.steps % 5}

    def close(self):
        self.closed += 1

    def who(self):
        return {"name": self.name, "steps": np.int64(self.steps)}

    def needs(self, more):
        return more
