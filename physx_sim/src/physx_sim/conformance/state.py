"""Checks of states: layout, snapshots, repetition, refusals, and closing."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import numpy as np

from physx_core.net import decode, encode
from physx_core.states import Baseline
from physx_core.typing import Batch
from physx_sim import Robot, Simulation, World
from physx_sim.conformance.worlds import (
    ARM_JOINTS,
    arm,
    ball,
    build,
    busy,
    need,
    pendulum,
    state_of,
)
from physx_sim.errors import ModelError, SimulationError
from physx_testing.subject import Check, Subject, expect, expect_close, expect_equal


def _now(simulation: Simulation) -> Batch:
    return {
        "positions": simulation.positions().copy(),
        "velocities": simulation.velocities().copy(),
    }


def _layout(subject: Subject) -> None:
    with build(subject, arm(robot={"fixed_base": False})) as simulation:
        layout = simulation.layout
        expect(
            layout.joints == ARM_JOINTS,
            f"the joints are {layout.joints}, not in the order of the file: {ARM_JOINTS}",
        )
        expect((layout.nq, layout.nv) == (10, 9), f"nq, nv are {layout.nq}, {layout.nv}, not 10, 9")
        places = [layout.position_index[name] for name in ARM_JOINTS]
        expect(places == [7, 8, 9], f"the joints' positions are at {places}, not after the base")
        places = [layout.velocity_index[name] for name in ARM_JOINTS]
        expect(places == [6, 7, 8], f"the joints' velocities are at {places}, not after the base")
        expect_close(layout.lower, [-1.5, -2, -0.1], 1e-12, "lower limits differ from the file's")
        expect_close(layout.upper, [1.2, 2, 0.2], 1e-12, "upper limits differ from the file's")
        expect_close(layout.max_torque, [60, 40, 30], 1e-12, "torque limits differ from the file's")
        expect(layout.units == ("rad", "rad", "m"), f"the joints' units are {layout.units}")
        for link in ("trunk", "upper", "fore", "hand"):
            expect(link in layout.bodies, f'the link "{link}" is not among the bodies')
        expect(simulation.positions().shape == (10,), "positions() does not have the shape (nq,)")
        expect(simulation.velocities().shape == (9,), "velocities() does not have the shape (nv,)")
        quaternion = simulation.positions()[3:7]
        expect_close(quaternion, [0, 0, 0, 1], 1e-12, "the neutral orientation is not x, y, z, w")


def _copies(subject: Subject) -> None:
    with build(subject, arm()) as simulation:
        wanted = _now(simulation)
        for read in (simulation.positions, simulation.velocities):
            found = read()
            found += 7.0
            out = np.empty(3)
            expect(read(out) is out, f"{read.__name__}(out) does not return out")
            out += 7.0
        expect_equal(
            _now(simulation), wanted, "the state changed when a returned array was written to"
        )
        positions, velocities = state_of(simulation)
        given = positions.copy()
        simulation.set_state(given, velocities)
        given += 7.0
        expect_close(simulation.positions(), positions, 1e-12, "set_state() keeps the given array")


def _restores(subject: Subject) -> None:
    with build(subject, busy(subject)) as simulation, build(subject, busy(subject)) as other:
        torques = np.array([2.0, -1.0, 1.0])
        simulation.set_torques(torques)
        simulation.step(120)
        state = simulation.snapshot()
        at = _now(simulation)
        simulation.step(80)
        wanted = _now(simulation)
        simulation.set_torques(np.zeros(3))
        stored = pickle.loads(pickle.dumps(state))  # noqa: S301 - of this process
        for name, one in (("its simulation", simulation), ("another simulation", other)):
            one.restore(stored)
            expect(one.frame == 120, f"after restore() frame is {one.frame}, not 120")
            exactly = "exact_restore" in simulation.features
            found = _now(one)
            for field, values in at.items():
                expect_close(found[field], values, 1e-12, f"restored in {name}, {field} differ")
            expect_close(one.commands(), torques, 1e-12, f"restored in {name}, commands differ")
            one.step(80)
            if exactly:
                expect_equal(
                    _now(one),
                    wanted,
                    f"restored in {name}, what follows is not bit-identical",
                )
            else:
                expect_close(
                    one.positions(), wanted["positions"], 1e-2, f"restored in {name}, it diverges"
                )


class _Holder:
    """What an environment is to its state: an object that has a simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation


def _continues(subject: Subject) -> None:
    need(subject, "exact_restore")
    for steps in (0, 150, 190):  # the box and the ball touch the ground, and slide on it
        with build(subject, busy(subject)) as simulation, build(subject, busy(subject)) as other:
            simulation.set_torques(np.array([2.0, -1.0, 1.0]))
            simulation.step(steps)
            _expect_futures(simulation, other, f"after {steps} steps")


def _expect_futures(simulation: Simulation, other: Simulation, when: str) -> None:
    """Expect that another simulation goes on alike, however it gets the state."""
    here, there = (Baseline(_Holder(each)) for each in (simulation, other))
    state, snapshot = encode(here.capture(), "state"), simulation.snapshot()
    ways: dict[str, Callable[[], None]] = {
        "the state of an environment": lambda: there.restore(decode(state)),
        "a pickled snapshot": lambda: other.restore(pickle.loads(pickle.dumps(snapshot))),  # noqa: S301
        "a copied snapshot": lambda: other.restore(copy.deepcopy(snapshot)),
    }
    simulation.step(60)
    for name, restore in ways.items():
        restore()
        other.step(60)
        expect_equal(_now(other), _now(simulation), f"{when}, {name} has another future")


def _state_alone(subject: Subject) -> None:
    need(subject, "exact_restore")
    with build(subject, busy(subject)) as simulation:
        simulation.step(150)  # the box and the ball touch the ground
        positions, velocities = simulation.positions().copy(), simulation.velocities().copy()
        found = []
        for disturbance in (0, 37):
            simulation.step(disturbance)
            simulation.set_state(positions, velocities)
            simulation.step(40)
            found.append(_now(simulation))
        expect_equal(
            found[1],
            found[0],
            "set to the same state after other motions, it moves differently: it keeps something "
            "from before, such as contacts or impulses",
        )


def _repeats(subject: Subject) -> None:
    found = []
    for _ in range(2):
        with build(subject, busy(subject)) as simulation:
            simulation.set_torques(np.array([2.0, -1.0, 1.0]))
            simulation.step(200)
            found.append(_now(simulation))
    expect_equal(found[1], found[0], "a second simulation of the same world moves differently")


def _independent(subject: Subject) -> None:
    with build(subject, busy(subject)) as alone:
        alone.step(100)
        wanted = _now(alone)
    with (
        build(subject, busy(subject)) as one,
        build(subject, pendulum(gravity=(0.0, 0.0, -1.0))) as other,
    ):
        for _ in range(10):
            one.step(10)
            other.set_state(np.array([1.0]), np.array([3.0]))
            other.step(3)
        expect_equal(
            _now(one), wanted, "next to another simulation it moves differently than alone"
        )


def _refuses(subject: Subject) -> None:
    with build(subject, arm()) as simulation, build(subject, ball()) as other:
        simulation.set_state(*state_of(simulation))
        wanted, zeros = _now(simulation), np.zeros(3)
        nan, infinite = np.array([0, np.nan, 0]), np.array([np.inf, 0, 0])
        wrong: dict[str, Callable[[], object]] = {
            "positions with NaN": lambda: simulation.set_state(nan, zeros),
            "infinite velocities": lambda: simulation.set_state(zeros, infinite),
            "positions of the wrong shape": lambda: simulation.set_state(np.zeros(4), zeros),
            "torques with NaN": lambda: simulation.set_torques(nan),
            "torques of the wrong shape": lambda: simulation.set_torques(np.zeros(2)),
            "a body that does not exist": lambda: simulation.body_poses(["nobody"]),
            "a snapshot of another world": lambda: simulation.restore(other.snapshot()),
        }
        for what, call in wrong.items():
            try:
                call()
            except SimulationError:
                continue
            except Exception as error:
                raise AssertionError(
                    f"for {what} it raised {type(error).__name__}: {error}; it must raise "
                    "SimulationError"
                ) from error
            raise AssertionError(f"it accepted {what}")
        expect_equal(_now(simulation), wanted, "a call that it refused changed the state")


def _needs_files(subject: Subject) -> None:
    try:
        build(subject, World(robots=[Robot(subject.folder / "nowhere.urdf")])).close()
    except ModelError as error:
        expect("nowhere.urdf" in str(error), f"the error does not name the file: {error}")
        return
    raise AssertionError("it built a robot from a file that does not exist")


def _ends(subject: Subject) -> None:
    simulation = build(subject, arm())
    zeros = np.zeros(3)
    simulation.close()
    simulation.close()
    calls: dict[str, Callable[[], object]] = {
        "step()": simulation.step,
        "positions()": simulation.positions,
        "set_state()": lambda: simulation.set_state(zeros, zeros),
        "set_torques()": lambda: simulation.set_torques(zeros),
        "snapshot()": simulation.snapshot,
        "body_poses()": simulation.body_poses,
        "forward_dynamics()": lambda: simulation.forward_dynamics(zeros, zeros, zeros),
    }
    for name, call in calls.items():
        try:
            call()
        except SimulationError:
            continue
        raise AssertionError(f"after close() {name} did not raise SimulationError")


def _keeps_world(subject: Subject) -> None:
    world = busy(subject)
    before = copy.deepcopy(world)
    with build(subject, world) as simulation:
        simulation.step(5)
    expect(world == before, "it changed the World that it was given")


CHECKS: dict[str, Check] = {
    "describes its layout as the file does": _layout,
    "gives copies of its state": _copies,
    "restores snapshots": _restores,
    "continues from states and snapshots, in the middle of contacts too": _continues,
    "depends on nothing but the state that is set": _state_alone,
    "moves the same again": _repeats,
    "does not disturb another simulation": _independent,
    "refuses states and torques that make no sense": _refuses,
    "refuses files that do not exist": _needs_files,
    "ends once and for all": _ends,
    "does not change the world that it gets": _keeps_world,
}
