"""Robots whose inertia no body has, or that have none: refused or warned about, by name."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sizes import size

from physx_sim import Robot, World
from physx_sim.engines import read_parts, read_robot
from physx_sim.errors import ModelError

LINK = """<link name="{name}"><inertial><origin xyz="{center}"/><mass value="{mass}"/>
<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>"""


def link(name, moments=(0.01, 0.01, 0.01), mass=1.0, center="0 0 0"):
    xx, yy, zz = moments
    return LINK.format(name=name, center=center, mass=mass, xx=xx, yy=yy, zz=zz)


def joint(name, parent, child, kind="revolute"):
    return JOINT.format(name=name, kind=kind, parent=parent, child=child)


@pytest.fixture
def robot(tmp_path):
    def write(*parts, **options):
        path = tmp_path / "robot.urdf"
        path.write_text(f'<robot name="r">{"".join(parts)}</robot>', encoding="utf-8")
        return Robot(path, **options)

    return write


BASE = '<link name="base"/>'
BARE = '<link name="bare"/>'


@pytest.mark.reported(
    "dart#1604",
    "Genesis#3185",
    "bullet3#3110",
    about="links without inertia",
)
def test_joints_that_move_no_inertia_are_named(robot):
    tip = joint("tip", "bare", "end", "fixed")
    made = robot(BASE, BARE, '<link name="end"/>', joint("wrist", "base", "bare"), tip)
    (text,) = read_robot(made).warnings
    assert text.startswith("joint wrist cannot be moved by torques")
    assert "<inertial>" in text and 'mode="velocity"' in text
    made = robot(BASE, BARE, link("end"), joint("wrist", "base", "bare"), tip)
    assert read_robot(made).warnings == ()  # a frame without mass before the link is usual


@pytest.mark.parametrize(
    ("end", "kind", "warned"),
    [
        (link("end", mass=0.0), "revolute", False),
        (link("end", mass=0.0), "prismatic", True),  # moments do not resist a slide
        (link("end", (0.0, 0.0, 0.0)), "revolute", True),  # a point on the axis
        (link("end", (0.0, 0.0, 0.0), center="0.1 0 0"), "revolute", False),
        (link("end", (1e-13, 1e-13, 1e-13), 1e-6), "revolute", False),  # a cube of 1 mm and 1 mg
        (link("end", (0.0, 0.0, 0.0)), "prismatic", False),
    ],
)
def test_what_resists_a_motion_depends_on_the_joint(robot, end, kind, warned):
    made = robot(BASE, end, joint("j", "base", "end", kind))
    assert bool(read_robot(made).warnings) == warned


def test_a_floating_robot_without_mass_is_named(robot):
    made = robot(BARE, fixed_base=False)
    assert "the robot cannot be moved" in read_robot(made).warnings[0]


def test_a_link_of_mass_0_keeps_its_moments_of_inertia(robot):
    made = robot(BASE, link("end", (0.1, 0.2, 0.25), mass=0.0), joint("j", "base", "end"))
    body = read_robot(made).bodies[1]
    assert body.mass == 1e-9
    np.testing.assert_array_equal(np.diag(body.inertia), [0.1, 0.2, 0.25])


def test_negative_moments_of_inertia_are_refused_by_name(robot):
    made = robot(BASE, link("end", (-0.01, 0.01, 0.01)), joint("j", "base", "end"))
    with pytest.raises(ModelError, match=r"link end has the principal moments of inertia -0\.01"):
        read_robot(made)


def test_moments_that_no_body_has_are_named(robot):
    made = robot(BASE, link("end", (0.001, 0.001, 1.0)), joint("j", "base", "end"))
    (text,) = read_robot(made).warnings
    assert "moments of inertia of link end" in text and "sum" in text
    rounded = (0.333, 0.333, 0.667)  # a plate, with three digits
    made = robot(BASE, link("end", rounded), joint("j", "base", "end"))
    assert read_robot(made).warnings == ()


@pytest.mark.parametrize("moments", [(-1e-6, 1e-6, 1e-6), (1e-9, 1e-9, 1e-5)])
def test_links_fixed_to_each_other_are_judged_as_the_body_that_they_are(robot, moments):
    odd, weld = link("odd", moments, 1e-6), joint("weld", "end", "odd", "fixed")
    made = robot(BASE, link("end"), odd, joint("j", "base", "end"), weld)
    assert read_robot(made).warnings == ()
    on_base = joint("weld", "base", "odd", "fixed")  # where it cannot move
    assert read_robot(robot(BASE, link("end"), odd, joint("j", "base", "end"), on_base))
    with pytest.raises(ModelError) if moments[0] < 0 else pytest.warns(UserWarning):
        read_parts(World([robot(BASE, odd, joint("weld", "base", "odd"))]))


@settings(max_examples=size(50, 6), suppress_health_check=list(HealthCheck))
@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(0.01, 100))
def test_every_body_that_exists_passes_and_no_other(robot, second, mass):
    """Moments are sums of two second moments, which are positive for bodies that exist."""
    x, y, z = (mass * value for value in second)
    moments = (y + z, x + z, x + y)
    made = robot(BASE, link("end", moments, mass), joint("j", "base", "end"))
    try:
        warned = any("no body has" in text for text in read_robot(made).warnings)
    except ModelError:
        assert min(moments) < 0
        return
    assert min(moments) > -1e-6 * mass
    if min(second) >= 0 and max(second) > 1e-3:
        assert not warned
    if min(second) < -0.05:
        assert warned


def test_a_warning_is_shown_once(robot):
    made = robot(BASE, BARE, joint("wrist", "base", "bare"))
    with pytest.warns(UserWarning, match="joint wrist cannot be moved by torques") as caught:
        read_parts(World([made]))
    assert str(made.urdf) in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_parts(World([made], period=1e-4))
