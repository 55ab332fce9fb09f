"""What engines hold of a robot is what its file says, for any notation, every link and joint.

MuJoCo's own URDF reader, which shares no code with those of the engines, is the third opinion.
"""

from __future__ import annotations

import dataclasses
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core import PhysxError, plugins
from physx_sim import JointSettings, Robot, World
from physx_sim.engines import (
    LoadedBody,
    LoadedRobot,
    check_loaded,
    named_robots,
    read_parts,
    read_robot,
)
from physx_sim.errors import ModelError

ENGINES = ("dart", "pinocchio")
ARM = """
<robot name="arm">
  <link name="base"><inertial><mass value="3"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="upper"><inertial><origin xyz="0.1 0 {center}" rpy="0 {turn} 0"/>
    <mass value="{mass}"/>
    <inertia ixx="{ixx}" iyy="0.02" izz="0.03" ixy="0" ixz="{ixz}" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"><inertial><origin xyz="0 0.05 0"/><mass value="0.25"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 {axis} 0.5"/><limit lower="-1" upper="{upper}" effort="9" velocity="9"/></joint>
  <joint name="elbow" type="prismatic"><origin xyz="0 0 {offset}" rpy="0.1 0.2 0.3"/>
    <parent link="upper"/><child link="lower"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
  <joint name="flange" type="fixed"><origin xyz="0.1 0 0" rpy="0 0 0.5"/>
    <parent link="lower"/><child link="tool"/></joint>
</robot>
"""
NUMBERS = {
    "mass": 1.0,
    "center": 0.2,
    "turn": 0.3,
    "ixx": 0.02,
    "ixz": 1e-5,
    "axis": 0.5,
    "upper": 2.0,
    "offset": 0.4,
}
LISTS = ("center", "turn", "axis", "offset")
"""Numbers beside others in one attribute, so blanks and line breaks there separate them."""


def arm(**texts):
    return ARM.format(**{name: repr(value) for name, value in NUMBERS.items()} | texts)


def masses_in_mujoco(mujoco, text, joints, q):
    """Return the mass matrix that MuJoCo computes from its own reading of a URDF."""
    model = read_with_mujoco(mujoco, text)
    data, places = mujoco.MjData(model), [model.joint(name).dofadr[0] for name in joints]
    data.qpos[places] = q
    mujoco.mj_forward(model, data)
    found = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, found)
    return found[np.ix_(places, places)]


def read_with_mujoco(mujoco, text):
    """Return MuJoCo's model of a URDF without shapes; massless links get what physx gives them."""
    log = mujoco.MjLogConfig.get()
    log.logto_file = log.logto_console = False  # else it writes into the working directory
    log.set()
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    options = 'fusestatic="false" inertiafromgeom="false" boundmass="1e-9" boundinertia="1e-12"'
    root.insert(0, ElementTree.fromstring(f"<mujoco><compiler {options}/></mujoco>"))
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))


# Numbers --------------------------------------------------------------------------------------

PLAIN = ["1", "1.", "0.5", ".5", "+0.5", "1e+0", "1E-1", "5e-1", "00.5", "0.50000000000000001"]
REFUSED = ["1_000", "\uff11.0", "\u0661", "inf", "nan", "0x1", "1d0", "1f", "1,5", "1e", "--1"]
REFUSED += ["$(arg m)", "1e999", "\u00a01", "1\u2003", "1 2", ""]
BLANKS = st.text(alphabet=" \t\n\r", max_size=3)


@pytest.mark.parametrize("blank", [" ", "\n", "\t", "\r\n      ", "&#10;"])
@pytest.mark.parametrize("where", ["mass", "ixz", "turn", "axis", "upper", "offset"])
@pytest.mark.reported(
    "urdf-rs#105", "urdf-rs#56", about="blanks in numbers of a URDF drop an inertia"
)
def test_blanks_around_a_number_change_nothing(write_urdf, where, blank):
    states = np.array([0.7, 0.2]), np.array([1.0, -2.0]), np.array([0.5, 0.25])
    plain = write_urdf(arm(), "plain.urdf")
    spaced = write_urdf(arm(**{where: f"{blank}{NUMBERS[where]}{blank}"}), "spaced.urdf")
    for engine in ENGINES:
        backend = plugins.resolve("backend", engine)
        with (
            backend.build(World([Robot(plain)])) as one,
            backend.build(World([Robot(spaced)])) as other,
        ):
            expected = one.forward_dynamics(*states)
            np.testing.assert_array_equal(other.forward_dynamics(*states), expected)
            np.testing.assert_array_equal(other.layout.upper, one.layout.upper)


@pytest.mark.parametrize(
    ("where", "text"),
    [
        (where, text)
        for where in NUMBERS
        for text in REFUSED
        if text or where not in LISTS  # nothing between other numbers is no number
    ],
)
def test_a_text_that_readers_take_differently_is_an_error_that_names_it(write_urdf, where, text):
    owner = {"axis": "shoulder", "upper": "shoulder", "offset": "elbow"}.get(where, "upper")
    with pytest.raises(ModelError, match=f'"{owner}" has .*finite number') as caught:
        read_robot(Robot(write_urdf(arm(**{where: text}))))
    assert text in str(caught.value)


@settings(max_examples=size(40, 5), suppress_health_check=list(HealthCheck))
@given(
    st.sampled_from(["mass", "center", "ixx", "axis", "offset"]),
    BLANKS,
    st.one_of(
        st.sampled_from(PLAIN + REFUSED),
        st.floats(1e-3, 10).map(repr),
        st.from_regex(r"\A[+]?[0-9]{0,3}[.]?[0-9]{0,3}([eE][+-]?[0-9])?\Z"),
        st.text(alphabet="0123456789.eE+-_ xdf\u0663", min_size=1, max_size=6),
    ),
    BLANKS,
)
def test_all_readers_read_the_same_number_or_physx_refuses_it(write_urdf, where, left, text, right):
    """Any text in the place of a number: an error, or one number for two engines and MuJoCo."""
    mujoco = pytest.importorskip("mujoco")
    content = arm(**{where: left + text + right})
    try:
        model = read_robot(Robot(write_urdf(content)))
    except ModelError:
        return
    number, names, q = float(text), [joint.name for joint in model.joints], np.array([0.4, 0.1])
    read = {
        "mass": model.bodies[1].mass,
        "center": model.bodies[1].center[2],
        "offset": model.bodies[2].pose[2, 3],
    }
    assert read.get(where, number) == (number or (1e-9 if where == "mass" else 0.0))
    found = []
    for engine in ENGINES:
        with plugins.resolve("backend", engine).build(World([Robot(model.path)])) as simulation:
            found.append(simulation.mass_matrix(q))
            found.append(simulation.forward_dynamics(q, [1.0, 2.0], [3.0, 4.0]))
    assert abs(found[2] - found[0]).max() <= 1e-9 * abs(found[0]).max()
    assert abs(found[3] - found[1]).max() <= 1e-6 * abs(found[1]).max()
    try:
        third = masses_in_mujoco(mujoco, content, names, q)
    except ValueError as error:  # such as moments of inertia that no body has
        assert "inertia" in str(error) or "mass" in str(error)
        return
    assert abs(third - found[0]).max() <= 1e-8 * abs(found[0]).max()


# Loading --------------------------------------------------------------------------------------


@pytest.fixture
def movable(write_urdf):
    robot = Robot(write_urdf(arm()), "left", position=(1.0, 2.0, 3.0))
    return read_parts(World([robot])).movables[0]


def held(movable):
    """Return what an engine holds that loads everything."""
    bodies = movable.model.bodies
    poses = np.array([body.pose for body in bodies])
    poses[0, :3, 3] = movable.position
    axes = np.array([body.axis for body in bodies if body.joint is not None])
    found = [
        LoadedBody((i,), body.mass, body.center.copy(), body.inertia.copy())
        for i, body in enumerate(bodies)
    ]
    upper = np.array([joint.upper for joint in movable.model.joints])
    return LoadedRobot(poses, axes, found, {"upper": upper})


def lighter(loaded, place, **other):
    """Return what an engine holds, but for the inertia of one body."""
    bodies = list(loaded.bodies)
    bodies[place] = dataclasses.replace(bodies[place], **other)
    return dataclasses.replace(loaded, bodies=bodies)


LOST = {
    'link "lower" the position': lambda x: dataclasses.replace(x, poses=x.poses + moved(2)),
    'link "tool" the rotation': lambda x: dataclasses.replace(x, poses=x.poses + turned(3)),
    'joint "shoulder" the axis': lambda x: dataclasses.replace(x, axes=x.axes[:, [1, 2, 0]]),
    'joint "shoulder" the upper': lambda x: dataclasses.replace(x, limits={"upper": np.zeros(2)}),
    'link "upper" the mass': lambda x: lighter(x, 1, mass=0.5),
    'link "upper" the center of mass': lambda x: lighter(x, 1, center=np.full(3, 0.1)),
    'link "upper" the inertia': lambda x: lighter(x, 1, inertia=0.99 * x.bodies[1].inertia),
}
"""What an engine may have lost, by what the error names."""


def moved(link):
    found = np.zeros((4, 4, 4))
    found[link, 0, 3] = 0.1
    return found


def turned(link):
    found = np.zeros((4, 4, 4))
    found[link, 0, 1] = 0.1
    return found


@pytest.mark.parametrize("lost", LOST)
def test_a_number_that_an_engine_does_not_keep_is_an_error_that_names_it(movable, lost):
    check_loaded("mine", movable, held(movable))
    with pytest.raises(ModelError, match=rf"mine gives {lost} \S.* instead of ") as caught:
        check_loaded("mine", movable, LOST[lost](held(movable)))
    assert '"left"' in str(caught.value) and str(movable.model.path) in str(caught.value)


# The third reader -----------------------------------------------------------------------------

IMPOSSIBLE = re.compile("inertia must satisfy|positive eigenvalues")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(named_robots()))
def test_every_robot_is_the_one_that_mujoco_reads(name):
    mujoco = pytest.importorskip("mujoco")
    path = named_robots()[name]
    try:
        model = read_robot(Robot(path, collisions="none"))
    except PhysxError as error:
        pytest.skip(str(error).splitlines()[0])
    try:
        theirs = read_with_mujoco(mujoco, path.read_text(encoding="utf-8"))
    except ValueError as error:
        assert IMPOSSIBLE.search(str(error)), error
        pytest.skip(f"MuJoCo refuses it: {error}")
    compare_links(mujoco, theirs, model)
    if model.joints:
        compare_dynamics(mujoco, theirs, model)


def compare_links(mujoco, theirs, model):
    """Compare the inertia of each link."""
    for body in model.bodies:
        if body.name == "world":
            continue
        number = theirs.body(body.name).id
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, theirs.body_iquat[number])
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(theirs.body_inertia[number]) @ turn.T
        np.testing.assert_allclose(theirs.body_mass[number], body.mass, rtol=1e-12)
        assert abs(inertia - body.inertia).max() <= 1e-9 * abs(inertia).max() + 2e-12, body.name
        if body.mass > 1e-9:
            np.testing.assert_allclose(theirs.body_ipos[number], body.center, atol=1e-12)


def compare_dynamics(mujoco, theirs, model):
    """Compare mass matrix and bias forces of both engines in random states."""
    names = [joint.name for joint in model.joints]
    plain = {name: JointSettings(damping=0.0, friction=0.0) for name in names}
    world = World([Robot(model.path, joints=plain, collisions="none")])
    data, rng = mujoco.MjData(theirs), np.random.default_rng(0)
    places = [theirs.joint(name).dofadr[0] for name in names]
    for engine in ENGINES:
        with plugins.resolve("backend", engine).build(world) as simulation:
            for q, v in rng.uniform(-1, 1, (3, 2, len(names))):
                data.qpos[places], data.qvel[places] = q, v
                mujoco.mj_forward(theirs, data)
                matrix = np.zeros((theirs.nv, theirs.nv))
                mujoco.mj_fullM(theirs, data, matrix)
                matrix = matrix[np.ix_(places, places)]
                bound = 1e-6 * abs(matrix).max()
                assert abs(simulation.mass_matrix(q) - matrix).max() <= bound
                bias = data.qfrc_bias[places]
                found = simulation.inverse_dynamics(q, v, np.zeros(len(names)))
                assert abs(found - bias).max() <= 1e-6 * max(abs(bias).max(), 1e-2)


@pytest.mark.slow
def test_mujoco_reads_most_robots():
    """Enough for the comparison to mean something: what it refuses is counted."""
    mujoco = pytest.importorskip("mujoco")
    robots, refused = named_robots(), 0
    if len(robots) < 60:
        pytest.skip("example-robot-data is not installed")
    for path in robots.values():
        try:
            read_with_mujoco(mujoco, path.read_text(encoding="utf-8"))
        except ValueError:
            refused += 1
    assert refused <= len(robots) // 4
