from __future__ import annotations

import shutil

import numpy as np
import pytest

from physx_core import plugins
from physx_core.cli import main
from physx_sim import Ground, Robot, World
from physx_sim.engines import find_robot, named_robots
from physx_sim.errors import ModelError

OWN = {
    "acrobot": (2, "primitives"),
    "ant": (8, "primitives"),
    "box": (0, "primitives"),
    "cartpole": (2, "primitives"),
    "double_pendulum": (2, "none"),
    "wheeled_base": (4, "primitives"),
}


@pytest.mark.parametrize("name", OWN)
def test_own_robots_are_found_by_name_and_engines_agree_on_them(dart, pinocchio, name):
    rng = np.random.default_rng(1)
    world = World([Robot(name, fixed_base=name in ("acrobot", "cartpole", "double_pendulum"))])
    with dart.build(world) as one, pinocchio.build(world) as other:
        q, v = one.positions(), rng.normal(size=one.layout.nv)
        if len(one.layout.joints):
            q[-len(one.layout.joints) :] = rng.normal(size=len(one.layout.joints))
        tau = rng.normal(size=one.layout.nv)
        expected = one.forward_dynamics(q, v, tau)
        found = other.forward_dynamics(q, v, tau)
        assert abs(found - expected).max() <= 1e-9 * abs(expected).max()
        assert np.isfinite(one.layout.max_torque).all() or name == "double_pendulum"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "height"), [("ant", 0.4), ("box", 0.11), ("wheeled_base", 0.151)])
def test_own_floating_robots_rest_on_the_ground(backend, name, height):
    robot = Robot(name, fixed_base=False, position=(0, 0, height))
    with backend.build(World([robot], ground=Ground())) as simulation:
        mass = next(info.mass for info in backend.robots() if info.name == name)
        simulation.step(400)
        forces = []
        for _ in range(20):
            simulation.step(10)
            forces.append(simulation.contacts()["force"].sum(axis=0)[2])
        assert np.mean(forces) == pytest.approx(9.81 * mass, rel=0.05)
        assert abs(simulation.velocities()[:6]).max() < 0.05
        assert 0.05 < simulation.positions()[2] < height


@pytest.mark.slow
def test_the_catalog_describes_each_robot(backend):
    found = {info.name: info for info in backend.robots()}
    for name, (joints, collisions) in OWN.items():
        info = found[name]
        assert (info.joints, info.collisions, info.warnings, info.error) == (
            joints,
            collisions,
            (),
            "",
        )
        assert info.path.is_file() and 0 < info.mass < 20


@pytest.mark.slow
def test_installed_robots_are_in_the_catalog(backend, example):
    found = {info.name: info for info in backend.robots()}
    assert found["a1/a1"].path == example("a1_description/urdf/a1.urdf")
    assert found["a1/a1"].collisions == "primitives" and found["a1/a1"].joints == 12
    assert found["a1/a1"].mass == pytest.approx(13.74, abs=0.01)
    assert found["go2/go2"].warnings[0].startswith("slow: 19 collision meshes")
    assert found["human/human"].collisions == "none"
    assert "LHand" in found["romeo/romeo"].warnings[1]  # whose fingers have no inertia
    assert "principal moments of inertia" in found["romeo/romeo_laas_small"].error
    assert "has no link" in found["ur/ur3"].error
    assert {"anymal_b_simple/anymal", "anymal_c_simple/anymal"} < set(found)
    assert len(found) == len(named_robots()) >= 69


def test_names_and_paths(tmp_path, monkeypatch):
    path = find_robot("cartpole")
    assert find_robot(path) == find_robot(str(path)) == path
    shutil.copy(path, tmp_path / "cartpole")
    monkeypatch.chdir(tmp_path)
    assert find_robot("cartpole") == tmp_path / "cartpole"
    with pytest.raises(ModelError, match='Did you mean "cartpole"'):
        find_robot("cartpol")
    with pytest.raises(ModelError, match="no URDF file .*nowhere.urdf"):
        plugins.resolve("backend", "dart").build(World([Robot("nowhere.urdf")]))


@pytest.mark.slow
def test_the_command_lists_them(capsys):
    assert main(["robots"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["name", "dof", "mass", "[kg]", "collisions"]
    cartpole = [line.split() for line in lines if line.startswith("cartpole ")]
    assert cartpole == [["cartpole", "2", "1.1", "primitives"]]


def test_a_link_and_a_joint_may_have_the_same_name(backend, write_urdf):
    path = find_robot("cartpole")
    text = path.read_text(encoding="utf-8").replace('joint name="hinge"', 'joint name="pole"')
    same = Robot(write_urdf(text), fixed_base=False)
    other = Robot(path, fixed_base=False)
    with backend.build(World([same])) as one, backend.build(World([other])) as two:
        one.step(5)
        two.step(5)
        np.testing.assert_array_equal(one.positions(), two.positions())
        np.testing.assert_array_equal(one.body_poses(["pole"]), two.body_poses(["pole"]))
