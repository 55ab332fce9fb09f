from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from physx_core import plugins
from physx_sim import Box, JointSettings, Robot, Simulation, World
from physx_sim.errors import SimulationError
from physx_torch import ForwardDynamics

pytestmark = pytest.mark.processes

SPRUNG = JointSettings(stiffness=3.0, rest=0.2, damping=0.4, friction=0.1, armature=0.01)
WORLDS = {
    "arm": World([Robot("acrobot", joints={"elbow": SPRUNG})]),
    "floating base": World([Robot("ant", fixed_base=False)]),
    "two robots and a box": World(
        [Robot("cartpole", "cart"), Robot("ant", fixed_base=False)],
        objects=[Box(name="brick", size=(0.1, 0.2, 0.3), mass=2.0)],
        contacts="static",
    ),
}
KILLED = """
import os, signal, sys
import numpy as np
from physx_core import plugins
from physx_sim import Robot, World
simulation = plugins.resolve("backend", "pinocchio").build(World([Robot("double_pendulum")]))
simulation.forward_dynamics_batch(*np.zeros((3, 64, 2)), processes=3)
print("started", flush=True)
os.kill(os.getpid(), signal.SIGKILL) if sys.argv[1] == "kill" else None
"""


def workers():
    """Return the processes that compute batches for this one."""
    found = []
    for stat in (folder / "stat" for folder in Path("/proc").glob("[0-9]*")):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            command = stat.with_name("cmdline").read_bytes()
            if parent == os.getpid() and b"physx_dart.batch.worker" in command:
                found.append(int(stat.parent.name))
    return found


def there(process):
    """Return whether a process is there, be it as a zombie."""
    return Path(f"/proc/{process}").exists()


def shared_memory():
    """Return where this process holds memory that it shares with workers."""
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found.append(str(link.readlink()))
    return [link for link in found if "physx_batches" in link]


@pytest.mark.parametrize(
    ("name", "engine"), [*((name, "pinocchio") for name in WORLDS), ("floating base", "dart")]
)
def test_values_and_gradients_are_those_of_one_process_bit_for_bit(build, name, engine, draw):
    simulation = build(WORLDS[name], engine)
    for count in (50, 33, 131):  # of which none can be shared evenly, and the last needs more room
        states = draw(simulation, count)
        weights = torch.tensor(np.random.default_rng(5).normal(size=states[1].shape))
        expected = ForwardDynamics(simulation)(*states)
        found = ForwardDynamics(simulation, processes=3)(*states)
        assert torch.equal(found, expected)
        shared = torch.autograd.grad(found, states, weights)
        for mine, alone in zip(shared, torch.autograd.grad(expected, states, weights), strict=True):
            assert torch.equal(mine, alone)
    assert len(workers()) == 2


def test_leading_axes_are_broadcast(build, draw):
    simulation = build(WORLDS["floating base"])
    q, v, tau = draw(simulation, 5, 12)
    given = q[:, :1], v, tau[0, 0]
    expected = ForwardDynamics(simulation)(*given)
    found = ForwardDynamics(simulation, 2)(*given)
    assert found.shape == (5, 12, 14) and torch.equal(found, expected)
    (mine,), (alone,) = (torch.autograd.grad(each.sum(), tau) for each in (found, expected))
    assert torch.equal(mine, alone)


def test_small_batches_stay_in_this_process(build, draw):
    simulation = build(WORLDS["floating base"])
    dynamics = ForwardDynamics(simulation, processes=8)
    dynamics(*draw(simulation, 31)).sum().backward()
    assert dynamics(*draw(simulation, 0)).shape == (0, 14)
    assert not workers() and not shared_memory()
    dynamics(*draw(simulation, 50))
    assert len(workers()) == 2  # 16 rows for each process


def test_closing_the_simulation_leaves_nothing(build, draw):
    simulation = build(WORLDS["floating base"])
    dynamics = ForwardDynamics(simulation, processes=3)
    states = draw(simulation, 64)
    dynamics(*states)
    started = workers()
    assert len(started) == 2 and shared_memory()
    simulation.close()
    assert not any(map(there, started)) and not shared_memory()
    with pytest.raises(SimulationError, match="closed"):
        dynamics(*states)
    assert not workers()


def test_a_simulation_that_nobody_uses_leaves_nothing(draw):
    simulation = plugins.resolve("backend", "pinocchio").build(WORLDS["arm"])
    ForwardDynamics(simulation, processes=2)(*draw(simulation, 64))
    (started,) = workers()
    del simulation
    gc.collect()
    assert not there(started) and not shared_memory()


def test_a_process_that_is_killed_is_an_error_and_replaced(build, draw):
    simulation = build(WORLDS["floating base"])
    dynamics = ForwardDynamics(simulation, processes=3)
    states = draw(simulation, 64)
    found = dynamics(*states)
    started = workers()
    killed = started[0]
    os.kill(killed, signal.SIGKILL)
    with pytest.raises(SimulationError, match=rf"pid {killed}.* signal 9 \(SIGKILL\)"):
        found.sum().backward()
    assert not any(map(there, started)) and not shared_memory()
    assert torch.equal(dynamics(*states), ForwardDynamics(simulation)(*states))
    assert len(workers()) == 2


@pytest.mark.parametrize(
    ("program", "said"), [("false", "ended with exit status 1"), ("nothing-of-that-name", "start")]
)
def test_a_process_that_does_not_come_to_life_is_an_error(build, monkeypatch, program, said, draw):
    simulation = build(WORLDS["floating base"])
    states = draw(simulation, 64)
    monkeypatch.setattr(sys, "executable", shutil.which(program) or program)
    with pytest.raises(SimulationError, match=said):
        ForwardDynamics(simulation, processes=3)(*states)
    assert not workers() and not shared_memory()


def test_an_interrupted_batch_leaves_no_answer_for_the_next(build, monkeypatch, draw):
    simulation = build(WORLDS["floating base"])
    dynamics = ForwardDynamics(simulation, processes=2)
    states = draw(simulation, 64)
    dynamics(*states)
    started = workers()

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("physx_dart.batch.processes.compute", interrupt)
        with pytest.raises(KeyboardInterrupt):
            dynamics(*states)
    assert not any(map(there, started))
    other = states[0], 2 * states[1], states[2]
    assert torch.equal(dynamics(*other), ForwardDynamics(simulation)(*other))


@pytest.mark.parametrize("how", ["kill", "leave"])
def test_processes_end_with_the_one_that_started_them(how):
    command = [sys.executable, "-W", "error", "-c", KILLED, how]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        _, errors = run.communicate(timeout=60)  # which ends once nobody holds the pipes
    assert run.returncode == (-signal.SIGKILL if how == "kill" else 0) and errors == ""


def test_a_forked_process_computes_alone(build, draw):
    simulation = build(WORLDS["floating base"])
    arrays = [state.detach().numpy() for state in draw(simulation, 64)]
    expected = simulation.forward_dynamics_batch(*arrays, processes=2)
    started = workers()
    child = os.fork()
    if not child:
        signal.alarm(60)
        found = simulation.forward_dynamics_batch(*arrays, processes=2)
        simulation.close()
        os._exit(0 if (found == expected).all() else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert workers() == started
    assert (simulation.forward_dynamics_batch(*arrays, processes=2) == expected).all()


def test_an_engine_that_cannot_share_computes_alone(build, draw):
    simulation = build(WORLDS["floating base"])
    arrays = [state.detach().numpy() for state in draw(simulation, 40)]
    found = Simulation.forward_dynamics_batch(simulation, *arrays, processes=2)
    weights = np.ones_like(found)
    Simulation.forward_dynamics_gradients_batch(
        simulation, *arrays[:2], found, weights, processes=2
    )
    assert not workers()


@pytest.mark.parametrize("processes", [0, -1, 1.5, "2", None])
def test_mistakes_are_named(build, processes, draw):
    simulation = build(WORLDS["floating base"])
    arrays = [state.detach().numpy() for state in draw(simulation, 2)]
    with pytest.raises(SimulationError, match="processes is"):
        ForwardDynamics(simulation, processes)
    with pytest.raises(SimulationError, match="processes is"):
        simulation.forward_dynamics_batch(*arrays, processes=processes)
    with pytest.raises(SimulationError, match="processes is"):
        simulation.forward_dynamics_gradients_batch(*arrays, arrays[1], processes=processes)
