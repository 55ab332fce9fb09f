"""Ray casts and what is built on them: lidars and height scans, the same on every engine."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sizes import size

from physx_core import plugins
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_core.rotations import from_axis_angle
from physx_sim import (
    Box,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    HeightScan,
    Lidar,
    Mesh,
    Sensors,
    Sphere,
    Stairs,
    World,
    fan,
)
from physx_sim.engines import read_parts
from physx_sim.engines.rays import Caster
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def shapes(rng, count=20):
    """Return static objects of all kinds in a cube of 4 m."""
    given = [
        (Box, {"size": (0.3, 0.2, 0.4)}),
        (Sphere, {"radius": 0.2}),
        (Capsule, {"radius": 0.1, "length": 0.3}),
        (Cylinder, {"radius": 0.15, "length": 0.3}),
    ]
    found = []
    for place in range(count):
        kind, more = given[place % 4]
        turn = rng.normal(size=4)
        pose = {"position": rng.uniform(-2, 2, 3), "orientation": turn / np.linalg.norm(turn)}
        found.append(kind(name=f"thing {place}", static=place > 3, **pose, **more))
    return found


def cast(world, begins, ends):
    caster = Caster(read_parts(world))
    return caster.cast(np.array(begins, float), np.array(ends, float), np.zeros((0, 7)), ())


@pytest.mark.reported(
    "drake#15260",
    "Genesis#1772",
    about="lidar and height scans",
)
def test_rays_hit_what_mujoco_hits(engine):
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(1)
    world = World(objects=shapes(rng), ground=Ground(height=-2.0))
    begins, ends = rng.uniform(-3, 3, (2, 300, 3))
    begins[:, 2] = np.abs(begins[:, 2])
    with engine.build(world) as simulation:
        hits = simulation.raycast(begins, ends)
        names = simulation.layout.names
    with plugins.resolve("backend", "mujoco").build(world) as simulation:
        model, data = simulation._world.model, simulation._running.data
        owners = simulation._world.owners
        mujoco.mj_forward(model, data)
        for begin, end, hit in zip(begins, ends, hits, strict=True):
            geom, normal = np.zeros(1, np.int32), np.zeros(3)
            far = mujoco.mj_ray(model, data, begin, end - begin, None, 1, -1, geom, normal)
            if 0 < far <= 1 and normal @ (end - begin) < 0:  # entered, not left
                assert names[hit["body"]] == names[owners[geom[0]]]
                assert hit["fraction"] == pytest.approx(far, abs=1e-9)
                np.testing.assert_allclose(hit["normal"], normal, atol=1e-6)
                point = begin + far * (end - begin)
                np.testing.assert_allclose(hit["point"], point, atol=1e-8)
    assert hits["hit"].sum() > 50


def test_a_ray_from_inside_leaves_unseen():
    for thing in shapes(np.random.default_rng(2), 4):
        inside = np.array(thing.position)
        outside = inside + np.array([0.0, 3.0, 0.0])
        world = World(objects=[Box(name="other", size=(1, 1, 1), position=(50, 0, 0)), thing])
        parts = read_parts(world)
        poses = np.array([[50, 0, 0, 0, 0, 0, 1.0], [*thing.position, *thing.orientation]])
        caster = Caster(parts)
        assert not caster.cast(inside[None], outside[None], poses, ())["hit"].any()
        assert caster.cast(outside[None], inside[None], poses, ())["hit"].all()


@pytest.mark.parametrize("far", [1e3, 1e6, 1e8])
def test_rays_hit_the_same_far_from_the_origin(far):
    rng = np.random.default_rng(3)
    things = shapes(rng)
    begins, ends = rng.uniform(-3, 3, (2, 2000, 3))
    caster = Caster(read_parts(World(objects=things)))
    poses = np.array([[*thing.position, *thing.orientation] for thing in things])
    near = caster.cast(begins, ends, poses, ())
    poses[:, :3] += far
    hits = caster.cast(begins + far, ends + far, poses, ())
    assert near["hit"].sum() > 100
    assert (hits["body"] == near["body"]).mean() > 0.98  # rounding moves what a ray only grazes


def test_meshes_are_hit_at_their_triangles(tmp_path):
    path = tmp_path / "tetrahedron.obj"
    path.write_text(TETRAHEDRON)
    mesh = Mesh(name="mesh", path=path, scale=2.0, static=True, position=(1, 0, 0))
    world = World(objects=[mesh, Sphere(name="ball", radius=0.1, position=(9, 9, 9))])
    caster = Caster(read_parts(world))
    poses = np.array([[9, 9, 9, 0, 0, 0, 1.0], [1, 0, 0, 0, 0, 0, 1.0]])
    begins = np.array([[1.5, 0.5, 5], [1.2, 0.2, -1], [2.9, 1.9, 5]])
    hits = caster.cast(begins, begins * (1, 1, 0) + [(0, 0, -1), (0, 0, 3), (0, 0, -1)], poses, ())
    assert hits["hit"].tolist() == [True, True, False]
    np.testing.assert_allclose(hits["point"][:2], [[1.5, 0.5, 1.0], [1.2, 0.2, 0.0]], atol=1e-12)
    np.testing.assert_allclose(hits["normal"][:2], [[3**-0.5] * 3, [0, 0, -1]], atol=1e-12)


@settings(max_examples=size(60, 10), deadline=None)
@given(
    arrays(float, (4, 5), elements=st.floats(-1, 1)),
    arrays(float, (2, 3), elements=st.floats(-3, 3)),
)
def test_height_fields_are_entered_from_above(heights, ends):
    field = HeightField(heights, spacing=(0.5, 0.4), origin=(-0.7, -0.8))
    ball = Sphere(name="ball", radius=0.1, position=(99, 99, 99))
    caster = Caster(read_parts(World(objects=[ball], ground=field)))
    poses = np.array([[99, 99, 99, 0, 0, 0, 1.0]])
    begin, end = ends
    hit = caster.cast(begin[None], end[None], poses, ())[0]
    shares = np.linspace(0, 1, 2001)
    points = begin + shares[:, None] * (end - begin)
    gaps = points[:, 2] - ground_at(field, points)
    entered = (gaps[:-1] >= 0) & (gaps[1:] < 0)
    if hit["hit"]:
        assert ground_at(field, hit["point"][None])[0] == pytest.approx(hit["point"][2], abs=1e-6)
        assert hit["normal"] @ (end - begin) < 0
        earlier = shares[:-1][entered]
        assert not len(earlier) or hit["fraction"] <= earlier[0] + 2e-3
    else:
        assert not (entered & (np.abs(np.diff(gaps)) < 0.05) & (gaps[1:] < -1e-6)).any()


def ground_at(field, points):
    """Return the height of a field below points; NaN beyond it."""
    x, y = ((points[:, :2] - field.corner()) / field.spacing).T
    nx, ny = field.heights.shape
    i, j = (np.clip(np.floor(a), 0, n - 2).astype(int) for a, n in ((x, nx), (y, ny)))
    u, v, z = x - i, y - j, field.heights
    below = z[i, j] + (z[i + 1, j] - z[i, j]) * u + (z[i + 1, j + 1] - z[i + 1, j]) * v
    above = z[i, j] + (z[i + 1, j + 1] - z[i, j + 1]) * u + (z[i, j + 1] - z[i, j]) * v
    outside = (x < 0) | (y < 0) | (x > nx - 1) | (y > ny - 1)
    return np.where(outside, np.nan, np.where(u >= v, below, above))


def test_rays_down_meet_every_point_of_a_grid():
    rng = np.random.default_rng(0)
    field = HeightField(rng.uniform(0, 1, (6, 7)))
    ball = Sphere(name="ball", radius=0.1, position=(99, 99, 99))
    caster = Caster(read_parts(World(objects=[ball], ground=field)))
    poses = np.array([[99, 99, 99, 0, 0, 0, 1.0]])
    x, y = np.meshgrid(np.linspace(-0.2499, 0.2499, 41), np.linspace(-0.2999, 0.2999, 49))
    begins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 5.0)])
    hits = caster.cast(begins, begins - (0, 0, 9), poses, ())
    assert hits["hit"].all()
    np.testing.assert_allclose(hits["point"][:, 2], ground_at(field, begins), atol=1e-9)


def test_ignored_bodies_are_passed(engine):
    objects = [
        Sphere(name="low", radius=0.2, position=(0, 0, 1)),
        Box(name="high", size=(1, 1, 0.1), position=(0, 0, 2)),
    ]
    with engine.build(World(objects=objects, ground=Ground())) as simulation:
        seen = []
        for ignored in ((), ("high",), ("high", "low"), ("high", "low", "ground")):
            hit = simulation.raycast([[0, 0, 5]], [[0, 0, -1]], ignored)[0]
            seen.append(simulation.layout.names[hit["body"]] if hit["hit"] else "")
        assert seen == ["high", "low", "ground", ""]
        with pytest.raises(SimulationError, match='Did you mean "low"'):
            simulation.raycast([[0, 0, 5]], [[0, 0, -1]], ["lo"])


def carrier(**options):
    pose = {"position": (0, 0, 1), "orientation": from_axis_angle((0, 0, 1), np.pi / 2)}
    return Box(name="robot", size=(0.2, 0.2, 0.2), **{**pose, **options})


def test_a_lidar_turns_with_its_body(engine):
    wall = Box(name="wall", size=(0.2, 4, 4), position=(2.1, 0, 1), static=True)
    world = World(objects=[carrier(), wall], ground=Ground(), gravity=(0, 0, 0))
    quarter = from_axis_angle((0, 0, 1), -np.pi / 2)
    lidars = [
        Lidar(name="ahead", body="robot", directions=fan([0.0, -np.pi / 2], [0.0])),
        Lidar(name="turned", body="robot", directions=[(2, 0, 0)], rotation=quarter, reach=3.0),
        Lidar(name="down", body="robot", directions=[(0, 0, -1)], position=(0, 0, -0.3)),
    ]
    with engine.build(world) as simulation:
        sensors = Sensors(simulation, world, lidars)
        sensors.update(simulation)
        np.testing.assert_allclose(sensors["ahead"]["distances"], [10.0, 2.0], atol=1e-9)
        assert sensors["turned"]["distances"] == pytest.approx(2.0, abs=1e-9)
        assert sensors["down"]["distances"] == pytest.approx(0.7, abs=1e-9)
        with pytest.raises(SimulationError, match="read each by its name"):
            sensors.block(Lidar)


def test_a_height_scan_turns_with_the_heading_only(engine):
    tilted = (0.0, np.sin(0.2), 0.0, np.cos(0.2))
    body = carrier(orientation=tilted, position=(0, 0, 0.8))
    world = World(objects=[body], ground=Stairs(steps=3, rise=0.1, run=0.3), gravity=(0, 0, 0))
    scan = HeightScan(
        name="scan", body="robot", points=[(0, 0), (1.1, 0.1), (1.4, 0), (9, 0)], reach=2.0
    )
    with engine.build(world) as simulation:
        sensors = Sensors(simulation, world, [scan])
        sensors.update(simulation)
        found = sensors["scan"]["heights"]
    np.testing.assert_allclose(found, [-0.8, -0.7, -0.6, -0.8], atol=1e-9)


def test_noise_acts_on_every_ray(engine):
    world = World(objects=[carrier()], ground=Ground(), gravity=(0, 0, 0))
    lidar = Lidar(name="l", body="robot", directions=fan(np.linspace(0, 1, 8), [-0.5]), noise=0.1)
    with engine.build(world) as simulation:
        sensors = Sensors(simulation, world, [lidar], np.random.default_rng(0))
        sensors.update(simulation)
        error = sensors["l"]["distances"] - 1.0 / np.sin(0.5)
        assert 0.02 < np.abs(error).max() < 0.5 and len(set(error)) == 8


def test_wrong_ray_sensors_are_errors(engine):
    given = {"name": "l", "body": "robot"}
    for more, said in (
        ({"directions": [(0, 0, 0)]}, "a direction is 0"),
        ({"directions": []}, "rows of 3 numbers"),
        ({"directions": [(1, 0)]}, "has 2 numbers but needs 3"),
        ({"directions": [(1, 0, 0)], "reach": 0}, "reach is 0"),
        ({"directions": [(1, 0, 0)], "ignored": "robot"}, "not a list of names"),
    ):
        with pytest.raises(ConfigError, match=said):
            Lidar(**given, **more)
    with pytest.raises(ConfigError, match="rows of 2 numbers"):
        HeightScan(**given, points=3)
    world = World(objects=[carrier()], ground=Ground())
    with (
        engine.build(world) as simulation,
        pytest.raises(ComponentNotFoundError, match="roboot"),
    ):
        lidar = Lidar(name="l", body="robot", directions=[(1, 0, 0)], ignored=["roboot"])
        Sensors(simulation, world, [lidar])
