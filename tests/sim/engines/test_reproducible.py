"""Reproducibility bit for bit, in a new process and after restore."""

from __future__ import annotations

import dataclasses
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from physx_core import plugins
from physx_sim import Box, Ground, Robot, Sphere, World, Wrench
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

DRIVE = """
import hashlib, pickle, sys
import numpy as np
from physx_core import plugins
from physx_sim import Wrench

def drive(simulation, frames):
    sums = hashlib.sha256()
    n = len(simulation.layout.joints)
    for k in range(frames):
        if k == 3:
            body = simulation.layout.bodies[0]
            simulation.apply_wrench(Wrench(body, force=(1.0, 2.0, 0), duration=0.06))
        simulation.set_commands(0.3 * np.sin(np.arange(n) + simulation.frame))
        simulation.step(10)
        for values in (simulation.positions(), simulation.velocities()):
            sums.update(values.tobytes())
        sums.update(simulation.contacts().tobytes())
    return sums.hexdigest()
"""
MAIN = """
engine, path = sys.argv[1:]
with open(path, "rb") as file:
    world = pickle.load(file)
with plugins.resolve("backend", engine).build(world) as simulation:
    print(drive(simulation, 15))
"""
names: dict = {}
exec(DRIVE, names)  # noqa: S102 - the text above, which the new process runs too
drive = names["drive"]
CASES = [
    ("dart", None, None),
    ("dart", "fcl", None),
    ("dart", None, "dantzig"),
    ("dart", None, "fbf"),
    ("dart", "bullet", None),
    ("dart", "ode", None),
    ("pinocchio", None, "pgs"),
    ("pinocchio", None, "admm"),
]


@pytest.fixture(params=CASES, ids=str)
def case(request, example):
    engine, detector, solver = request.param
    robot = Robot(
        example("a1_description/urdf/a1.urdf"), "a1", fixed_base=False, position=(0, 0, 0.33)
    )
    things = [
        Box(name="box", size=(0.2, 0.1, 0.3), position=(1, 0, 0.22), orientation=(0.6, 0, 0, 0.8)),
        Sphere(name="ball", radius=0.1, position=(0, 1, 0.12), restitution=0.5),
    ]
    world = World([robot], objects=things, ground=Ground(friction=0.7), contacts="static")
    return engine, dataclasses.replace(world, detector=detector, solver=solver)


def test_a_new_process_gives_the_same_bits(case, tmp_path):
    engine, world = case
    with plugins.resolve("backend", engine).build(world) as simulation:
        here = drive(simulation, 15)
    path = tmp_path / "world"
    path.write_bytes(pickle.dumps(world))
    there = subprocess.run(
        [sys.executable, "-c", DRIVE + MAIN, engine, str(path)],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    assert there.stdout.split()[-1] == here


def test_restore_gives_the_same_bits_in_contact(case):
    engine, world = case
    backend = plugins.resolve("backend", engine)
    with backend.build(world) as simulation, backend.build(world) as other:
        drive(simulation, 10)
        state = pickle.loads(pickle.dumps(simulation.snapshot()))  # noqa: S301 - our own
        expected = drive(simulation, 6)
        assert "exact_restore" in simulation.features
        simulation.set_state(simulation.positions(), -3 * simulation.velocities())
        simulation.step(20)
        for one in (simulation, other):
            one.restore(state)
            assert one.frame == state.frame
            assert drive(one, 6) == expected


def test_a_snapshot_of_another_world_is_rejected(case, bar):
    engine, world = case
    backend = plugins.resolve("backend", engine)
    with backend.build(world) as simulation, backend.build(World([bar()])) as other:
        before = simulation.positions()
        with pytest.raises(SimulationError, match="shape"):
            simulation.restore(other.snapshot())
        state = simulation.snapshot()
        for broken in (
            dataclasses.replace(state, native=state.native[:-1]),
            dataclasses.replace(state, positions=np.full(simulation.layout.nq, np.nan)),
            dataclasses.replace(state, frame=-1),
            "state",
        ):
            with pytest.raises(SimulationError):
                simulation.restore(broken)
        np.testing.assert_array_equal(simulation.positions(), before)


def test_a_diverged_world_can_be_restored(case):
    engine, world = case
    with plugins.resolve("backend", engine).build(world) as simulation:
        state = simulation.snapshot()
        expected = drive(simulation, 5)
        simulation.restore(state)
        v = simulation.velocities()
        v[-6:-3] = 9e7
        simulation.set_state(simulation.positions(), v)
        simulation.apply_wrench(Wrench("ball", force=(0, 0, 1e12)))
        with pytest.raises(SimulationError, match="no longer finite"):
            simulation.step(50)
        simulation.restore(state)
        assert drive(simulation, 5) == expected
