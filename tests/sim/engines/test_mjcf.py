"""Robots from MJCF files are those that MuJoCo makes of them, on all engines."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from compiled import Compiled, states, without_friction

from physx_core import plugins
from physx_sim import Ground, JointCoupling, JointSettings, Mimic, Robot, World, mjcf_robots
from physx_sim.engines import read_robot
from physx_sim.errors import ModelError

pytestmark = [
    pytest.mark.processes,
    pytest.mark.filterwarnings("ignore:.*leaves out"),
]

ASSETS = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
ENGINES = ("dart", "pinocchio", "mujoco")

ODD = """
<mujoco model="odd">
  <compiler angle="degree"/>
  <option timestep="0.001"/>
  <default><geom density="800" contype="1" conaffinity="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="crane" pos="0 0 1" euler="10 20 30">
      <inertial pos="0.1 0 0" mass="2" fullinertia="0.3 0.2 0.25 0.01 0.02 -0.01"/>
      <joint name="lift" type="slide" axis="1 2 2" ref="0.3" range="-0.5 0.7" limited="true"
        damping="0.4" armature="0.05"/>
      <joint name="swing" pos="0.1 -0.2 0.3" axis="0 1 1" ref="40" range="-90 60" limited="true"
        stiffness="3" springref="15"/>
      <joint name="roll" pos="0 0.1 0" axis="1 0 0" frictionloss="0.2" actuatorfrcrange="-3 3"
        actuatorfrclimited="true"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.2 0 0" euler="0 0 45"/>
      <body pos="0 0.3 0" quat="0.5 0.5 -0.5 0.5">
        <geom type="capsule" fromto="0 0 0 0.2 0.3 0" size="0.05"/>
        <body name="tip" pos="0.3 0 0.1">
          <joint name="turn" axis="0.6 0 0.8" ref="-70"/>
          <geom type="ellipsoid" size="0.05 0.1 0.2"/>
        </body>
      </body>
    </body>
    <body name="puck" pos="1 2 0.5" euler="0 90 0">
      <freejoint/>
      <geom type="cylinder" size="0.1 0.02"/>
      <body name="pin" pos="0 0 0.1"><joint name="spin" axis="0 0 1" pos="0.02 0 0"/>
        <geom type="sphere" size="0.03" pos="0.05 0 0"/></body>
    </body>
  </worldbody>
</mujoco>
"""
"""Joints on each other, about points and from positions of their own, in a tree that is fixed and
one that floats."""


@pytest.fixture
def odd(tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(ODD, encoding="utf-8")
    return path


def check_close(found, expected, bound):
    assert np.abs(found - expected).max() <= bound * max(np.abs(expected).max(), 1.0)


def compare(path, engine):
    robots = without_friction(mjcf_robots(path, collisions="none"))
    with plugins.resolve("backend", engine).build(World(robots)) as simulation:
        layout, rng = simulation.layout, np.random.default_rng(0)
        theirs = Compiled(path, layout)
        named = [name for name in layout.bodies if name.rpartition("/")[2] in path.read_text()]
        named = [name for name in named if "." not in name and "world" not in name]
        for _ in range(3):
            q, v, tau = states(layout, rng)
            check_close(
                simulation.forward_dynamics(q, v, tau), theirs.accelerations(q, v, tau), 1e-9
            )
            ours = list(layout.velocity_index.values())
            check_close(simulation.mass_matrix(q)[np.ix_(ours, ours)], theirs.masses(), 1e-9)
            poses = theirs.poses([name.rpartition("/")[2] for name in named])
            check_close(simulation.body_poses(named, q), poses, 1e-9)
            a = simulation.forward_dynamics(q, v, tau)
            check_close(simulation.inverse_dynamics(q, v, a), tau, 1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_joints_on_each_other_and_away_from_the_origin_are_those_of_mujoco(odd, engine):
    compare(odd, engine)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", sorted(path.name for path in ASSETS.glob("*.xml")))
@pytest.mark.reported(
    "drake#16369",
    "drake#24008",
    "Genesis#2775",
    about="MJCF that is read as MuJoCo reads it",
)
def test_robots_of_gymnasium_are_those_of_mujoco(name, engine):
    if engine == "dart" and name.startswith("pusher"):
        pytest.skip("a part of it has no inertia but that of a rotor")
    compare(ASSETS / name, engine)


def test_limits_springs_and_rotors_are_read(odd):
    robot, puck = mjcf_robots(odd)
    joints = {joint.name: joint for joint in read_robot(robot).joints}
    assert list(joints) == ["lift", "swing", "roll", "turn"]
    lift, swing, roll = joints["lift"], joints["swing"], joints["roll"]
    assert (lift.unit, lift.lower, lift.upper, lift.damping) == ("m", -0.5, 0.7, 0.4)
    assert lift.armature == 0.05 and roll.friction == 0.2 and roll.max_torque == 3.0
    np.testing.assert_allclose([swing.lower, swing.upper], np.radians([-90, 60]))
    assert swing.stiffness == 3.0 and swing.rest == pytest.approx(np.radians(15))
    assert np.isinf([roll.lower, roll.upper, lift.max_torque, lift.max_velocity]).all()
    settings = {"lift": JointSettings(armature=0.0, damping=1.0, stiffness=2.0)}
    (given, *_) = read_robot(Robot(odd, root="world", joints=settings)).joints
    assert (given.armature, given.damping, given.stiffness) == (0.0, 1.0, 2.0)
    assert puck.position == (1.0, 2.0, 0.5) and not puck.fixed_base
    assert puck.name == puck.root == "puck"


@pytest.mark.parametrize("engine", ENGINES)
def test_everything_in_a_file_lands_on_the_ground(odd, engine):
    world = World(mjcf_robots(odd), ground=Ground(), contacts="static")
    with plugins.resolve("backend", engine).build(world) as simulation:
        simulation.step(1500)
        # On its rim, and on the pin's ball.
        assert 0.02 < simulation.body_poses(["puck/puck"])[0, 2] < 0.2
        touching = {simulation.layout.names[i] for i in simulation.contacts()["body_a"]}
        assert "puck/puck" in touching


def test_shapes_are_where_mujoco_has_them(odd):
    shapes = read_robot(Robot(odd, root="world"), touching=True).shapes
    kinds = [(shape.body, shape.kind) for shape in shapes]
    assert kinds == [("crane", "box"), ("body2", "capsule"), ("tip", "capsule")]
    model = mujoco.MjModel.from_xml_path(str(odd))
    np.testing.assert_allclose(shapes[0].position, model.geom_pos[1])
    assert shapes[0].size == (0.2, 0.4, 0.6)
    assert shapes[1].size[1] == pytest.approx(np.hypot(0.2, 0.3))
    # The ellipsoid, along its longest axis.
    np.testing.assert_allclose(np.abs(shapes[2].rotation[:, 2]), [0, 0, 1])
    assert shapes[2].size[0] + 0.5 * shapes[2].size[1] == pytest.approx(0.2)


def test_a_mesh_collides_where_mujoco_has_it(tmp_path):
    (tmp_path / "shapes").mkdir()
    corners = [(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
    (tmp_path / "shapes/wedge.obj").write_text("\n".join(lines) + "\n", encoding="ascii")
    path = tmp_path / "wedge.xml"
    path.write_text(
        '<mujoco><compiler meshdir="shapes"/><asset><mesh name="w" file="wedge.obj" scale=".1 .2 '
        '.3"/></asset><worldbody><body name="wedge"><freejoint/><geom type="mesh" mesh="w" pos="1 2'
        ' 3" euler="10 20 30"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    robot = Robot(path, fixed_base=False)
    (shape,) = read_robot(robot, touching=True).shapes
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    theirs = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    with plugins.resolve("backend", "mujoco").build(World([robot], ground=Ground())) as simulation:
        for direction in np.eye(3):
            assert simulation.reach("robot", direction) == pytest.approx((theirs @ direction).max())
    assert shape.mesh == tmp_path / "shapes/wedge.obj"


def test_what_is_fixed_to_the_world_is_there_beside_a_floating_tree(engine, tmp_path):
    path = tmp_path / "step.xml"
    path.write_text(
        '<mujoco><worldbody><geom type="box" size="1 1 0.1"/><body name="ball" pos="0 0 1">'
        '<freejoint/><geom size="0.1"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    step, ball = mjcf_robots(path)
    assert (step.root, ball.root) == ("world", "ball")
    with engine.build(World([step, ball])) as simulation:
        simulation.step(2000)
        assert simulation.body_poses(["ball/ball"])[0, 2] == pytest.approx(0.2, abs=1e-3)
    with engine.build(World([Robot(path, fixed_base=False)])) as simulation:
        assert simulation.layout.bodies == ("ball",)


@pytest.mark.parametrize("engine", ["dart", "pinocchio", "mujoco"])
def test_meshes_in_the_format_of_mujoco_are_read(tmp_path, engine):
    corners = np.array([(-1, -1, -1), (1, -1, -1), (0, 1, -1), (0, 0, 2)], "<f4")
    faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)], "<i4")
    header = np.array([4, 0, 4, 4], "<i4")
    content = b"".join(x.tobytes() for x in (header, corners, np.zeros((4, 2), "<f4"), faces))
    (tmp_path / "wedge.msh").write_bytes(content)
    path = tmp_path / "wedge.xml"
    path.write_text(
        '<mujoco><asset><mesh file="wedge.msh" scale=".1 .1 .1"/></asset><worldbody><body>'
        '<freejoint/><geom type="mesh" mesh="wedge"/></body></worldbody></mujoco>',
        encoding="utf-8",
    )
    collisions = "boxes" if engine == "pinocchio" else "shapes"
    robot = Robot(path, fixed_base=False, collisions=collisions)
    with plugins.resolve("backend", engine).build(World([robot], ground=Ground())) as simulation:
        up, down = (simulation.reach("robot", np.array([0, 0, z])) for z in (1.0, -1.0))
        assert up + down == pytest.approx(0.3, rel=1e-6)
    (tmp_path / "wedge.msh").write_bytes(content[:-4])
    with pytest.raises(ModelError, match="wedge.msh"):
        read_robot(robot, touching=True)


def test_what_is_left_out_is_named_once(tmp_path):
    path = tmp_path / "rich.xml"
    path.write_text(
        '<mujoco><option density="1000" gravity="0 0 -1.6"/><worldbody><geom type="plane" size="1 '
        '1 1"/><body name="a"><freejoint/><geom type="ellipsoid" size=".1 .2 .3" condim="6" '
        'friction="0.3"/><body name="b"><joint name="j"/><joint name="k" axis="1 0 0" '
        'actuatorfrcrange="-1 5"/><geom '
        'size=".1"/></body></body></worldbody><tendon><fixed name="t" stiffness="1"><joint '
        'joint="j" coef="1"/></fixed><fixed name="u"><joint joint="j" coef="1"/></fixed></tendon>'
        '<equality><joint joint1="j" joint2="k" polycoef="0 1 1 0 0"/></equality>'
        '<actuator><motor joint="j"/></actuator></mujoco>',
        encoding="utf-8",
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            plugins.resolve("backend", "mujoco").build(World([Robot(path, "rich")])).close()
    (text,) = [str(each.message) for each in caught]
    for part in (
        *('Robot "rich"', "actuators (1: command", "tendons (1", "equality constraints (1"),
        *("the fluid", "gravity=(0.0, 0.0, -1.6)", "ellipsoids"),
        "a smaller limit in one direction",
        *("fixed to the world (World(ground=", "fixed_base=False lets"),
    ):
        assert part in text


def test_without_mujoco_an_error_says_what_to_install(odd, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModelError, match=r"pip install .*physx.sim\[mjcf\]"):
        read_robot(Robot(odd))


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("<mujoco><worldbody/>", {}, "MuJoCo cannot read"),
        ("<mujoco><worldbody/></mujoco>", {}, "no movable joint"),
        (ODD, {}, r"several trees: choose one with Robot\(root=...\).*puck"),
        (ODD, {"root": "pick"}, 'no tree has the root "pick"..* "puck"'),
        (ODD, {"root": "world", "fixed_base": False}, "is the world, which cannot float"),
        (ODD, {"root": "world", "feet": {"tap": 0.1}}, 'feet names "tap", which is not a link'),
        (
            "<mujoco><worldbody>"
            + 401 * '<body><geom size=".1"/></body>'
            + "</worldbody></mujoco>",
            {},
            "401 bodies; a model may have 400",
        ),
        (
            '<mujoco><worldbody><body><joint name="b" type="ball"/><geom size="1"/></body>'
            "</worldbody></mujoco>",
            {},
            'joint "b" is a ball',
        ),
        (
            '<mujoco><worldbody><body><joint/><geom size="1"/><body><joint name="joint0"/>'
            '<geom size="1"/></body></body></worldbody></mujoco>',
            {},
            "its joints need different names, but are called joint0, joint0",
        ),
    ],
    ids=["xml", "empty", "trees", "root", "floating", "feet", "bodies", "ball", "joints"],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, text, options, said):
    path = tmp_path / "wrong.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ModelError, match=said) as caught:
        plugins.resolve("backend", "mujoco").build(World([Robot(path, **options)]))
    assert "wrong.xml" in str(caught.value)


NAMES = "abetcdfgh"
EQUALITIES = """
<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="a"><joint name="ja" axis="0 1 0" ref="0.2"/>
    <geom type="capsule" size="0.02 0.1" pos="0 0 0.1" mass="1"/>
    <body name="b" pos="0.4 0 0.2"><joint name="jb" axis="0 1 0"/>
      <geom type="capsule" size="0.02 0.1" pos="0 0 -0.1" mass="1"/>
      <body name="e" pos="0 0 -0.2"><joint name="je" axis="0 1 0"/>
        <geom size="0.03" pos="0.4 0 0" mass="0.3"/>
        <body name="t" pos="0.4 0 0"><joint name="jt" axis="0 1 0"/>
          <geom size="0.03" mass="0.3"/></body></body>
    </body></body>
  <body name="c" pos="0 0.5 0"><joint name="jc" axis="0 1 0" ref="0.1"/>
    <geom size="0.05" pos="0.2 0 0" mass="1"/></body>
  <body name="d" pos="0 -0.5 0"><joint name="jd" axis="0 1 0"/>
    <geom size="0.05" pos="0.2 0 0" mass="1"/></body>
  <body name="f" pos="0 1 0"><joint name="jf" axis="0 1 0" ref="0.1"/>
    <geom size="0.05" pos="0.3 0 0" mass="1"/></body>
  <body name="g" pos="0 2 0"><joint name="jg" axis="0 1 0" ref="-0.2"/>
    <geom size="0.05" pos="0.1 0 0" mass="2"/></body>
  <body name="h" pos="0 3 0"><joint name="jh" axis="0 1 0" ref="0.3"/>
    <geom size="0.05" pos="0 0 0.2" mass="1"/></body>
</worldbody><tendon>
  <fixed name="sides"><joint joint="jf" coef="0.5"/><joint joint="jg" coef="0.5"/></fixed>
  <fixed name="cage"><joint joint="jh" coef="-2"/></fixed>
  <fixed name="lock"><joint joint="jf" coef="1"/><joint joint="jg" coef="-0.3"/></fixed>
</tendon><equality>
  <tendon tendon1="sides" tendon2="cage" polycoef="0.04 -0.5 0 0 0"
    solref="0.002 1"/>
  <tendon tendon1="lock" polycoef="0.02 0 0 0 0" solref="0.002 1"/>
  <connect body1="e" body2="world" anchor="0.4 0 0"/>
  <weld body1="t" body2="e"/>
  <joint joint1="jc" joint2="ja" polycoef="0.05 -0.5 0 0 0"/>
  <joint joint1="jd" polycoef="0 0 0 0 0"/>
  <connect body1="c" body2="a" anchor="0 0 0" active="false"/>
</equality></mujoco>
"""


def test_a_joint_may_follow_several_others(tmp_path):
    path = tmp_path / "leaders.xml"
    body = '<body><joint name="{}"/><geom size=".1"/></body>'
    path.write_text(
        f"<mujoco><worldbody>{''.join(map(body.format, 'abc'))}</worldbody><equality>"
        '<joint joint1="a" joint2="b" polycoef="0.1 2 0 0 0"/>'
        '<joint joint1="a" joint2="c" polycoef="0.2 -1 0 0 0"/></equality></mujoco>'
    )
    model = read_robot(Robot(path))
    assert [mimic for *_, mimic in model.followers] == [Mimic("b", 2.0, 0.1)]
    assert model.couplings == (JointCoupling({"a": 1.0, "c": 1.0}, 0.2),)


@pytest.mark.filterwarnings("ignore:.*leaves out")
def test_equality_constraints_hold_as_in_mujoco(engine, tmp_path):
    path = tmp_path / "equalities.xml"
    path.write_text(EQUALITIES)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for _ in range(200):
        mujoco.mj_step(model, data)
    world = World([Robot(path, collisions="none")])
    with engine.build(world) as simulation:
        places = [simulation.layout.joints.index(f"j{name}") for name in NAMES]
        q = np.zeros(len(NAMES))
        q[places] = model.qpos0[[model.joint(f"j{name}").qposadr[0] for name in NAMES]]
        simulation.set_state(q, np.zeros(len(NAMES)))
        simulation.step(200)
        ours = simulation.positions()[places]
        theirs = data.qpos[[model.joint(f"j{name}").qposadr[0] for name in NAMES]]
        np.testing.assert_allclose(ours, theirs, atol=3e-3)
    said = " ".join(read_robot(world.robots[0]).warnings)
    assert "equality constraints (1:" in said and "tendons" not in said
