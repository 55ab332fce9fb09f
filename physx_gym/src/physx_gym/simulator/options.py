"""Options of a simulator as nested plain data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from physx_core.errors import ConfigError, UnknownOptionError
from physx_sim import JointSettings, Motor, Robot, Sensor, World

_NAMES = frozenset(
    {"name", "joint", "urdf", "package_dirs", "joints", "feet", "path", "heights", "mimic"}
)
"""Fields that identify a thing rather than configure it; these are not options."""
_PARTS = ("robots", "objects")


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
