"""Domain randomization that draws from what a log says, instead of from guessed ranges."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.random import Generator

from physx_core.errors import ComponentNotFoundError
from physx_gym.tasks.randomizations import Randomization
from physx_identify.errors import IdentificationError
from physx_identify.result.identification import SETTINGS, Identification, masses_of
from physx_identify.result.stored import read_identification


class Identified(Randomization):
    """Gives the controlled robot parameters drawn from the posterior of an identification.

    A draw is one of all parameters together, so errors that belong together stay together. Masses,
    damping, friction and armature are drawn; what belongs to the log, such as biases and delay, is
    not of the robot.
    """

    def __init__(self, path: str | Path | Identification, name: str | None = None) -> None:
        """Choose the identification.

        Args:
            path: TOML file of ``physx identify -o``, or an identification.
            name: Name in the log; None: that of the class.

        Raises:
            IdentificationError: If the file is missing or damaged, has no draws, or the log told of
                nothing that an environment can change.
        """
        super().__init__(name)
        self.found = path if isinstance(path, Identification) else read_identification(path)
        count = len(self.found.estimates)
        if {len(draw) for draw in self.found.draws} != {count}:
            raise IdentificationError(
                f"The identification has no draws of its {count} parameters: make it again."
            )
        self._places = [
            (place, each) for place, each in enumerate(self.found.estimates)
            if each.kind in ("mass", *SETTINGS)
        ]  # fmt: skip
        self._masses: dict[str | Path, dict[str, float]] = {}
        if not self._places:
            raise IdentificationError(
                "The identification has no mass, damping, friction or armature to draw."
            )

    def draw(self, nominal: Any, random: Generator) -> dict[str, Any]:
        """Return the value of each parameter.

        Raises:
            ComponentNotFoundError: If the robot has no link of which there is a mass.
        """
        draw = self.found.draws[int(random.integers(len(self.found.draws)))]
        drawn = {each.name: float(draw[place]) for place, each in self._places}
        robot = nominal.env.robot
        links = [
            body.removeprefix(f"{robot.name}/")
            for body in nominal.env.simulator.layout.bodies[robot.bodies]
        ]
        for _, each in self._places:
            if each.kind == "mass" and each.of not in links:
                raise ComponentNotFoundError("link", each.of, "The robot", links)
        return drawn

    def options(self, nominal: Any, drawn: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return factors of the masses, and settings of the joints."""
        robot = nominal.env.robot.name
        factors = dict(nominal.options["world"]["robots"][robot]["mass_factors"])
        (described,) = (each for each in nominal.env.simulator.world.robots if each.name == robot)
        if described.urdf not in self._masses:
            self._masses[described.urdf] = masses_of(described)
        masses = self._masses[described.urdf]
        joints: dict[str, dict[str, float]] = {}
        for _, each in self._places:
            value = drawn[each.name]
            if each.kind == "mass":
                factors[each.of] = value / masses[each.of]
            else:
                joints.setdefault(each.of, {})[each.kind] = value
        return {"world": {"robots": {robot: {"mass_factors": factors, "joints": joints}}}}
