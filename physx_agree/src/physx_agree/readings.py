"""Readings: how two tasks are described differently, found without simulating."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from physx_agree.episodes import robot_below
from physx_core.errors import PhysxError
from physx_sim import Layout

_PLAIN = (bool, int, float, str, type(None), np.generic)
_ENGINE = (".backend", ".engine")


@dataclass(frozen=True)
class Difference:
    """Something that is not the same on two engines.

    Attributes:
        where: What it is, such as ``"motors.slider.period"``.
        values: On both.
    """

    where: str
    values: tuple[Any, Any]

    def __str__(self) -> str:
        one, other = map(_short, self.values)
        return f"{self.where}: {one} | {other}"


MISSING = "missing"


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Difference]:
    """Return what differs between flat descriptions."""
    names = dict.fromkeys([*one, *other])
    pairs = {name: (one.get(name, MISSING), other.get(name, MISSING)) for name in names}
    return [
        Difference(name, pair)
        for name, pair in pairs.items()
        if not (_same(*pair) or name.endswith(_ENGINE))
    ]


def flat(thing: Any, path: str = "") -> dict[str, Any]:
    """Return what a description consists of, by path; what is no plain data is left out."""
    return dict(_walk(thing, path))


def _walk(thing: Any, path: str) -> Iterator[tuple[str, Any]]:
    if dataclasses.is_dataclass(thing):
        yield path, type(thing).__name__
        for field in dataclasses.fields(thing):
            yield from _walk(getattr(thing, field.name), f"{path}.{field.name}")
    elif isinstance(thing, Mapping):
        for name, value in thing.items():
            yield from _walk(value, f"{path}.{name}")
    elif isinstance(thing, (list, tuple)) and any(map(dataclasses.is_dataclass, thing)):
        for number, value in enumerate(thing):
            name = getattr(value, "name", "") or getattr(value, "joint", "") or number
            yield from _walk(value, f"{path}.{name}")
    elif isinstance(thing, np.ndarray):
        yield path, thing.tolist()
    elif isinstance(thing, _PLAIN) or _is_plain_list(thing):
        yield path, thing
    elif hasattr(thing, "__fspath__"):
        yield path, str(thing)


def _is_plain_list(thing: Any) -> bool:
    return isinstance(thing, (list, tuple)) and all(isinstance(each, _PLAIN) for each in thing)


def above_the_engine(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return what a task, just made, has between the policy and the engine: plain values by path.

    Wrappers and layers with their attributes; periods, motors and sensors of the simulator.
    """
    simulator = robot_below(env).simulator
    simulator.prepare()
    periods = simulator.control_period, simulator.observe_period
    found: dict[str, Any] = {"periods.control": periods[0], "periods.observe": periods[1]}
    found |= flat(simulator.motors, "motors") | flat(simulator.sensors, "sensors")
    for name, owner in owners(env).items():
        found[name] = type(owner).__qualname__
        found |= flat(vars(owner), name)
    return found


def owners(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the wrappers and layers of a task by name, the outermost first."""
    found: dict[str, Any] = {}
    layer: Any = env
    while layer is not None:
        kind = type(layer).__name__
        again = sum(type(each).__name__ == kind for each in found.values())
        found[f"{kind}[{again}]" if again else kind] = layer
        layer = getattr(layer, "env", None)
    return found


def give(env: gymnasium.Env[Any, Any], difference: Difference) -> gymnasium.Env[Any, Any] | None:
    """Give a task the first of two values; return the task, or None if that is impossible.

    Args:
        env: The task that has the second value.
        difference: As `above_the_engine` shows it.
    """
    owner, _, option = difference.where.partition(".")
    value, simulator = difference.values[0], robot_below(env).simulator
    try:
        if owner == "periods":
            simulator.set_options({"stepper": {f"{option}_period": value}})
            return env
        if owner in ("motors", "sensors"):
            name, _, option = option.rpartition(".")
            simulator.set_options({owner: {name: {option: value}}})
            return env
    except PhysxError:
        return None
    known = owners(env)
    if owner not in known or (value is MISSING and option):
        return None
    if value is MISSING:
        return _without(env, known[owner])
    if option not in vars(known[owner]):
        return None
    setattr(known[owner], option, value)
    return env


def _without(env: gymnasium.Env[Any, Any], wrapper: Any) -> gymnasium.Env[Any, Any] | None:
    """Return a task without one of its wrappers."""
    if not isinstance(wrapper, gymnasium.Wrapper):
        return None
    if wrapper is env:
        return wrapper.env
    for each in owners(env).values():
        if isinstance(each, gymnasium.Wrapper) and each.env is wrapper:
            each.env = wrapper.env
            return env
    return None


def limits(layout: Layout) -> dict[str, Any]:
    """Return the limits of joints as an engine holds them, by path."""
    return {
        f"joints.{joint}.{name}": float(getattr(layout, name)[place])
        for place, joint in enumerate(layout.joints)
        for name in ("lower", "upper", "max_velocity", "max_torque")
    }


def _same(one: Any, other: Any) -> bool:
    return type(one) is type(other) and (one == other or (one != one and other != other))


def _short(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) < 40 else f"{text[:37]}..."
