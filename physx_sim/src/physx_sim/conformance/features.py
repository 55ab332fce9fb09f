"""Checks that an engine supports the features it claims, and claims all that it supports."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import numpy as np

from physx_core.typing import Vector
from physx_sim import (
    FEATURES,
    BodySettings,
    Box,
    Connect,
    Ground,
    JointCoupling,
    JointSettings,
    Mimic,
    Robot,
    Simulation,
    Sphere,
    Weld,
    Wheel,
    World,
    Wrench,
)
from physx_sim.conformance.worlds import ARM, PERIOD, arm, box, build, busy, need, pendulum
from physx_sim.errors import FeatureNotSupportedError
from physx_testing.subject import Check, Subject, expect

_Call = Callable[[Simulation], object]


def _zeros(simulation: Simulation) -> tuple[Vector, Vector]:
    return simulation.positions(), np.zeros(simulation.layout.nv)


_CALLS: Mapping[str, _Call] = {
    "step_derivatives": lambda one: one.step_with_derivatives(),  # none while there are hooks
    "accelerations": lambda one: one.accelerations(),
    "attachments": lambda one: one.detach(one.attach(Connect("hand"))),
    "changes": lambda one: one.set_body("hand", BodySettings(mass=2.0)),
    "contacts": lambda one: one.contacts(),
    "derivatives": lambda one: one.forward_dynamics_derivatives(*_zeros(one), _zeros(one)[1]),
    "forward_dynamics": lambda one: one.forward_dynamics(*_zeros(one), _zeros(one)[1]),
    "gravity": lambda one: one.set_gravity((0.0, 0.0, -1.6)),
    "hooks": lambda one: one.add_hook(lambda simulation: None),
    "inverse_dynamics": lambda one: one.inverse_dynamics(*_zeros(one), _zeros(one)[1]),
    "jacobian": lambda one: one.jacobian("hand", one.positions()),
    "joint_wrenches": lambda one: one.joint_wrenches(),
    "mass_matrix": lambda one: one.mass_matrix(one.positions()),
    "raycast": lambda one: one.raycast(np.zeros((1, 3)), np.ones((1, 3))),
    "wrenches": lambda one: one.apply_wrench(Wrench("hand", force=(1.0, 0.0, 0.0))),
}


def _with_joint(settings: JointSettings) -> World:
    return arm(robot={"joints": {"elbow": settings}})


def _colliding() -> World:
    robot = Robot(ARM, fixed_base=False, self_collisions=True, position=(0, 0, 0.5))
    return World(robots=[robot], ground=Ground(), period=PERIOD)


def _touching() -> World:
    boxes = [
        Box(name=name, size=(0.1, 0.1, 0.1), position=(0, 0, height))
        for name, height in (("low", 0.05), ("high", 0.15))
    ]
    return World(objects=boxes, ground=Ground(), period=PERIOD)


def _turning() -> World:
    top = Sphere(name="top", radius=0.1, position=(0.0, 0.0, 0.1), torsional_friction=0.01)
    return World(objects=[top], ground=Ground(), period=PERIOD)


_WORLDS: Mapping[str, Callable[[], World]] = {
    "actuators": lambda: _with_joint(JointSettings(mode="servo")),
    "armature": lambda: _with_joint(JointSettings(armature=0.1)),
    "attachments": lambda: arm(attachments=[Weld("hand")]),
    "couplings": lambda: arm(robot={"couplings": [JointCoupling({"waist": 0.5, "elbow": -1.0})]}),
    "mimic": lambda: _with_joint(JointSettings(mimic=Mimic("waist", 0.5))),
    "joint_friction": lambda: _with_joint(JointSettings(friction=0.1)),
    "springs": lambda: _with_joint(JointSettings(stiffness=1.0, damping=0.1)),
    "rolling": lambda: arm(robot={"wheels": [Wheel("hand", 0.05)]}, ground=Ground(height=-10.0)),
    "rk4": lambda: pendulum(integrator="rk4"),
    "self_collisions": _colliding,
    "torsional_friction": _turning,
    "body_contacts": _touching,
    "contacts": box,
}


def _known(subject: Subject) -> None:
    with build(subject, busy(subject)) as simulation:
        unknown = simulation.features - FEATURES.keys()
        expect(not unknown, f"there are no features {sorted(unknown)}: see FEATURES")
        expect(simulation.engine, "its simulations do not name their engine")


def _honest(subject: Subject) -> None:
    with build(subject, busy(subject)) as simulation:
        for feature, call in _CALLS.items():
            _try(feature, simulation.features, functools.partial(call, simulation))


def _builds(subject: Subject) -> None:
    with build(subject, busy(subject)) as simulation:
        features = simulation.features
    for feature, world in _WORLDS.items():
        _try(feature, features, functools.partial(_run, subject, world))


def _run(subject: Subject, world: Callable[[], World]) -> None:
    with build(subject, world()) as simulation:
        simulation.step(3)


def _try(feature: str, features: frozenset[str], call: Callable[[], object]) -> None:
    has = feature in features
    try:
        call()
    except FeatureNotSupportedError as error:
        expect(not has, f'it claims the feature "{feature}", but says: {error}')
        return
    except Exception as error:
        what = "claims" if has else "does not claim"
        raise AssertionError(
            f'it {what} the feature "{feature}", and then raised {type(error).__name__}: {error}'
        ) from error
    expect(has, f'it has the feature "{feature}", but does not claim it')


def _spring(subject: Subject) -> None:
    with build(subject, arm()) as simulation:
        has_springs = "springs" in simulation.features
    if not has_springs:
        return
    settings = JointSettings(stiffness=200.0, damping=20.0, rest=0.5)
    world = arm(robot={"joints": {"elbow": settings}}, gravity=(0.0, 0.0, 0.0))
    with build(subject, world) as simulation:
        simulation.step(2500)
        place = simulation.layout.position_index["elbow"]
        angle = float(simulation.positions()[place])
    expect(abs(angle - 0.5) < 0.02, f"a spring with rest=0.5 rad settles at {angle:.3f} rad")


def _stops_spins(subject: Subject) -> None:
    need(subject, "torsional_friction")
    with build(subject, _turning()) as simulation:
        simulation.step(300)
        v = simulation.velocities()
        v[5] = 5.0
        simulation.set_state(simulation.positions(), v)
        simulation.step(100)
        speed, wanted = float(simulation.velocities()[5]), 5.0 - 0.1 * 0.01 * 9.81 / 0.004
        expect(
            abs(speed - wanted) < 0.15,
            f"torsional friction slows a ball down to {speed:.3f} instead of {wanted:.3f} rad/s",
        )


def _drives(subject: Subject) -> None:
    need(subject, "moving_statics")
    belt = Box(name="belt", size=(4.0, 1.0, 0.1), static=True, position=(0.0, 0.0, -0.05))
    load = Box(name="load", size=(0.2, 0.2, 0.2), position=(0.0, 0.0, 0.1), friction=0.5)
    with build(subject, World(objects=[load, belt], period=PERIOD)) as simulation:
        simulation.set_body("belt", BodySettings(surface_velocity=(0.5, 0.0, 0.0)))
        simulation.step(300)
        speed = float(simulation.body_velocities(["load"])[0, 0])
        expect(abs(speed - 0.5) < 0.01, f"a belt at 0.5 m/s carries a box at {speed:.3f} m/s")
        state = simulation.snapshot()
        simulation.set_body("load", BodySettings(hidden=True, mass=3.0))
        simulation.restore(state)
        expect(
            simulation.body_settings("load") == BodySettings(),
            "restore() does not undo what set_body() changed",
        )


CHECKS: dict[str, Check] = {
    "drives what lies on a belt": _drives,
    "stops what spins": _stops_spins,
    "claims features that exist": _known,
    "can do what its features say": _honest,
    "builds what its features say": _builds,
    "relaxes springs": _spring,
}
