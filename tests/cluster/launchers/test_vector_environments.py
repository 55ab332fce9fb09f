"""Vector environments whose processes run on the nodes of a cluster."""

import contextlib

import gymnasium
import numpy as np
import pytest

import physx_gym  # noqa: F401 - registers the environments

pytestmark = pytest.mark.processes

pytest.importorskip("ray")
COUNT = 5


@contextlib.contextmanager
def cartpoles(**options):
    vector = gymnasium.make_vec("physx/Cartpole-v0", COUNT, num_processes=2, **options)
    with contextlib.closing(vector):
        yield vector


def assert_same(vector, other, steps):
    for _ in range(steps):
        actions = other.action_space.sample()
        results = zip(vector.step(actions)[:4], other.step(actions)[:4], strict=True)
        for found, expected in results:
            np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["ray", "slurm"])
def test_steps_are_those_of_processes_that_share_memory(launcher, request, tmp_path, monkeypatch):
    options = {"launcher": f"cluster/{launcher}"}
    if launcher == "ray":
        variables = request.getfixturevalue("ray_cluster").variables
        options["launcher_kwargs"] = {"address": variables["RAY_ADDRESS"]}
    else:  # its local executor
        monkeypatch.chdir(tmp_path)
        options["launcher_kwargs"] = {"cluster": "local"}
    with cartpoles() as local, cartpoles(**options) as vector:
        np.testing.assert_array_equal(vector.reset(seed=2)[0], local.reset(seed=2)[0])
        local.action_space.seed(0)
        assert_same(vector, local, 30)


@pytest.mark.faults
def test_killed_ray_node_restarts_vector_environment(ray_cluster):
    lost = ray_cluster.nodes.pop()
    kwargs = {"address": ray_cluster.variables["RAY_ADDRESS"], "num_cpus": 0.5}
    options = {"launcher": "cluster/ray", "launcher_kwargs": kwargs, "retries": 1}
    with cartpoles() as local, cartpoles(**options) as vector:
        vector.reset(seed=2)
        local.reset(seed=2)
        local.action_space.seed(0)
        assert_same(vector, local, 10)
        ray_cluster.kill(lost)
        ray_cluster.nodes.append(ray_cluster.add_node())
        assert_same(vector, local, 30)
