"""Randomization of the world: masses, friction, pushes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from numpy.random import Generator

from physx_core import checks
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.tasks.randomizations.randomization import (
    Drawn,
    Nominal,
    Randomization,
    Range,
    check_range,
    chosen,
)
from physx_sim import Wrench


class RandomMasses(Randomization):
    """Multiplies each mass, with its moments of inertia, by a different factor."""

    def __init__(
        self, factor: Range, of: Sequence[str] | None = None, name: str | None = None
    ) -> None:
        """Choose the masses.

        Args:
            factor: Range of the factors.
            of: Links of the controlled robot, by their names in its file, and objects; None: all
                links of the robot.
            name: Name in the log; None: that of the class.
        """
        super().__init__(name)
        self.factor, self.of = check_range("RandomMasses.factor", factor, 1e-9), of

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the factor of each mass."""
        links, objects = _links(nominal.env), list(nominal.options["world"]["objects"])
        names = self.of if self.of is not None else links
        names = chosen("link or object", "The world", names, [*links, *objects])
        return {each: random.uniform(*self.factor) for each in names}

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the masses of objects, and the factors of the robot's links."""
        objects, robot = nominal.options["world"]["objects"], nominal.env.robot.name
        before = nominal.options["world"]["robots"][robot]["mass_factors"]
        factors = {
            each: by * before.get(each, 1.0) for each, by in drawn.items() if each not in objects
        }
        return {
            "world": {
                "robots": {robot: {"mass_factors": {**before, **factors}}},
                "objects": {
                    each: {"mass": by * objects[each]["mass"]}
                    for each, by in drawn.items()
                    if each in objects
                },
            }
        }


def _links(env: PipelineEnv) -> list[str]:
    """Return the names of the links of the controlled robot in its file."""
    robot = env.robot
    bodies = env.simulator.layout.bodies[robot.bodies]
    return [body.removeprefix(f"{robot.name}/") for body in bodies]


class RandomFriction(Randomization):
    """Gives things one coefficient of friction, which then applies to any pair of them."""

    def __init__(
        self, coefficient: Range, of: Sequence[str] | None = None, name: str | None = None
    ) -> None:
        """Choose the things.

        Args:
            coefficient: Range of the coefficient.
            of: Names of robots and objects, and ``"ground"``; None: everything.
            name: Name in the log; None: that of the class.
        """
        super().__init__(name)
        self.coefficient, self.of = check_range("RandomFriction.coefficient", coefficient), of

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the coefficient."""
        chosen("robot or object", "The world", self.of, _things(nominal))
        return {"coefficient": random.uniform(*self.coefficient)}

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the coefficient of everything."""
        world, own = nominal.options["world"], {"friction": drawn["coefficient"]}
        names = chosen("robot or object", "The world", self.of, _things(nominal))
        found: dict[str, Any] = {
            kind: {each: own for each in world[kind] if each in names}
            for kind in ("robots", "objects")
        }
        return {"world": {**found, **({"ground": own} if "ground" in names else {})}}


def _things(nominal: Nominal) -> list[str]:
    """Return the names of everything that has a coefficient of friction."""
    world = nominal.options["world"]
    return [*(["ground"] if world["ground"] else []), *world["robots"], *world["objects"]]


class RandomPushes(Randomization):
    """Pushes a body from time to time, horizontally, in random directions."""

    def __init__(
        self,
        force: Range,
        every: Range,
        duration: float = 0.1,
        body: str | None = None,
        until: float = 100.0,
        name: str | None = None,
    ) -> None:
        """Choose the pushes.

        Args:
            force: Range of the forces, in N.
            every: Range of the times from one push to the next, in s.
            duration: Duration of each push, in s.
            body: Name of the link or object; None: the root link of the controlled robot.
            until: Time in the episode after which there are no more pushes, in s.
            name: Name in the log; None: that of the class.
        """
        super().__init__(name)
        self.force = check_range("RandomPushes.force", force)
        self.every = check_range("RandomPushes.every", every, 1e-3)
        self.duration = checks.positive("RandomPushes.duration", duration)
        self.until = checks.positive("RandomPushes.until", until)
        self.body = body

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the body, the times of its pushes in s, and their forces in N."""
        env = nominal.env
        layout = env.simulator.layout
        body = layout.bodies[env.robot.bodies.start] if self.body is None else self.body
        chosen("body", "The world", (body,), layout.bodies)
        times: list[float] = []
        forces: list[list[float]] = []
        time, end = random.uniform(*self.every), min(self.until, env.simulation_duration_max)
        while time < end:
            angle, force = random.uniform(-math.pi, math.pi), random.uniform(*self.force)
            times.append(time)
            forces.append([force * math.cos(angle), force * math.sin(angle), 0.0])
            time += random.uniform(*self.every)
        return {"body": body, "times": times, "forces": forces}

    def apply(self, env: PipelineEnv, drawn: Drawn) -> None:
        """Register the forces of the pushes."""
        for time, force in zip(drawn["times"], drawn["forces"], strict=True):
            wrench = Wrench(drawn["body"], tuple(force), duration=self.duration)
            env.simulator.register_force(wrench, time)
