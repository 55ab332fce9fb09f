"""Steps gym_jiminy's environments for `benchmarks/gym.py`, which starts it with another Python.

A line on standard input holds an environment's name and a time in s; the answer is a line of JSON:
steps per second, with and without the time of resets, the time that a step simulates, and the time
between two steps of the integrator.

    pip install -r benchmarks/requirements-jiminy.txt      # in a separate environment
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from typing import Any

import gymnasium

ACTIONS = 256


def made(name: str) -> tuple[Any, list[Any]]:
    """Return an environment, ready to run, and actions for it."""
    env = gymnasium.make(f"gym_jiminy.envs:{name}", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    env.action_space.seed(0)
    return env, [env.action_space.sample() for _ in range(ACTIONS)]


def steps_per_second(env: Any, actions: list[Any], seconds: float) -> tuple[float, float]:
    """Return steps per second: including resets at the ends of episodes, and in `step` alone."""
    clock, stepping, resetting, steps = time.perf_counter, 0.0, 0.0, 0
    env.reset()
    while stepping + resetting < seconds:
        action = actions[steps % len(actions)]
        begin = clock()
        _, _, terminated, truncated, _ = env.step(action)
        stepping += clock() - begin
        steps += 1
        if terminated or truncated:
            begin = clock()
            env.reset()
            resetting += clock() - begin
    return steps / (stepping + resetting), steps / stepping


def integrations(env: Any, actions: list[Any]) -> float:
    """Return the mean simulated time between two steps of the integrator, in s."""
    env.reset()
    env.step(actions[0])
    before = env.stepper_state.iter
    for action in actions[:5]:
        env.step(action)
    return 5 * env.step_dt / (env.stepper_state.iter - before)


def main() -> None:
    """Answer until standard input ends."""
    warnings.filterwarnings("ignore")
    known: dict[str, tuple[Any, list[Any]]] = {}
    for line in sys.stdin:
        name, seconds = line.split()
        if name not in known:
            known[name] = made(name)
            steps_per_second(*known[name], 0.1)
        env, actions = known[name]
        whole, step = steps_per_second(env, actions, float(seconds))
        found = {
            "rate": whole,
            "rate_of_step": step,
            "step_dt": env.step_dt,
            "period": integrations(env, actions),
        }
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
