"""Options of a simulator as nested plain data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from physx_core.errors import ConfigError, UnknownOptionError
from physx_sim import BodySettings, JointSettings, Layout, Motor, Robot, Sensor, World
from physx_sim.engines import read_robot

_NAMES = frozenset(
    {
        *("name", "joint", "urdf", "package_dirs", "joints", "feet", "path", "heights", "mimic"),
        *("couplings", "wheels", "network"),
    }
)
"""Fields that identify a thing rather than configure it; these are not options."""
_PARTS = ("robots", "objects")
_CHANGEABLE = {
    "ground": ("friction",),
    "robots": ("friction", "mass_factors"),
    "objects": ("friction", "mass"),
}
"""Options that `Simulation.set_body` changes without a rebuild."""


def world_options(world: World) -> dict[str, Any]:
    """Return the options of a world, its ground, its robots and its objects."""
    found = _fields_of(world, {"ground", *_PARTS})
    found["ground"] = {} if world.ground is None else _fields_of(world.ground)
    for part in _PARTS:
        found[part] = {thing.name: _fields_of(thing) for thing in getattr(world, part)}
    for robot in world.robots:
        joints = {name: _fields_of(settings) for name, settings in robot.joints.items()}
        found["robots"][robot.name]["joints"] = joints
    return found


def motor_options(motors: Sequence[Motor]) -> dict[str, Any]:
    """Return the options of motors by joint."""
    return {motor.joint: _fields_of(motor) for motor in motors}


def sensor_options(sensors: Sequence[Sensor]) -> dict[str, Any]:
    """Return the options of sensors by name."""
    return {sensor.name: _fields_of(sensor) for sensor in sensors}


def change_world(world: World, options: Mapping[str, Any]) -> World:
    """Return a world with some options changed."""
    options = dict(_mapping("world", options))
    ground = options.pop("ground", None)
    changes: dict[str, Any] = {}
    if ground:
        if world.ground is None:
            raise ConfigError('The world has no ground, so ["world"]["ground"] has no options.')
        new_ground = _change("world.ground", world.ground, ground)
        changes = {} if new_ground is world.ground else {"ground": new_ground}
    for part in _PARTS:
        given = options.pop(part, None)
        if given:
            things = {thing.name: thing for thing in getattr(world, part)}
            new = change_each(f"world.{part}", things, given)
            if any(new[name] is not thing for name, thing in things.items()):
                changes[part] = tuple(new.values())
    changed: World = _change("world", world, options, (*_PARTS, "ground"))
    return dataclasses.replace(changed, **changes) if changes else changed


def needing_a_build(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a world without those that a running engine takes over."""
    left = {name: value for name, value in options.items() if name != "gravity"}
    if isinstance(left.get("ground"), Mapping):
        left["ground"] = _without("ground", left["ground"])
    for part in _PARTS:
        if isinstance(left.get(part), Mapping):
            left[part] = {name: _without(part, given) for name, given in left[part].items()}
    return left


def _without(part: str, given: Any) -> Any:
    if not isinstance(given, Mapping):
        return given
    # None means what a file says, which a running engine no longer knows once it was built without.
    return {
        name: value
        for name, value in given.items()
        if name not in _CHANGEABLE[part] or value is None
    }


def link_masses(world: World, layout: Layout) -> dict[str, float]:
    """Return the masses of the links of all robots of a world, in kg, by the names of bodies."""
    found: dict[str, float] = {}
    for robot in world.robots:
        masses = {body.name: body.mass for body in read_robot(robot).bodies}
        for name in layout.bodies[layout.parts[robot.name].bodies]:
            found[name] = masses[name.removeprefix(f"{robot.name}/")]
    return found


def body_changes(
    built: World, wanted: World, layout: Layout, masses: Mapping[str, float]
) -> dict[str, BodySettings]:
    """Return what turns a built world into the wanted one, by the names of bodies.

    Args:
        built: The world as built.
        wanted: It with other masses and friction.
        layout: Its layout.
        masses: See `link_masses`; of the built world.
    """
    found: dict[str, dict[str, Any]] = {}
    for old, new in zip(built.robots, wanted.robots, strict=True):
        for name in layout.bodies[layout.parts[old.name].bodies] if old is not new else ():
            link, own = name.removeprefix(f"{old.name}/"), found.setdefault(name, {})
            ratio = new.mass_factors.get(link, 1.0) / old.mass_factors.get(link, 1.0)
            if ratio != 1.0 and masses[name] > 0:
                own["mass"] = ratio * masses[name]
            own |= _differing(old, new, ("friction",))
    for one, other in zip(built.objects, wanted.objects, strict=True):
        options = ("friction",) if one.static else ("mass", "friction")
        found[one.name] = _differing(one, other, options)
    if built.ground is not None:
        found["ground"] = _differing(built.ground, wanted.ground, ("friction",))
    return {name: BodySettings(**given) for name, given in found.items() if given}


def _differing(old: Any, new: Any, options: Sequence[str]) -> dict[str, float]:
    pairs = ((name, getattr(old, name), getattr(new, name)) for name in options)
    return {name: after for name, before, after in pairs if before != after}


def change_each(where: str, things: Mapping[str, Any], options: Any) -> dict[str, Any]:
    """Return things by name with some options changed."""
    options = _mapping(where, options)
    check_known(where, options, things)
    return {
        name: _change(f"{where}.{name}", thing, options[name]) if name in options else thing
        for name, thing in things.items()
    }


def check_known(where: str, options: Any, known: Any) -> None:
    """Check the names of options."""
    unknown = [str(name) for name in _mapping(where, options) if name not in known]
    if unknown:
        raise UnknownOptionError(f"Options of the simulator: {where}", unknown, known)


def _fields_of(thing: Any, without: set[str] | None = None) -> dict[str, Any]:
    left_out = _NAMES | (without or set())
    names = [field.name for field in dataclasses.fields(thing) if field.name not in left_out]
    return {name: getattr(thing, name) for name in names}


def _change(where: str, thing: Any, options: Any, without: Sequence[str] = ()) -> Any:
    known = _fields_of(thing, set(without))
    if isinstance(thing, Robot):
        known["joints"] = thing.joints
        options = {**options, "joints": _joints(where, thing, options.get("joints", {}))}
    check_known(where, options, (*known, *without))
    new = {name: value for name, value in options.items() if not _same(value, known.get(name))}
    return dataclasses.replace(thing, **new) if new else thing


def _joints(where: str, robot: Robot, options: Any) -> Mapping[str, JointSettings]:
    """Return the settings of a robot's joints, by name, with some options changed."""
    found, where = dict(robot.joints), f"{where}.joints"
    for name, own in _mapping(where, options).items():
        found[name] = _change(f"{where}.{name}", found.get(name, JointSettings()), own)
    same = all(found[name] is robot.joints.get(name) for name in found)
    return robot.joints if same else found


def _same(value: Any, known: Any) -> bool:
    plain = isinstance(value, (bool, int, float, str, tuple, type(None)))
    return value is known or (plain and type(value) is type(known) and value == known)


def _mapping(where: str, options: Any) -> Mapping[str, Any]:
    if not isinstance(options, Mapping):
        raise ConfigError(f"Options of the simulator: {where} is {options!r}, not a mapping.")
    return options
