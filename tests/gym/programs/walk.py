"""Walk: an environment whose actions say how long a step takes, and how it fails."""

import os
import signal
import time

import gymnasium
import numpy as np
from gymnasium import spaces

PAUSES = 0.0, 3e-4, 2e-3, 1.5, 60.0
FAULTS = "none", "raise", "kill", "exit"


class Walk(gymnasium.Env):
    """Walks at random, for a number of steps that the reset draws; its infos vary."""

    def __init__(self, *, pauses=True, fails_in=""):
        self.observation_space = spaces.Dict(
            {"place": spaces.Box(-np.inf, np.inf, (2,), np.float64), "n": spaces.Discrete(100)}
        )
        self.action_space = spaces.Dict(
            {
                "push": spaces.Box(-1, 1, (2,), np.float32),
                "pause": spaces.Discrete(len(PAUSES)),
                "fault": spaces.Discrete(len(FAULTS)),
            }
        )
        if fails_in == "spaces" and os.environ.get("PHYSX_CLIENT"):
            self.observation_space = spaces.Box(-1, 1, (3,))
        if fails_in == "__init__" and os.environ.get("PHYSX_CLIENT"):
            raise OSError("no more environments")
        self.pauses, self.fails_in, self.gift = pauses, fails_in, None
        self.place, self.n, self.length = np.zeros(2), 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.fails_in == "reset":
            raise KeyError("place")
        self.place = self.np_random.standard_normal(2) + (options or {}).get("start", 0.0)
        self.n, self.length = 0, int(self.np_random.integers(1, 6))
        return self.observe(), {"length": self.length} if self.length % 2 else {}

    def step(self, action):
        if self.pauses:
            time.sleep(PAUSES[action["pause"]])
        fault = FAULTS[action["fault"]]
        if fault == "raise":
            raise ZeroDivisionError(f"after {self.n} steps")
        if fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "exit":
            os._exit(7)
        self.place = 0.9 * self.place + action["push"] + self.np_random.standard_normal(2)
        self.n += 1
        over, cut = self.n >= self.length, bool(self.np_random.random() < 0.1)
        return self.observe(), float(self.place.sum()), over, cut, self.describe()

    def observe(self):
        return {"place": self.place.copy(), "n": np.int64(self.n % 100)}

    def describe(self):
        kinds = (
            {},
            {"speed": float(self.place[0]), "part": {"n": self.n}},
            {"long": np.arange(200.0) * self.n},
            {"word": "yes", "speed": 1},
        )
        return kinds[int(self.np_random.integers(4))]

    def close(self):
        if self.fails_in == "close" and os.environ.get("PHYSX_CLIENT"):
            raise OSError("the door is stuck")

    @property
    def pid(self):
        return os.getpid()


class Lone:
    """A walk on its own that begins anew as a vector environment's do."""

    def __init__(self, mode):
        self.env, self.mode, self.due = Walk(pauses=False), mode, None

    def reset(self, seed=None, options=None):
        self.due = None
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, 0.0, False, False, info

    def step(self, action):
        if self.due:
            return self.reset()
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            if self.mode == "NextStep":
                self.due = True
            elif self.mode == "SameStep":
                final, final_info = observation, info
                observation, info = self.env.reset()
                info = {"final_obs": final, **info, "final_info": final_info}
        return observation, reward, terminated, truncated, info
