"""Episodes of a task on an engine, with everything that a physics step depends on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from physx_agree.laboratory import Moment
from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym import RobotEnv, robot_of
from physx_sim import Simulation, State, World, with_rotors

Act = Callable[[Any], Any]
"""Returns the action for an observation."""

RETURN, LENGTH = "return", "length"


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode, physics step by physics step.

    Attributes:
        world: The world, with the rotors of its motors.
        first: The simulation right after the reset.
        actions: What the policy chose, step by step of the environment.
        moments: What each physics step began with.
        velocities: What each of them ended with, shape (steps, nv).
    """

    world: World
    first: State
    actions: Sequence[Any]
    moments: Sequence[Moment]
    velocities: Vector


def figures_of(env: gymnasium.Env[Any, Any], act: Act, seed: int, metric: str) -> float:
    """Run an episode; return the sum of its rewards, its length, or the mean of an information."""
    observation, _ = env.reset(seed=seed)
    values: list[float] = []
    over = False
    while not over:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        values.append(float(_measured(metric, reward, info)))
        over = terminated or truncated
    total = math.fsum(values)
    return total if metric in (RETURN, LENGTH) else total / len(values)


def _measured(metric: str, reward: Any, info: dict[str, Any]) -> Any:
    if metric == RETURN:
        return reward
    if metric == LENGTH:
        return 1.0
    if metric not in info:
        known = [name for name, value in info.items() if np.ndim(value) == 0]
        raise ConfigError(
            f'The information of steps has no "{metric}". Metrics of this task: '
            f"{', '.join([RETURN, LENGTH, *known])}."
        )
    return info[metric]


def record(
    env: gymnasium.Env[Any, Any],
    act: Act | Sequence[Any],
    seed: int,
    steps: int,
) -> Episode:
    """Run the beginning of an episode and record it.

    Args:
        env: The task, with a `RobotEnv` below its wrappers.
        act: The policy, or the actions.
        seed: Of the episode.
        steps: Largest number of physics steps.
    """
    robot = robot_below(env)
    observation, _ = env.reset(seed=seed)
    simulation = robot.simulator.simulation
    recorder = _Recorder(simulation)
    first = simulation.snapshot()
    if tuple(first.gravity.tolist()) == robot.simulator.world.gravity:
        first = dataclasses.replace(first, gravity=np.zeros(0))  # each engine keeps its own
    actions: list[Any] = []
    simulation.add_hook(recorder)
    try:
        over = False
        while not over and len(recorder.moments) < steps:
            if not callable(act) and len(actions) == len(act):
                break
            actions.append(act(observation) if callable(act) else act[len(actions)])
            observation, _, terminated, truncated, _ = env.step(actions[-1])
            over = terminated or truncated
        recorder(simulation)
    finally:
        simulation.remove_hook(recorder)
    moments = recorder.moments
    after = np.array([moment.velocities for moment in moments[1 : steps + 1]])
    world = with_rotors(robot.simulator.world, robot.simulator.motors)
    return Episode(world, first, actions, moments[: len(after)], after)


class _Recorder:
    """A hook that records what a physics step begins with."""

    def __init__(self, simulation: Simulation) -> None:
        self.moments: list[Moment] = []

    def __call__(self, simulation: Simulation) -> None:
        q, v = simulation.positions(), simulation.velocities()
        self.moments.append(Moment(q, v, simulation.commands(), simulation.frame))


def robot_below(env: gymnasium.Env[Any, Any]) -> RobotEnv:
    """Return the robot's environment below all wrappers.

    Raises:
        ConfigError: If there is none, so that no engine can be chosen.
    """
    robot = robot_of(env)
    if robot is None:
        raise ConfigError(
            f"{env} has no RobotEnv below its wrappers, so it has no engine to choose. "
            "physx agree compares engines of tasks made with physx_gym.RobotEnv."
        )
    return robot
