"""An environment with long infos, whose first worker counts its messages late."""

import sys
import time

import gymnasium
import numpy as np


class LateCounter:
    """Counters of messages; what is written to them is there a second later."""

    def __init__(self, counters):
        self._counters = counters

    def __getitem__(self, place):
        return self._counters[place]

    def __setitem__(self, place, value):
        time.sleep(1.0)
        self._counters[place] = value


class LongInfos(gymnasium.Env):
    """Its infos do not fit into shared memory, so they are sent."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        frame = sys._getframe()
        while type(frame.f_locals.get("self")).__name__ != "Worker":
            frame = frame.f_back
        worker = frame.f_locals["self"]
        if worker._number == 0:
            worker._batch.sent = LateCounter(worker._batch.sent)
        else:  # until the first one has sent its info, but not counted it
            time.sleep({1: 0.3, 2: 0.1}[worker._number])
        info = {} if worker._number == 2 else {"text": f"{worker._number}" * 1000}
        return np.zeros(1, np.float32), info

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}
