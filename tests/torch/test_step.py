from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_sim import (
    Box,
    Capsule,
    Connect,
    Cylinder,
    Ground,
    HeightField,
    JointCoupling,
    JointSettings,
    Mimic,
    Robot,
    Sphere,
    World,
    Wrench,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError
from physx_torch import Step

GROUND = Ground(friction=0.5)
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
DIFFERENTIAL = JointCoupling({"shoulder": 1, "elbow": 2}, 0.5)
LIMITED = {"shoulder": JointSettings(damping=0.2), "elbow": JointSettings(friction=0.3)}


def block(*, q=(0.0, 0.0, 0.1499), v=(0.0,) * 6, turn=UPRIGHT):
    world = World(objects=[Box(name="a", size=(0.1, 0.2, 0.3), mass=2.0)], ground=GROUND)
    return world, [*q, *turn], v, []


def ball(*, height, v):
    world = World(objects=[Sphere(name="a", radius=0.1, mass=2.0)], ground=GROUND)
    return world, [0.1, 0.2, height, 0.5, 0.5, 0.5, 0.5], v, []


def arm(joints, q, v, u, **options):
    return World([Robot("double_pendulum", joints=joints)], **options), q, v, u


TURN = [0.1, -0.3, 0.2, float(np.sqrt(1 - 0.14))]
SLOPE = HeightField(
    heights=np.add.outer(0.1 * np.arange(4), [0.0, 0.02, 0.1, 0.1]), spacing=(1.0, 1.0)
)
CASES = {
    "open": ball(height=0.3, v=[1.0, 0.5, 0.0, 0.0, 2.0, 0.1]),
    "tumbling": block(q=(0.0, 0.0, 1.0), v=[1.0, 0.5, 0.3, 1.0, 2.0, -3.0], turn=TURN),
    "rolling": ball(height=0.0999, v=[0.02, 0.01, -0.1, 0.2, 0.05, 0.1]),
    "sliding": ball(height=0.0999, v=[1.0, 0.5, 0.0, 0.0, 2.0, 0.1]),
    "sliding on four corners": block(v=[1.0, 0.5, 0.0, 0.0, 0.0, 0.1]),
    "sticking on four corners": block(v=[1e-3, 2e-3, 0.0, 1e-3, 0.0, 1e-3]),
    "resisting turns": (
        World(
            objects=[
                Sphere(name="a", radius=0.1, rolling_friction=1e-3, torsional_friction=2e-3)
            ],
            ground=GROUND,
        ),
        [0.1, 0.2, 0.0999, 0.5, 0.5, 0.5, 0.5],
        [0.02, 0.01, -0.1, 2.0, 0.5, 1.0],
        [],
    ),
    "held against turns": (
        World(
            objects=[Sphere(name="a", radius=0.1, rolling_friction=0.02, torsional_friction=0.1)],
            ground=GROUND,
        ),
        [0.1, 0.2, 0.0999, 0.5, 0.5, 0.5, 0.5],
        [1e-3, -0.1, 1e-3, 1e-3, 2e-3, 1e-3],
        [],
    ),
    "grazing": ball(height=0.10001, v=[1.0, 0.5, -0.02, 0.0, 2.0, 0.1]),
    "hitting": block(q=(0.0, 0.0, 0.12), v=[1.0, 0.5, -2.0, 1.0, 2.0, -3.0], turn=TURN),
    "capsule": (
        World(objects=[Capsule(name="a", radius=0.05, length=0.2, mass=1.0)], ground=GROUND),
        [0.0, 0.0, 0.0499, float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))],
        [0.3, 0.1, -0.1, 0.5, 0.0, 0.2],
        [],
    ),
    "height field": (
        World(objects=[Sphere(name="a", radius=0.1, mass=2.0)], ground=SLOPE),
        [0.3, 0.1, 0.28, *UPRIGHT],
        [0.5, 0.1, -0.3, 0.5, 0.0, 0.2],
        [],
    ),
    "friction of joints": arm(LIMITED, [0.3, 0.5], [0.2, 0.4], [0.1, 0.2]),
    "joints at rest": arm(
        {**LIMITED, "elbow": JointSettings(friction=5.0)}, [0.3, 0.5], [0.0, 0.0], [0.1, 0.2]
    ),
    "servo": arm({"elbow": JointSettings(mode="servo")}, [0.3, 0.5], [0.2, 0.4], [0.1, 0.2]),
    "spring": arm(
        {"elbow": JointSettings(stiffness=3.0, rest=0.2, damping=0.4, armature=0.1)},
        [0.3, 0.5], [0.2, 0.4], [0.1, 0.2],
    ),
    "followed": arm(
        {"elbow": JointSettings(mimic=Mimic("shoulder", 0.5))}, [0.3, 0.15], [0.2, 0.1], [0.1, 0.2]
    ),
    "coupled": (
        World([Robot("double_pendulum", couplings=[DIFFERENTIAL])]),
        [0.3, 0.1], [0.2, -0.1], [0.1, 0.2],
    ),
}  # fmt: skip


def joined(step, *states):
    return torch.cat(step(*states))


def error(step, states):
    """Return the difference of gradients from central differences, relative to the largest."""
    states = [torch.tensor(values, dtype=torch.float64) for values in states]
    found = torch.autograd.functional.jacobian(lambda *rows: joined(step, *rows), tuple(states))
    columns, size = [], 1e-6
    for place, values in enumerate(states):
        for unit in torch.eye(len(values), dtype=torch.float64):
            two = []
            for sign in (-1.0, 1.0):
                moved = list(states)
                moved[place] = values + sign * size * unit
                two.append(joined(step, *moved))
            columns.append((two[1] - two[0]) / (2 * size))
    wanted = torch.stack(columns, dim=1)
    return float((torch.cat(found, dim=1) - wanted).abs().max() / wanted.abs().max())


def ant(build, sink=2e-4):
    """Return an ant that has moved on the ground, its state and commands, away from switches."""
    world = World([Robot("ant", fixed_base=False)], ground=Ground(friction=0.8), period=5e-3)
    simulation, random = build(world), np.random.default_rng(0)
    q = simulation.positions()
    q[2] = 0.6
    simulation.set_state(q, np.zeros(14))
    for _ in range(200):
        simulation.set_commands(random.uniform(-1, 1, 8))
        simulation.step(1)
    q = simulation.positions()
    q[2] -= sink
    return simulation, [q, simulation.velocities(), random.uniform(-1, 1, 8)]


@pytest.mark.parametrize("name", CASES)
def test_gradients_of_a_step_are_those_of_central_differences(build, name):
    world, *states = CASES[name]
    assert error(Step(build(world)), states) < 1e-6


def test_gradients_of_a_robot_with_many_contacts_and_limits(build):
    simulation, states = ant(build)
    assert error(Step(simulation), states) < 1e-6
    assert len(simulation.contacts()) >= 4
    assert error(Step(simulation, steps=32), states) < 1e-5


def test_robots_that_do_not_touch_do_not_depend_on_each_other(build):
    world = World(
        [
            Robot("double_pendulum", "arm", position=(0.0, 0.0, 5.0)),
            Robot("ant", fixed_base=False, position=(3.0, 0.0, 0.6)),
        ],
        objects=[Box(name="brick", size=(0.1, 0.2, 0.3), mass=2.0, position=(-3.0, 0.0, 0.2))],
        ground=GROUND,
    )
    simulation = build(world)
    simulation.step(100)
    states = [simulation.positions(), simulation.velocities() + 0.01, np.full(10, 0.1)]
    assert error(Step(simulation), states) < 1e-6


def test_batches_are_single_states_in_the_dtype_given(build):
    simulation, states = ant(build)
    q, v, u = (torch.tensor(np.array(values), dtype=torch.float32) for values in states)
    u = (u * torch.tensor([[1.0], [0.5]])).requires_grad_()
    step = Step(simulation, steps=2, compare_sides=True)
    after = step(q, v, u)
    assert [tuple(each.shape) for each in after] == [(2, 15), (2, 14)]
    assert after[0].dtype == torch.float32 and step.asymmetry.shape == (2,)
    (together,) = torch.autograd.grad(after[1].sum(), u)
    for row, wanted in zip(u, together, strict=True):
        (alone,) = torch.autograd.grad(step(q, v, row)[1].sum(), row)
        torch.testing.assert_close(alone, wanted)
    with torch.no_grad():
        torch.testing.assert_close(step(q, v, u), tuple(each.detach() for each in after))


def test_switches_show_in_asymmetry_and_hyperstatic_contacts_do_not(build):
    world, q, v, u = block()
    step = Step(build(world), compare_sides=True)
    at_rest = [torch.tensor(values, dtype=torch.float64).requires_grad_() for values in (q, v, u)]
    step(*at_rest)
    assert step.asymmetry < 1e-3  # all four corners carry; any share of the load would do
    world, q, v, u = ball(height=0.1 + 1e-3 * 0.02, v=[0.0, -0.02 + 9.81e-3, 0.0, 0.0, 0.0, 0.0])
    step = Step(build(world), compare_sides=True)
    step(*(torch.tensor(values, dtype=torch.float64).requires_grad_() for values in (q, v, u)))
    assert step.asymmetry > 0.1  # it is about to touch


def test_commands_beyond_their_limits_have_no_gradient(build):
    simulation = build(World([Robot("acrobot")]))
    u = torch.tensor([100.0, 1.0], dtype=torch.float64, requires_grad=True)
    _, v = Step(simulation)(torch.zeros(2), torch.zeros(2), u)
    (found,) = torch.autograd.grad(v[0], u)
    assert found[0] == 0 and found[1] != 0


def tower():
    boxes = [
        Box(name=name, size=(0.1, 0.1, 0.1), position=(0, 0, height), mass=1.0)
        for name, height in (("low", 0.05), ("high", 0.15))
    ]
    return World(objects=boxes, ground=GROUND)


def dropped(shape, **options):
    """Return a world and a state in which an object hits the ground."""
    world = World(objects=[shape], ground=options.pop("ground", GROUND))
    return world, [*options.pop("at", (0.0, 0.0, 0.1)), *UPRIGHT], [0.1, 0, -1, 0, 0.1, 0], []


REFUSED = {
    "shapes of bodies touch": (tower(), None, None, None),
    "a contact bounces": dropped(Sphere(name="a", radius=0.1, mass=1.0, restitution=0.5)),
    "cylinder rolls": dropped(Cylinder(name="a", radius=0.1, length=0.2, mass=1.0)),
    "an edge of a height field": dropped(
        Sphere(name="a", radius=0.1, mass=1.0), ground=SLOPE, at=(0.5, 0.5, 0.15)
    ),
    "attachments": (
        World([Robot("double_pendulum")], attachments=[Connect("lower")]), None, None, None,
    ),
    'the mode "position"': arm(
        {"elbow": JointSettings(mode="position")}, [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
    ),
}  # fmt: skip


@pytest.mark.parametrize("reason", REFUSED)
def test_steps_without_derivatives_are_refused_with_the_reason(build, reason):
    world, *states = REFUSED[reason]
    simulation = build(world)
    if states[0] is not None:
        simulation.set_state(*states[:2])
    with pytest.raises(SimulationError, match=reason):
        simulation.step_with_derivatives()


def test_influences_are_refused(build):
    simulation = build(World([Robot("double_pendulum")]))
    number = simulation.apply_wrench(Wrench("lower", force=(1.0, 0.0, 0.0)))
    with pytest.raises(SimulationError, match="wrenches"):
        simulation.step_with_derivatives()
    simulation.remove_wrench(number)
    simulation.add_hook(lambda _: None)
    with pytest.raises(SimulationError, match="hooks"):
        simulation.step_with_derivatives()


def test_engines_without_derivatives_of_steps_are_refused(build):
    world = World([Robot("double_pendulum")])
    with pytest.raises(FeatureNotSupportedError, match="step_derivatives"):
        Step(build(world, "dart"))
    with pytest.raises(FeatureNotSupportedError, match="step_derivatives"):
        Step(build(World([Robot("double_pendulum")], integrator="rk4", contacts="none")))
    with pytest.raises(SimulationError, match="steps is 0"):
        Step(build(world), 0)
    with pytest.raises(SimulationError, match="commands have shape"):
        Step(build(world))(torch.zeros(2), torch.zeros(2), torch.zeros(3))
