from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import plugins
from physx_sim import Box, JointSettings, Robot, Simulation, World
from physx_sim.errors import FeatureNotSupportedError, SimulationError
from physx_torch import ForwardDynamics

SPRUNG = JointSettings(stiffness=3.0, rest=0.2, damping=0.4, friction=0.1)
WORLDS = {
    "pendulum": World([Robot("double_pendulum")]),
    "sprung pendulum": World([Robot("acrobot", joints={"elbow": SPRUNG})]),
    "floating body": World([Robot("box", fixed_base=False)]),
    "floating base": World([Robot("ant", fixed_base=False)]),
    "two robots and a box": World(
        [Robot("cartpole", "cart"), Robot("ant", fixed_base=False)],
        objects=[Box(name="brick", size=(0.1, 0.2, 0.3), mass=2.0)],
        contacts="static",
    ),
}


@pytest.mark.parametrize("name", WORLDS)
def test_gradients_are_those_of_the_values(build, name, draw):
    simulation = build(WORLDS[name])
    states = draw(simulation, 2)
    assert torch.autograd.gradcheck(ForwardDynamics(simulation), states, eps=1e-5, atol=1e-5)


@pytest.mark.slow
def test_gradients_of_an_arm(build, draw):
    backend = plugins.resolve("backend", "pinocchio")
    if "ur/ur5_robot" not in [info.name for info in backend.robots()]:
        pytest.skip("example-robot-data is not installed")
    rotors = JointSettings(armature=0.1)  # links as light as its last ones make rounding errors
    joints = dict.fromkeys(("wrist_2_joint", "wrist_3_joint"), rotors)
    simulation = build(World([Robot("ur/ur5_robot", joints=joints)]))
    states = draw(simulation, 2)
    assert torch.autograd.gradcheck(ForwardDynamics(simulation), states, eps=1e-5, atol=1e-5)


@pytest.mark.parametrize("engine", ["dart", "pinocchio"])
@pytest.mark.parametrize("name", WORLDS)
def test_values_and_gradients_are_those_of_single_states(build, name, engine, draw):
    simulation = build(WORLDS[name], engine)
    states = draw(simulation, 5)
    arrays = [state.detach().numpy() for state in states]
    found = simulation.forward_dynamics_batch(*arrays)
    expected = Simulation.forward_dynamics_batch(simulation, *arrays)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())
    weights = np.random.default_rng(5).normal(size=found.shape)
    given = (*arrays[:2], found, weights)
    quick = simulation.forward_dynamics_gradients_batch(*given)
    slow = Simulation.forward_dynamics_gradients_batch(simulation, *given)
    np.testing.assert_allclose(quick, slow, rtol=1e-9, atol=1e-12 * abs(slow).max())


def test_without_gradients_the_values_are_the_same(build, draw):
    simulation = build(WORLDS["floating base"])
    states = draw(simulation, 5)
    dynamics = ForwardDynamics(simulation)
    tracked = dynamics(*states)
    with torch.no_grad():
        plain = dynamics(*states)
    assert tracked.requires_grad and not plain.requires_grad
    torch.testing.assert_close(tracked.detach(), plain, rtol=1e-9, atol=1e-9)
    only_torques = dynamics(states[0].detach(), states[1].detach(), states[2])
    (gradient,) = torch.autograd.grad(only_torques.sum(), states[2])
    assert gradient.shape == (5, 14)


def test_leading_axes_are_broadcast_and_types_kept(build, draw):
    simulation = build(WORLDS["floating base"])
    dynamics = ForwardDynamics(simulation)
    q, v, _ = draw(simulation, 3, 4)
    tau = torch.zeros(simulation.layout.nv, dtype=torch.float32, requires_grad=True)
    found = dynamics(q[:, :1], v, tau)
    assert found.shape == (3, 4, 14) and found.dtype == torch.float64
    found.sum().backward()
    assert tau.grad.shape == (14,) and tau.grad.dtype == torch.float32
    assert q.grad[:, 1:].abs().max() == 0 < q.grad[:, :1].abs().max()
    one = dynamics(q[0, 0].detach().float(), v[0, 0].detach().float(), tau)
    assert one.shape == (14,) and one.dtype == torch.float32
    torch.testing.assert_close(one.double(), found[0, 0], rtol=1e-3, atol=1e-3)
    assert dynamics(q[:, :0], v[:, :0], tau).shape == (3, 0, 14)


def test_mistakes_are_named(build, draw):
    simulation = build(WORLDS["floating body"])
    dynamics = ForwardDynamics(simulation)
    q, v, tau = (x.detach() for x in draw(simulation, 2))
    with pytest.raises(SimulationError, match="velocities have shape"):
        dynamics(q, v[:, :5], tau)
    with pytest.raises(SimulationError, match="finite"):
        dynamics(q, v * np.nan, tau)
    with pytest.raises(SimulationError, match=r'"robot".*not 1'):
        dynamics(2 * q, v, tau)
    with pytest.raises(SimulationError, match="2 positions, 1 velocities"):
        simulation.forward_dynamics_batch(q.numpy(), v[:1].numpy(), tau.numpy())
    simulation.close()
    with pytest.raises(SimulationError, match="closed"):
        dynamics(q, v, tau)
    simulation.features = frozenset()
    with pytest.raises(FeatureNotSupportedError):
        ForwardDynamics(simulation)
