"""Descriptions of worlds: shapes of robots and objects, and errors of invalid ones."""

from __future__ import annotations

import copy
import pickle
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_sim import (
    Box,
    Camera,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    JointCoupling,
    JointSettings,
    Mesh,
    Robot,
    Sphere,
    Stairs,
    Weld,
    Wheel,
    World,
    Wrench,
)
from physx_sim.engines import bounding_box, bounding_capsule
from physx_sim.errors import FeatureNotSupportedError, ModelError

pytestmark = pytest.mark.processes

MESH_ROBOT = """
<robot name="r"><link name="body">
  <inertial><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.1"/><geometry><mesh filename="brick.obj" scale="2 2 2"/></geometry>
  </collision>
</link></robot>
"""
CORNERS = [(x, y, z) for x in (-0.1, 0.1) for y in (-0.15, 0.15) for z in (-0.05, 0.05)]
FACES = [
    *("1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2"),
    *("3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"),
]


@pytest.fixture
def brick_mesh(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {face}" for face in FACES]
    path = tmp_path / "brick.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(("collisions", "height"), [("boxes", 0.0), ("capsules", None)])
def test_meshes_are_replaced_if_asked(backend, write_urdf, brick_mesh, collisions, height):
    path = write_urdf(MESH_ROBOT)
    robot = Robot(path, fixed_base=False, collisions=collisions, position=(0, 0, 0.13))
    with backend.build(World([robot], ground=Ground())) as simulation:
        simulation.step(250)
        if height is None:  # a capsule lies on its side, around the corners
            height = np.hypot(0.2, 0.1) - 0.1
        np.testing.assert_allclose(simulation.positions()[2], height, atol=2e-3)


def test_meshes_collide_in_dart_and_are_rejected_by_pinocchio(
    dart, pinocchio, write_urdf, brick_mesh
):
    robot = Robot(write_urdf(MESH_ROBOT), fixed_base=False)
    thing = Mesh(name="brick", path=brick_mesh, scale=0.5, position=(2, 0, 0.05), mass=3.0)
    world = World([robot], objects=[thing], ground=Ground(), contacts="static")
    with dart.build(world) as simulation:
        simulation.step(300)
        np.testing.assert_allclose(simulation.positions()[[2, 9]], [0, 0.025], atol=3e-3)
    with pytest.raises(FeatureNotSupportedError, match='mesh_contacts.*collisions="boxes"'):
        pinocchio.build(world)


def test_bounding_shapes_contain_all_vertices():
    rng = np.random.default_rng(0)
    for _ in range(20):
        vertices = rng.normal(size=(50, 3)) * rng.uniform(0.1, 3, 3)
        center, size = bounding_box(vertices)
        assert (np.abs(vertices - center) <= 0.5 * size + 1e-12).all()
        center, axes, (radius, length) = bounding_capsule(vertices)
        local = (vertices - center) @ axes
        along = np.clip(local[:, 2], -length / 2, length / 2)
        local[:, 2] -= along
        assert np.linalg.norm(local, axis=1).max() <= radius + 1e-9
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(axes), 1.0)


def test_feet_replace_the_shapes_of_their_links(backend, write_urdf, brick_mesh):
    path = write_urdf(MESH_ROBOT)
    robot = Robot(path, fixed_base=False, feet={"body": 0.07}, position=(0, 0, 0.08))
    with backend.build(World([robot], ground=Ground())) as simulation:
        simulation.step(150)
        np.testing.assert_allclose(simulation.positions()[2], 0.07, atol=1e-3)
    robot = Robot(write_urdf(MESH_ROBOT), fixed_base=False, feet={"boddy": 0.07})
    with pytest.raises(ModelError, match='"boddy".*Did you mean "body"'):
        backend.build(World([robot], ground=Ground()))


@pytest.mark.parametrize("fixed_base", [True, False])
def test_a_robot_starts_at_its_pose(backend, bar, fixed_base):
    half = np.sqrt(0.5)
    robot = bar(fixed_base=fixed_base, position=(1, 2, 3), orientation=(0, 0, half, half))
    with backend.build(World([robot])) as simulation:
        poses = simulation.body_poses(["base", "tip"])
        expected = [[1, 2, 3, 0, 0, half, half], [1, 2, 2, 0, 0, half, half]]
        np.testing.assert_allclose(poses, expected, atol=1e-12)
        jacobian = simulation.jacobian("tip", simulation.positions())
        if fixed_base:  # the hinge's axis is now along -x, the tip hangs one meter below
            np.testing.assert_allclose(jacobian[:, 0], [0, -1, 0, -1, 0, 0], atol=1e-12)
        else:
            np.testing.assert_allclose(jacobian[3:, 6], [-1, 0, 0], atol=1e-12)


def test_settings_of_unknown_joints_are_named(backend, bar):
    robot = bar(joints={"hnge": JointSettings(damping=1.0)})
    with pytest.raises(ModelError, match='"hnge".*Did you mean "hinge"'):
        backend.build(World([robot]))


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        ('<geometry><box size="1 1"/></geometry>', 'size="1 1"'),
        ('<geometry><box size="1 1 -1"/></geometry>', "box of size"),
        ('<geometry><sphere radius="nan"/></geometry>', 'radius="nan"'),
        ('<geometry><cone radius="1"/></geometry>', 'collision shape .* kind "cone"'),
        ("<geometry/>", 'collision shape .* kind "none"'),
        ("", 'collision shape .* kind "none"'),
        ('<origin xyz="0 0"/><geometry><sphere radius="1"/></geometry>', 'xyz="0 0"'),
    ],
)
def test_broken_shapes_are_named(backend, write_urdf, inside, words):
    path = write_urdf(
        f"<robot name='r'><link name='a'><collision>{inside}</collision></link></robot>"
    )
    with pytest.raises(ModelError, match=words):
        backend.build(World([Robot(path, fixed_base=False)], ground=Ground()))
    backend.build(World([Robot(path, fixed_base=False)])).close()  # nothing to touch


@pytest.mark.parametrize(
    "inertial",
    [
        '<mass value="x"/>',
        '<mass value="nan"/>',
        '<mass value="-1"/>',
        '<mass value="1"/><inertia ixx="inf"/>',
        '<origin xyz="1 2"/><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/>',
    ],
)
def test_broken_inertias_are_named(backend, write_urdf, inertial):
    path = write_urdf(
        f"<robot name='r'><link name='a'><inertial>{inertial}</inertial></link></robot>"
    )
    with pytest.raises(ModelError, match='link "a" has'):
        backend.build(World([Robot(path, fixed_base=False)]))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("bad.obj", "garbage", "cannot be read"),
        ("bad.stl", "", "cannot be read"),
        ("bad.ply", "ply", "not in one of the formats"),
        (None, None, "no mesh file"),
    ],
)
def test_broken_mesh_files_are_named(backend, tmp_path, name, content, words):
    path = tmp_path / (name or "nowhere.obj")
    if name:
        path.write_text(content)
    with pytest.raises(ModelError, match=words):
        backend.build(World(objects=[Mesh(name="m", path=path)], ground=Ground()))


def test_duplicate_names_of_bodies_are_rejected(backend, bar):
    with pytest.raises(ModelError, match='share the name "tip"'):
        backend.build(World([bar()], objects=[Sphere(name="tip", radius=0.1)]))


def test_things_that_can_be_gone_through_once_stay():
    couplings = [JointCoupling({"a": 1.0})]
    robots = [Robot("r.urdf", couplings=iter(couplings), wheels=iter([Wheel("a", 1)]))]
    objects = [Sphere(name=name, radius=1) for name in "ab"]
    world = World(iter(robots), objects=iter(objects), attachments=iter([Weld("a", "b")]))
    assert list(world.robots) == robots and list(world.objects) == objects
    assert list(robots[0].couplings) == couplings
    assert (len(robots[0].wheels), len(world.attachments)) == (1, 1)
    assert Camera(name="c", body="a", ignored=iter("bc")).ignored == ("b", "c")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: World(), "needs a robot or a moving object"),
        (lambda: World(objects=[Sphere(name="s", radius=1, static=True)]), "needs a robot"),
        (lambda: World(objects=[Sphere(name="ground", radius=1)]), '"ground" is reserved'),
        (lambda: World(["robot.urdf"]), "is not a Robot"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], period=0), "period"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], gravity=(0, 1)), "gravity"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], contacts="some"), "contacts"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], integrator="rk5"), "rk4"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], iterations=0), "iterations is 0"),
        (lambda: World(objects=[Sphere(name="s", radius=1)], ground=3), "ground"),
        (lambda: Sphere(name="a/b", radius=1), "without '/'"),
        (lambda: Sphere(name="s", radius=-1), "radius.*positive"),
        (lambda: Box(name="b", size=(1, 1)), "2 numbers but needs 3"),
        (lambda: Capsule(name="c", radius=1, length=float("nan")), "length"),
        (lambda: Cylinder(name="c", radius=1, length=1, friction=-1), "friction"),
        (lambda: Box(name="b", size=(1, 1, 1), orientation=(0, 0, 0, 0)), "quaternion"),
        (lambda: Robot("r.urdf", collisions="all"), "collisions"),
        (lambda: Robot("r.urdf", feet={"a": 0}), "feet"),
        (lambda: Robot(3), "must be a path"),
        (lambda: Robot("r.urdf", joints={"a": 3}), "JointSettings"),
        (lambda: Robot("r.urdf", joints=[JointSettings()]), "joints is .* must be a mapping"),
        (lambda: Robot("r.urdf", wheels=Wheel("a", 1)), "wheels must be a list of Wheels, as in"),
        (lambda: Robot("r.urdf", wheels=None), "must be a list of Wheels"),
        (lambda: Robot("r.urdf", couplings=3), "couplings must be a list of JointCouplings"),
        (lambda: World(Robot("r.urdf")), r"World.robots must be a list of Robots"),
        (lambda: World([Robot("r.urdf")], attachments=Weld("a")), "must be a list of Attachment"),
        (lambda: Camera(name="c", body="a", ignored=3), "ignored is 3, not a list of names"),
        (lambda: Camera(name="c", body="a", images=3), "images is 3, not a list of names"),
        (lambda: Camera(name="c", body="a", noise={1: 0.1}), 'no option "1"'),
        (lambda: JointSettings(mode="torque"), "force, position, servo, velocity"),
        (lambda: JointSettings(stiffness=-1), "stiffness"),
        (lambda: Ground(normal=(0, 0, 0)), "must not be 0"),
        (lambda: Stairs(steps=0), "steps"),
        (lambda: Stairs(rise=0), "rise"),
        (lambda: HeightField([[0.0, 1.0]]), "two axes"),
        (lambda: HeightField([[0.0, 1.0], [0.0, np.nan]]), "finite"),
        (lambda: HeightField(np.zeros((2, 2)), spacing=(1, 0)), "spacing"),
        (lambda: Wrench("b", force=(1, 2)), "shape"),
        (lambda: Wrench("b", duration=0), "duration"),
        (lambda: Wrench("b", times=[0, 0]), "increasing"),
        (lambda: Wrench("b", force=(np.inf, 0, 0)), "finite"),
        (lambda: Wrench("b", frame="moon"), "body, world"),
    ],
)
def test_invalid_descriptions_are_rejected(make, words):
    with pytest.raises(ConfigError, match=words):
        make()


def test_a_world_is_plain_and_picklable(bar):
    world = World(
        [bar(joints={"hinge": JointSettings(mode="servo")})],
        objects=[Box(name="b", size=(1, 2, 3))],
        ground=HeightField(np.zeros((3, 4))),
    )
    other = pickle.loads(pickle.dumps(world))  # noqa: S301 - our own
    assert other.robots == world.robots
    assert other.objects == world.objects
    np.testing.assert_array_equal(other.ground.heights, world.ground.heights)
    assert copy.deepcopy(Ground()) == Ground()


def test_factors_of_masses_change_masses_and_moments_of_inertia(backend):
    floating = {"fixed_base": False, "collisions": "none"}
    with (
        backend.build(World([Robot("ant", **floating)])) as plain,
        backend.build(World([Robot("ant", mass_factors={"torso": 3.0}, **floating)])) as heavy,
    ):
        q = plain.positions()
        difference = heavy.mass_matrix(q) - plain.mass_matrix(q)
    linear, angular = np.diagonal(difference)[:3], np.diagonal(difference)[3:6]
    assert (linear > 0).all() and np.ptp(linear) < 1e-9
    assert (angular > 0).all()
    assert not difference[6:, 6:].any() or np.abs(difference[6:, 6:]).max() < 1e-12


def test_factors_of_masses_are_of_links_and_positive(backend):
    with pytest.raises(ModelError, match=r'"torsoo", which is not a link. Did you mean "torso"\?'):
        backend.build(World([Robot("ant", fixed_base=False, mass_factors={"torsoo": 2.0})]))
    with pytest.raises(ConfigError, match=r'mass_factors\["torso"\]'):
        Robot("ant", mass_factors={"torso": 0.0})


@pytest.mark.parametrize("number", [np.float64, np.float32, np.array, Fraction, Decimal])
def test_a_world_of_numpy_numbers_moves_exactly_like_one_of_floats(backend, number):
    def world(of):
        joints = {"back_left_knee": JointSettings(damping=of(0.5), stiffness=of(0.25))}
        robot = Robot(
            "ant",
            fixed_base=False,
            position=(of(0.0), of(0.0), of(0.75)),
            mass_factors={"torso": of(1.25), "front_left_thigh": of(0.5)},
            friction=of(0.75),
            joints=joints,
        )
        box = Box(name="box", size=(of(0.5), of(0.25), of(0.25)), position=(3, 0, of(0.5)))
        ground = Ground(friction=of(0.5), height=of(0.0))
        return World([robot], objects=[box], ground=ground, period=of(2**-10))

    with backend.build(world(float)) as plain, backend.build(world(number)) as other:
        q = plain.positions()
        assert plain.mass_matrix(q)[2, 2] > 1.0
        assert (other.mass_matrix(q) == plain.mass_matrix(q)).all()
        for simulation in (plain, other):
            simulation.set_torques(np.full(len(plain.layout.joints), 0.5))
            simulation.step(300)
        assert (other.positions() == plain.positions()).all()
