"""Records of contacts and rays, and features that an engine lacks."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_core.errors import UnknownOptionError
from physx_sim import (
    CONTACT,
    FEATURES,
    RAY_HIT,
    Box,
    Capsule,
    Cylinder,
    Ground,
    Robot,
    Sphere,
    World,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

BALL = Sphere(name="ball", radius=0.1, mass=2.0)
CALM = {"gravity": (0.0, 0.0, 0.0)}


def test_contacts_of_two_moving_things_name_both_bodies(backend):
    world = World(
        objects=[
            Box(name="low", size=(0.4, 0.4, 0.1), position=(0, 0, 0.05)),
            Box(name="high", size=(0.2, 0.2, 0.2), position=(0, 0, 0.2), mass=3.0),
            Box(name="table", size=(1, 1, 0.2), static=True, position=(5, 0, 0)),
        ],
        ground=Ground(),
    )
    with backend.build(world) as simulation:
        assert simulation.contacts().dtype == CONTACT
        assert len(simulation.contacts()) == 0
        simulation.step(300)
        contacts, names = simulation.contacts(), simulation.layout.names
        assert names == ("low", "high", "ground", "table")
        between = contacts[contacts["body_b"] == 1]
        force = between["force"].sum(axis=0)  # on the lower one
        np.testing.assert_allclose(force, [0, 0, -3 * 9.81], atol=0.1)
        np.testing.assert_allclose(between["normal"], [[0, 0, -1]] * len(between), atol=1e-4)
        np.testing.assert_allclose(between["point"][:, 2], 0.1, atol=1e-4)
        assert (contacts["body_a"] < contacts["body_b"]).all()
        simulation.set_state(simulation.positions(), simulation.velocities())
        assert len(simulation.contacts()) == 0
        np.testing.assert_array_equal(simulation.body_poses(["table"])[0, :3], [5, 0, 0])
        assert not simulation.body_velocities(["ground"]).any()


@pytest.mark.parametrize("contacts", ["static", "none"])
def test_the_option_contacts_disables_collisions(backend, contacts):
    things = [
        Box(name="low", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1)),
        Box(name="high", size=(0.2, 0.2, 0.2), position=(0, 0, 0.35)),
    ]
    world = World(objects=things, ground=Ground(), contacts=contacts)
    with backend.build(world) as simulation:
        simulation.step(400)
        heights = simulation.positions()[2::7]
        if contacts == "static":
            np.testing.assert_allclose(heights, 0.1, atol=4e-3)
        else:
            np.testing.assert_allclose(heights[1] - heights[0], 0.25)
            assert heights[0] < -0.5


@pytest.mark.slow
def test_links_collide_with_each_other_if_asked(backend, write_urdf):
    ball = '<collision><geometry><sphere radius="0.3"/></geometry></collision>'
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="{{}}">{mass}</inertial>{ball}</link>'
    joint = (
        '<joint name="{0}{1}" type="prismatic"><parent link="{0}"/><child link="{1}"/>'
        '<axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="9" velocity="9"/></joint>'
    )
    text = "<robot name='r'><link name='o'/>" + "".join(link.format(n) for n in "abc")
    text += joint.format("o", "a") + joint.format("a", "b") + joint.format("b", "c") + "</robot>"
    path = write_urdf(text)
    for collide in (False, True):
        world = World([Robot(path, self_collisions=collide)], **CALM)
        with backend.build(world) as simulation:
            simulation.set_state([0, 0.1, 0.5], [0, 0, -1.0])
            simulation.step(1000)
            gap = simulation.positions()[1] + simulation.positions()[2]
            assert (gap > 0.55) == collide


def test_rays_hit_the_nearest_body(engine):
    ball = Sphere(name="ball", radius=0.5, position=(0, 0, 2))
    with engine.build(World(objects=[ball], ground=Ground())) as simulation:
        for _ in range(2):
            begins = [[0, 0, 5], [3, 0, 5], [3, 0, 5]]
            hits = simulation.raycast(begins, [[0, 0, -5], [3, 0, -5], [3, 0, 4]])
            assert hits.dtype == RAY_HIT
            assert hits["hit"].tolist() == [True, True, False]
            assert [simulation.layout.names[i] for i in hits["body"][:2]] == ["ball", "ground"]
            assert hits["body"][2] == -1
            height = simulation.positions()[2]
            np.testing.assert_allclose(hits["point"][:2, 2], [height + 0.5, 0], atol=1e-9)
            np.testing.assert_allclose(hits["fraction"][1], 0.5, atol=1e-9)
            np.testing.assert_allclose(hits["normal"][:2], [[0, 0, 1]] * 2, atol=1e-9)
            simulation.step(100)
        with pytest.raises(SimulationError, match="begins"):
            simulation.raycast([[0, 0, np.nan]], [[0, 0, 0]])
        with pytest.raises(SimulationError, match="1 ray start points but 2 end points"):
            simulation.raycast([[0, 0, 1]], [[0, 0, 0]] * 2)


# Features ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("engine", "options", "feature"),
    [
        ("pinocchio", {"objects": [BALL], "detector": "fcl"}, "detector fcl"),
        ("dart", {"objects": [Capsule(name="c", radius=1, length=1)], "detector": "fcl"}, "caps"),
    ],
)
def test_a_missing_feature_is_an_error_that_lists_the_features(engine, options, feature):
    with pytest.raises(FeatureNotSupportedError, match=feature) as caught:
        plugins.resolve("backend", engine).build(World(**options))
    assert caught.value.features
    assert set(caught.value.features) <= FEATURES.keys()


def test_features_of_a_simulation_are_known(backend):
    with backend.build(World(objects=[BALL])) as simulation:
        assert simulation.features <= FEATURES.keys()


def test_unknown_detectors_and_solvers_are_named(dart, pinocchio):
    with pytest.raises(UnknownOptionError, match=r"detector.*bulet.*bullet"):
        dart.build(World(objects=[BALL], detector="bulet"))
    with pytest.raises(UnknownOptionError, match=r"solver.*Options: dantzig, fbf, nsgs"):
        dart.build(World(objects=[BALL], solver="lemke"))
    with pytest.raises(UnknownOptionError, match="Options: admm, pgs"):
        pinocchio.build(World(objects=[BALL], solver="dantzig"))


def test_objects_have_the_inertia_of_their_shapes(backend):
    things = [
        Capsule(name="capsule", radius=0.1, length=0.3, mass=2.0),
        Cylinder(name="cylinder", radius=0.1, length=0.3, mass=2.0, position=(1, 0, 0)),
        Box(name="box", size=(0.1, 0.2, 0.3), mass=2.0, position=(2, 0, 0)),
    ]
    with backend.build(World(objects=things, contacts="none")) as simulation:
        mass = simulation.mass_matrix(simulation.positions())
        np.testing.assert_allclose(mass[:3, :3], 2 * np.eye(3), atol=1e-12)
        cylinder, box = mass[9:12, 9:12].diagonal(), mass[15:18, 15:18].diagonal()
        np.testing.assert_allclose(cylinder, [0.02, 0.02, 0.01], rtol=1e-12)
        np.testing.assert_allclose(box, 2 / 12 * np.array([0.13, 0.1, 0.05]), rtol=1e-12)
        # Between the cylinders of its own length and of its whole length.
        assert 0.02 < mass[3, 3] < 2 / 12 * (3 * 0.01 + 0.25)
        simulation.step(100)
        assert simulation.layout.parts["box"].positions == slice(14, 21)
        np.testing.assert_allclose(simulation.velocities()[2::6], -0.981, rtol=1e-9)
