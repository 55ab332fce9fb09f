"""Cameras: depth against rays, segmentation against the bodies that they hit, colors, limits."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest

import physx_mujoco.pictures
from physx_core import plugins
from physx_core.errors import ConfigError, UnknownOptionError
from physx_core.rotations import from_rotation_vector, to_matrix
from physx_gym import RobotEnv
from physx_sim import (
    BodySettings,
    Box,
    Camera,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    Lidar,
    Sensors,
    Sphere,
    Stairs,
    World,
    fan,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

pytestmark = pytest.mark.processes
VIEW = {
    "position": (-1.0, 0.3, 0.8),
    "rotation": from_rotation_vector(0.0, 0.3, -0.2),
    "height": 24,
    "width": 40,
    "field_of_view": 0.9,
    "reach": 6.0,
    "images": ("depth", "segmentation", "rgb"),
}
THINGS = [
    Box(name="box", size=(0.3, 0.2, 0.4), position=(0.5, 0.0, 0.2)),
    Sphere(name="ball", radius=0.2, position=(0.5, -0.5, 0.6)),
    Capsule(name="pill", radius=0.1, length=0.3, position=(0.4, 0.5, 0.4)),
    Cylinder(name="can", radius=0.15, length=0.3, position=(1.5, 0.5, 0.15), static=True),
]
HEIGHTS = 0.2 * np.random.default_rng(0).random((31, 31))


def drawing_works():
    for library in ("libEGL.so.1", "libOSMesa.so.8"):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False


needs_drawing = pytest.mark.skipif(
    not drawing_works(), reason="no EGL or OSMesa: apt-get install libegl1 libgl1-mesa-dri"
)


def build(engine="mujoco", **options):
    world = World(**{"objects": THINGS, "ground": Ground(), "gravity": (0, 0, 0), **options})
    return plugins.resolve("backend", engine).build(world), world


def rays(camera, pose=None):
    """Return the ends of the rays through the pixels, in the world, shape (height, width, 3)."""
    slope = 2 * math.tan(0.5 * camera.field_of_view) / camera.height
    up = -slope * (np.arange(camera.height) + 0.5 - 0.5 * camera.height)
    left = -slope * (np.arange(camera.width) + 0.5 - 0.5 * camera.width)
    ways = np.ones((camera.height, camera.width, 3))
    ways[..., 1], ways[..., 2] = left[None], up[:, None]
    return camera.position + camera.reach * ways @ to_matrix(camera.rotation).T


@needs_drawing
@pytest.mark.parametrize(
    "ground", [Ground(), HeightField(HEIGHTS, (0.2, 0.2)), Stairs(begin=1.0)], ids=lambda g: type(g)
)
def test_images_agree_with_rays(ground):
    camera = Camera(name="eye", **VIEW)
    simulation, world = build(ground=ground)
    with simulation:
        sensors = Sensors(simulation, world, [camera])
        sensors.update(simulation)
        seen = sensors["eye"]
        ends = rays(camera).reshape(-1, 3)
        hits = simulation.raycast(np.tile(camera.position, (len(ends), 1)), ends)
        depth = np.where(hits["hit"], hits["fraction"], 1.0) * camera.reach
        assert seen["depth"].shape == seen["segmentation"].shape == (24, 40)
        assert seen["rgb"].shape == (24, 40, 3)
        same = seen["segmentation"].ravel() == hits["body"]
        assert same.mean() > 0.98  # all but pixels that an edge divides
        assert len(np.unique(seen["segmentation"])) == len(simulation.layout.names) + 1
        near = np.abs(seen["depth"].ravel() - depth) < 2e-3
        assert near[same].mean() > 0.99
        np.testing.assert_allclose(np.median(np.abs(seen["depth"].ravel() - depth)), 0, atol=1e-5)


@needs_drawing
def test_a_camera_on_a_body_moves_with_it_and_does_not_see_it():
    camera = Camera(
        name="eye", body="box", ignored=["ball"], **{**VIEW, "position": (0, 0, 0), "reach": 20.0}
    )
    simulation, _ = build()
    with simulation:
        names = list(simulation.layout.names)
        first = simulation.take_images(camera)
        assert not np.isin(first["segmentation"], [names.index("box"), names.index("ball")]).any()
        q = simulation.positions()
        start = simulation.layout.parts["box"].positions.start
        q[start + 2] += 1.0
        simulation.set_state(q, simulation.velocities())
        second = simulation.take_images(camera)
        assert (second["depth"] - first["depth"]).max() > 1.0


@needs_drawing
def test_hidden_and_moved_bodies_are_seen_as_they_are():
    camera = Camera(name="eye", **VIEW)
    simulation, _ = build()
    with simulation:
        ball, can = (simulation.layout.names.index(name) for name in ("ball", "can"))
        assert {ball, can} <= set(np.unique(simulation.take_images(camera)["segmentation"]))
        simulation.set_body("ball", BodySettings(hidden=True))
        simulation.set_body("can", BodySettings(position=(0.0, 9.0, 0.0)))
        assert not {ball, can} & set(np.unique(simulation.take_images(camera)["segmentation"]))


@needs_drawing
def test_a_camera_draws_only_when_it_is_due_and_has_errors(monkeypatch):
    simulation, world = build()
    drawn = []
    draw = type(simulation).draw

    def counted(self, *given):
        drawn.append(self.frame)
        return draw(self, *given)

    monkeypatch.setattr(type(simulation), "draw", counted)
    with simulation:
        more = {"noise": {"depth": 0.1}, "period": 0.01}
        camera = Camera(name="eye", **{**VIEW, "images": ("depth", "segmentation")}, **more)
        sensors = Sensors(simulation, world, [camera], np.random.default_rng(0))
        simulation.add_hook(sensors)
        simulation.step(25)
        assert drawn == [0, 10, 20]
        sensors.update(simulation)
        assert drawn == [0, 10, 20]
        ideal = sensors.ideal.view(sensors.dtype)[0]["eye"]
        errors = (sensors["eye"]["depth"] - ideal["depth"]).std()
        assert errors == pytest.approx(0.1, rel=0.1)
        np.testing.assert_array_equal(sensors["eye"]["segmentation"], ideal["segmentation"])


@needs_drawing
def test_an_environment_observes_images_in_their_shape_and_rays_by_name(tmp_path):
    camera = Camera(name="eye", body="torso", images=("depth", "rgb"), height=8, width=12)
    lidars = [
        Lidar(name=f"lidar{n}", body="torso", directions=fan(np.linspace(0, 1, n))) for n in (3, 5)
    ]
    options = {"backend": "mujoco", "fixed_base": False, "control_period": 0.01, "period": 2e-3}
    with RobotEnv("ant", 0.02, sensors=[camera, *lidars], ground=Ground(), **options) as env:
        observed, _ = env.reset(seed=0)
        shapes = {name: leaf.shape for name, leaf in observed["measurements"].items()}
        assert shapes.pop("eye.depth") == (8, 12) and shapes.pop("eye.rgb") == (8, 12, 3)
        assert shapes == {"lidar3": (3, 1), "lidar5": (5, 1)}
        assert observed in env.observation_space
        images = env.simulator.simulation.take_images(camera)
        np.testing.assert_array_equal(observed["measurements"]["eye.depth"], images["depth"])
        env.step(env.action_space.sample())


@pytest.mark.parametrize("engine", ["dart", "pinocchio"])
def test_other_engines_name_what_they_lack(engine):
    simulation, world = build(engine)
    with simulation, pytest.raises(FeatureNotSupportedError, match="A Camera needs it"):
        Sensors(simulation, world, [Camera(name="eye")])


def test_without_a_library_it_says_what_to_install(monkeypatch):
    names = {"egl": "libNoEGL.so.1", "osmesa": "libNoOSMesa.so.8"}
    monkeypatch.setattr(physx_mujoco.pictures, "_LIBRARIES", names)
    simulation, _ = build()
    with simulation, pytest.raises(SimulationError, match="apt-get install libegl1"):
        simulation.take_images(Camera(name="eye"))


def test_bad_cameras_are_named():
    with pytest.raises(UnknownOptionError, match="depht"):
        Camera(name="eye", images=["depht"])
    for wrong in (
        {"images": ()},
        {"height": 0},
        {"width": 5000},
        {"field_of_view": 3.2},
        {"near": 20.0},
    ):
        with pytest.raises(ConfigError, match='Camera "eye": ' + next(iter(wrong))):
            Camera(name="eye", **wrong)
