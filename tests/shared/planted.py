"""Engines and tasks with a planted difference, which nothing says but what they do."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from physx_core import plugins
from physx_gym import RobotEnv, Simulator
from physx_sim import Backend, Ground, JointSettings, Robot, Simulation, World
from physx_sim.engines import find_robot

KNEE, SHIN, HIP = "front_left_knee", "front_left_shin", "back_left_hip"
PERIOD = 5e-3
FILE = {"damping": 0.1, "friction": 0.0, "stiffness": 0.0, "armature": 0.0}
"""What the ant's file says of each joint."""


def planted(engine: str, change: Callable[[World], World]) -> type[Backend]:
    """Return an engine that simulates another world than it was asked to."""

    def build(self: Backend, world: World, seed: int | None = None) -> Simulation:
        return plugins.resolve("backend", engine).build(change(world), seed)

    name = f"Planted{sum(name.startswith('Planted') for name in globals())}"
    made = type(name, (Backend,), {"build": build, "__module__": __name__, "__doc__": "Planted."})
    globals()[name] = made  # a reference of an engine names its module and its class
    return made


class Stagger(RobotEnv):
    """An ant that falls onto the ground and staggers under torques held for five steps."""

    def __init__(
        self, *, backend: Any = "dart", world: World | None = None, duration: float = 0.75
    ) -> None:
        ground = Ground(friction=0.8)
        world = world or World([Robot("ant", fixed_base=False)], PERIOD, ground=ground)
        super().__init__(Simulator(world, backend=backend, sensors=()), 5 * PERIOD, duration)

    def _sample_state(self) -> tuple[np.ndarray, np.ndarray]:
        q = self.simulator.place_on_ground(self._neutral())
        q[2] += 0.15
        return q, self.np_random.normal(size=len(self.robot_state.v)) * 0.3

    def has_terminated(self, info: dict[str, Any]) -> tuple[bool, bool]:
        return False, False


class Late(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Applies actions some steps late."""

    def __init__(self, env: gymnasium.Env[Any, Any], delay: int) -> None:
        super().__init__(env)
        self.delay, self._waiting = delay, list[Any]()

    def reset(self, **options: Any) -> Any:
        self._waiting = []
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        self._waiting.append(np.array(action))
        return self.env.step(self._waiting[max(0, len(self._waiting) - 1 - self.delay)])


def late_on(engine: Any) -> Callable[..., gymnasium.Env[Any, Any]]:
    """Return a task that is one step late on an engine."""

    def make(backend: Any) -> gymnasium.Env[Any, Any]:
        return Late(Stagger(backend=backend), 1 if backend is engine else 0)

    return make


@dataclass(frozen=True)
class Plant:
    """A difference, and what names it.

    Attributes:
        kind: Kind of the cause.
        words: What its text contains.
        change: Returns the other world.
    """

    kind: str
    words: Sequence[str]
    change: Callable[[World], World]

    def is_named_in(self, causes: Sequence[Any]) -> bool:
        return any(
            cause.kind == self.kind and all(word in cause.text for word in self.words)
            for cause in causes
        )


def plants(folder: Path) -> dict[str, Plant]:
    """Return the differences that an engine can hide; files go to a folder."""

    def joint(name: str, **given: float) -> Callable[[World], World]:
        def change(world: World) -> World:
            [robot] = world.robots
            settings = robot.joints.get(name, JointSettings())
            more = {
                key: (getattr(settings, key) or FILE[key]) + value for key, value in given.items()
            }
            joints = {**robot.joints, name: replace(settings, **more)}
            return replace(world, robots=[replace(robot, joints=joints)])

        return change

    def mass(world: World) -> World:
        [robot] = world.robots
        factors = {**robot.mass_factors, SHIN: 1.1 * robot.mass_factors.get(SHIN, 1.0)}
        return replace(world, robots=[replace(robot, mass_factors=factors)])

    def gravity(world: World) -> World:
        x, y, z = world.gravity
        return replace(world, gravity=(x, y, z + 0.1))

    def file(name: str, begin: str, old: str, new: str) -> Callable[[World], World]:
        text = find_robot("ant").read_text(encoding="utf-8")
        pattern = rf"({re.escape(begin)}.*?){re.escape(old)}" if begin else f"(){re.escape(old)}"
        changed = re.sub(pattern, lambda m: m[1] + new, text, count=bool(begin), flags=re.S)
        assert changed != text
        path = folder / f"{name}.urdf"
        path.write_text(changed, encoding="utf-8")
        return lambda world: replace(world, robots=[replace(world.robots[0], urdf=path)])

    def friction(world: World) -> World:
        return replace(world, ground=replace(world.ground, friction=0.9 * world.ground.friction))

    def restitution(world: World) -> World:
        return replace(world, robots=[replace(world.robots[0], restitution=0.3)])

    knee, ball = f'<joint name="{KNEE}"', '<sphere radius="0.04"/>'
    limit = file("limit", knee, 'upper="1.7"', 'upper="1.2"')
    torque = file("torque", knee, 'effort="60"', 'effort="30"')
    shape = file("shape", "", ball, ball.replace("0.04", "0.045"))
    return {
        "mass": Plant("mass", [SHIN, "+10 %"], mass),
        "damping": Plant("damping", [KNEE, "+0.05"], joint(KNEE, damping=0.05)),
        "armature": Plant("armature", [HIP, "+0.01"], joint(HIP, armature=0.01)),
        "stiffness": Plant("stiffness", [KNEE, "+0.5"], joint(KNEE, stiffness=0.5)),
        "joint friction": Plant("friction", [HIP, "+0.2"], joint(HIP, friction=0.2)),
        "gravity": Plant("gravity", ["+0.1"], gravity),
        "position limit": Plant("limit", [KNEE, "upper"], limit),
        "torque limit": Plant("torque limit", [KNEE], torque),
        "shape": Plant("contact gap", ["deep"], shape),
        "contact friction": Plant("friction of contacts", ["robot on ground"], friction),
        "restitution": Plant("restitution", ["robot on ground"], restitution),
    }


SMOOTH = ("mass", "damping", "armature", "stiffness", "joint friction", "gravity")
BETWEEN = (*SMOOTH, "position limit", "torque limit")


class Rewarded(Stagger):
    """It says how large its actions are."""

    def compute_reward(self, terminated: bool, info: dict[str, Any]) -> float:
        info["effort"] = float(np.abs(self.action).sum())
        return 0.0


class Chain(Stagger):
    """Six rods in a row, which fall from the side and move chaotically."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, duration=8.0)

    def _sample_state(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([2.0, *np.zeros(5)]), np.zeros(6)


def chain(path: Path) -> Path:
    """Write a file of a chain of rods; return it."""
    links = ['<link name="rod0"/>']
    for number in range(1, 7):
        links.append(
            f'<joint name="joint{number}" type="continuous"><parent link="rod{number - 1}"/>'
            f'<child link="rod{number}"/><origin xyz="0 0 {0.0 if number == 1 else -0.2}"/>'
            f'<axis xyz="0 1 0"/></joint><link name="rod{number}"><inertial>'
            '<origin xyz="0 0 -0.1"/><mass value="0.5"/><inertia ixx="0.002" iyy="0.002" '
            'izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    path.write_text(f'<robot name="chain">{"".join(links)}</robot>', encoding="utf-8")
    return path
