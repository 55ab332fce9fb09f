"""Thousands of random calls, most of them invalid: each returns or raises an error of physx."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from sizes import trials

pytestmark = pytest.mark.processes

CAMPAIGN = r"""
import dataclasses, gc, json, random, sys
import numpy as np
from physx_core import plugins
from physx_sim import Box, Ground, HeightField, JointSettings, Robot, Sphere, World, Wrench
from physx_core.errors import PhysxError
from physx_sim import State
from physx_dart.environments.double_pendulum import URDF

engine, seed, calls = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
rng = random.Random(seed)
backend = plugins.resolve("backend", engine)
numbers = [0, 1, -1, 1e-9, 3.5, 1e30, -1e300, float("nan"), float("inf"), None, "x", 10**400, 1j]


def array(length):
    kind = rng.randrange(8)
    if kind < 3:
        return np.random.default_rng(rng.randrange(99)).normal(size=length)
    if kind == 3:
        return np.full(length, rng.choice([np.nan, np.inf, 1e200, 1e308, 0.0]))
    if kind == 4:
        return np.zeros(max(0, length + rng.choice([-2, -1, 1, 5])))
    if kind == 5:
        return rng.choice([None, "text", [], [[1.0]], {}, object(), np.zeros((length, 2)), 3.0])
    if kind == 6:
        return [rng.choice(numbers) for _ in range(length)]
    return np.zeros(length)


def positions(simulation):
    q = simulation.positions()
    return q if rng.random() < 0.5 else array(simulation.layout.nq)


def name(simulation):
    names = list(simulation.layout.names) if rng.random() < 0.7 else []
    return rng.choice([*names, "", "nobody", "ground", None, 7, "../x", "a" * 999, ("a",)])


def wrench(simulation):
    return Wrench(
        name(simulation), force=array(3), torque=array(3), point=array(3),
        frame=rng.choice(["world", "body", "moon"]), duration=rng.choice(numbers[:9]),
        times=rng.choice([None, None, array(3), [0.0, 0.01]]),
    )


def hook(simulation):
    rng.choice([simulation.step, simulation.positions, simulation.contacts, lambda: 1 / 1])()


CALLS = [
    lambda s: s.set_torques(array(len(s.layout.joints))),
    lambda s: s.set_commands(array(len(s.layout.joints))),
    lambda s: s.step(rng.choice([0, 1, 2, 7, -1, 1.5, None, "3", True, np.int64(2), np.nan])),
    lambda s: s.step(3),
    lambda s: s.positions(rng.choice([None, array(s.layout.nq), np.zeros(s.layout.nq, "f4")])),
    lambda s: s.velocities(rng.choice([None, array(s.layout.nv)])),
    lambda s: s.set_state(positions(s), array(s.layout.nv)),
    lambda s: s.restore(s.snapshot()),
    lambda s: s.restore(rng.choice([None, 3, {}])),
    lambda s: s.restore(dataclasses.replace(s.snapshot(), native=(array(2), array(3)))),
    lambda s: s.restore(dataclasses.replace(s.snapshot(), commands=array(2), frame=array(1))),
    lambda s: s.restore(State(array(s.layout.nq), array(s.layout.nv), array(2), 3)),
    lambda s: s.body_poses(rng.choice([None, [name(s)], name(s), [name(s)] * 3]), positions(s)),
    lambda s: s.body_velocities([name(s)], positions(s), array(s.layout.nv)),
    lambda s: s.forward_dynamics(positions(s), array(s.layout.nv), array(s.layout.nv)),
    lambda s: s.inverse_dynamics(positions(s), array(s.layout.nv), array(s.layout.nv)),
    lambda s: s.forward_dynamics_derivatives(positions(s), array(s.layout.nv), array(s.layout.nv)),
    lambda s: s.mass_matrix(positions(s)),
    lambda s: s.jacobian(name(s), positions(s), array(3)),
    lambda s: s.accelerations(),
    lambda s: s.commands(),
    lambda s: s.body_motions(rng.choice([None, [name(s)], name(s), [name(s), 3]])),
    lambda s: s.body_accelerations(rng.choice([[], [[]], 3, [name(s)] * 2])),
    lambda s: s.contacts()[rng.choice([0, -1, 99])] if len(s.contacts()) else None,
    lambda s: s.raycast([array(3)], [array(3)]),
    lambda s: s.apply_wrench(wrench(s)),
    lambda s: s.remove_wrench(rng.choice([0, 1, 99, None, "x"])),
    lambda s: s.add_hook(rng.choice([hook, hook, None, 3]), rng.choice([1, 2, 0, None])),
    lambda s: s.remove_hook(hook),
    lambda s: s.frame + s.time,
    lambda s: s.close(),
]


def world():
    arm = Robot(URDF, "arm", joints={
        rng.choice(["elbow", "elbow", "nobody"]):
        JointSettings(mode=rng.choice(["force", "servo", "velocity", "position"]))
    })
    things = [
        Box(name="box", size=(0.2, 0.2, 0.2), position=(1, 0, 0.2)),
        Sphere(name="ball", radius=0.1, position=(0, 1, 0.3), restitution=0.5),
        Box(name="wall", size=(0.2, 2, 2), position=(3, 0, 0), static=True),
    ]
    ground = rng.choice([Ground(), Ground(), None, HeightField(np.zeros((3, 3)), (2.0, 2.0))])
    contacts = rng.choice(["static", "static", "none"] if engine == "pinocchio" else ["all"])
    detector = None if engine == "pinocchio" else rng.choice([None, "fcl", "bullet", "ode"])
    return World([arm], objects=things, ground=ground, contacts=contacts, detector=detector)


counts = {"returned": 0, "rejected": 0, "built": 0}
simulation, kept = None, []
for _ in range(calls):
    if simulation is None or rng.random() < 0.004:
        try:
            simulation = backend.build(world())
            counts["built"] += 1
        except PhysxError:
            continue
    call = rng.choice(CALLS)
    try:
        kept.append(call(simulation))
        counts["returned"] += 1
    except PhysxError as error:
        assert len(str(error)) > 10, error
        counts["rejected"] += 1
    if rng.random() < 0.01:
        kept.clear()
        gc.collect()
    try:
        simulation.frame
    except PhysxError:
        if rng.random() < 0.3:  # calls on a closed world, and then a new one
            simulation = None
print(json.dumps(counts))
"""


def campaign(engine, seed, calls):
    done = subprocess.run(
        [sys.executable, "-c", CAMPAIGN, engine, str(seed), str(calls)],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    counts = json.loads(done.stdout.splitlines()[-1])
    assert counts["built"] > calls / 500
    assert counts["returned"] + counts["rejected"] > 0.9 * calls
    assert min(counts["returned"], counts["rejected"]) > calls / 5


@pytest.mark.parametrize("engine", ["dart", "pinocchio"])
def test_random_calls_return_or_are_rejected(engine):
    campaign(engine, 0, 1000)


@pytest.mark.faults
@pytest.mark.parametrize("engine", ["dart", "pinocchio"])
@pytest.mark.parametrize("seed", [1, 2])
def test_ten_thousand_random_calls_return_or_are_rejected(engine, seed):
    campaign(engine, seed, trials(10_000, 3000))
