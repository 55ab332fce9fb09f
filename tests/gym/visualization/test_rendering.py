"""Pictures, recordings and films of environments; pictures need a Vulkan driver."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import psutil
import pytest
import rerun as rr
from PIL import Image

from physx_core import plugins
from physx_core.components import Factory, Visualizer
from physx_core.errors import ConfigError, PluginNotFoundError, UnknownOptionError, VisualizerError
from physx_core.rotations import from_axis_angle, to_matrix
from physx_gym import RobotEnv, Simulator, WorldDrawing, replay
from physx_gym.errors import LogError
from physx_gym.visualization.film import write_film
from physx_sim import (
    BodySettings,
    Box,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    Mesh,
    Robot,
    Sphere,
    Stairs,
    UrdfTree,
    World,
    parse_urdf,
)

pytestmark = pytest.mark.processes

SIZE = (160, 120)


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture(scope="module")
def pictures():
    """Pictures of an environment that moves; skips where there is nothing to draw with."""
    before = children()
    env = RobotEnv("cartpole", 0.02, render_mode="rgb_array")
    env.viewer_kwargs["picture_size"] = SIZE
    env.reset(seed=0)
    try:
        found = [env.render(), env.render()]
    except VisualizerError as error:
        if "Vulkan" not in str(error) or os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))
    for _ in range(10):
        env.step(env.action_space.high)
    found.append(env.render())
    env.reset(seed=0)
    found.append(env.render())
    env.close()
    assert children() == before
    return found


def children():
    return {child.pid for child in psutil.Process().children(recursive=True)}


def recorded(steps=20, robot="cartpole", **options):
    env = RobotEnv(robot, 0.02, **options)
    env.eval()
    env.reset(seed=0)
    for _ in range(steps):
        env.step(env.action_space.sample())
    return env


def transforms(path, instance=1, timeline="step"):
    """Return how many poses each step of a recording has."""
    counts: dict[int, int] = {}
    for chunk in rr.chunk.RrdReader(path).stream().filter(content=f"env_{instance}/tf"):
        for step in chunk.to_record_batch().column(timeline).cast("int64").to_pylist():
            counts[step] = counts.get(step, 0) + 1
    return counts


# Pictures -----------------------------------------------------------------------------------


def test_pictures_show_the_present_state(pictures):
    first, again, moved, back = pictures
    assert all(each.shape == (120, 160, 3) and each.dtype == np.uint8 for each in pictures)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 30
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, back)
    assert (first != moved).any(axis=2).mean() > 0.003


def test_a_film(pictures, tmp_path):
    env = recorded(10)
    path = tmp_path / "a.gif"
    assert env.replay(record_video_path=path, frame_rate=10, picture_size=SIZE) == path
    with Image.open(path) as film:
        assert film.size == SIZE
        assert film.n_frames == 3
        assert film.info["duration"] == 100


def test_the_error_of_a_missing_viewer_names_the_remedy():
    env = RobotEnv("cartpole", 0.02, render_mode="rgb_array")
    env.viewer_kwargs["visualizer"] = "rerunn"
    env.reset(seed=0)
    with pytest.raises(PluginNotFoundError, match='Did you mean "rerun"'):
        env.render()


def test_without_a_display_there_is_no_window():
    env = recorded(2, render_mode=None)
    with pytest.raises(VisualizerError, match="there is no display"):
        env.replay()
    env.render_mode = "human"
    with pytest.raises(VisualizerError, match="there is no display"):
        env.render()


def test_unknown_options_are_rejected():
    with pytest.raises(UnknownOptionError, match="render_mode"):
        RobotEnv("cartpole", 0.02, render_mode="movie")
    env = RobotEnv("cartpole", 0.02, render_mode="rgb_array")
    env.viewer_kwargs["size"] = SIZE
    env.reset(seed=0)
    with pytest.raises((UnknownOptionError, TypeError), match="size"):
        env.render()


# Replays ------------------------------------------------------------------------------------


def test_a_replay_is_a_recording_in_real_time(tmp_path):
    env = recorded(25)
    assert env.replay(path=tmp_path / "a.rrd") == tmp_path / "a.rrd"
    frames = transforms(tmp_path / "a.rrd")
    assert sorted(frames) == list(range(16))  # 0.5 s at 30 a second
    simulated = np.array(list(transforms(tmp_path / "a.rrd", timeline="sim_time")))  # in ns
    np.testing.assert_allclose(simulated * 1e-9, np.arange(16) / 30, atol=1e-8)
    assert set(frames.values()) == {3}


def test_several_logs_side_by_side(tmp_path):
    first, second = recorded(5), recorded(10, "ant", fixed_base=False)
    log = second.reset()[1]["log_path"]
    second.step(second.action_space.sample())
    second.stop()
    replay(first.log_data, compare=[log, second.log_data], path=tmp_path / "a.rrd", frame_rate=100)
    assert sorted(transforms(tmp_path / "a.rrd", 1)) == list(range(11))
    assert sorted(transforms(tmp_path / "a.rrd", 2)) == list(range(11))
    assert sorted(transforms(tmp_path / "a.rrd", 3)) == list(range(11))


def test_an_episode_in_training_is_replayed(tmp_path):
    env = RobotEnv("ant", 0.05, fixed_base=False)
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample())
    env.replay(path=tmp_path / "a.rrd")
    assert sorted(transforms(tmp_path / "a.rrd", 1)) == list(range(16))


def test_invalid_replays(tmp_path):
    env = RobotEnv("cartpole", 0.02)
    with pytest.raises(LogError, match="Nothing was recorded"):
        env.replay(path=tmp_path / "a.rrd")
    env = recorded(2)
    with pytest.raises(ConfigError, match="frame_rate"):
        env.replay(path=tmp_path / "a.rrd", frame_rate=0)
    data = env.log_data
    data["constants"]["world"] = World([Robot("acrobot"), Robot("cartpole", name="b")])
    with pytest.raises(LogError, match="2 positions, but its world has 4"):
        replay(data, path=tmp_path / "a.rrd")


# What is drawn ------------------------------------------------------------------------------

CUBE = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


def drawn(world, turn=None):
    """Return what was set last of each object of a scene, by name."""
    engine = plugins.resolve("backend", "dart")
    simulation, factory = engine.build(world), Factory()
    drawing = WorldDrawing(factory, world, engine, simulation.layout, "world")
    drawing.show(simulation)
    if turn is not None:
        turn(simulation)
        drawing.show(simulation)
    found = {}
    for event in (one for several in factory.take_events() for one in several.each()):
        found.setdefault(event.name, {}).update(event.values)
    drawing.close()
    simulation.close()
    return found


def test_objects_of_all_kinds_are_drawn_where_they_are(tmp_path):
    (tmp_path / "a.obj").write_text(CUBE)
    pose = {"position": (1.0, 2.0, 3.0), "orientation": (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))}
    world = World(
        [Robot("cartpole", name="robot")],
        objects=[
            Box(name="box", size=(0.2, 0.4, 0.6), **pose),
            Sphere(name="ball", radius=0.1, static=True, **pose),
            Capsule(name="pill", radius=0.1, length=0.3, **pose),
            Cylinder(name="can", radius=0.1, length=1.0, **pose),
            Mesh(name="mesh", path=tmp_path / "a.obj", **pose),
        ],
        contacts="none",
    )

    def move(simulation):
        q = simulation.positions()
        for part in simulation.layout.parts.values():
            if part.name != "robot":
                q[part.positions.start] += 10.0
        simulation.set_state(q, simulation.velocities())

    found = drawn(world, move)
    np.testing.assert_allclose(found["box"]["position"], (11, 2, 3))
    np.testing.assert_allclose(found["box"]["half_sizes"], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(found["box"]["orientation"], pose["orientation"], atol=1e-6)
    np.testing.assert_allclose(found["ball"]["position"], (1, 2, 3))
    np.testing.assert_allclose(found["pill"]["position"], (11, 2, 3))
    np.testing.assert_allclose(
        found["mesh"]["poses"], [(11, 2, 3, *pose["orientation"])], atol=1e-6
    )
    np.testing.assert_allclose(found["can"]["position"], (11, 2, 3))
    np.testing.assert_allclose(found["can"]["orientation"], pose["orientation"], atol=1e-6)
    assert (found["can"]["radius"], found["can"]["length"]) == (0.1, 1.0)
    assert found["robot"]["bodies"] == ["rail", "cart", "pole"]
    assert found["robot"]["urdf"].endswith("cartpole.urdf")


def test_static_objects_that_move_and_hidden_ones_are_drawn_so():
    world = World(
        [Robot("cartpole", name="robot")],
        objects=[
            Box(name="door", size=(0.2, 0.4, 0.6), static=True, position=(0.0, -5.0, 0.0)),
            Box(name="wall", size=(0.2, 0.4, 0.6), static=True, position=(3.0, 0.0, 0.0)),
            Box(name="crate", size=(0.1, 0.1, 0.1), position=(0.0, 5.0, 1.0)),
        ],
    )

    def move(simulation):
        simulation.set_body("door", BodySettings(velocity=(0.0, 1.0, 0.0)))
        simulation.set_body("crate", BodySettings(hidden=True))
        simulation.step(100)

    found = drawn(world, move)
    np.testing.assert_allclose(found["door"]["position"], (0.0, -4.9, 0.0), atol=1e-6)
    np.testing.assert_allclose(found["wall"]["position"], (3.0, 0.0, 0.0))
    assert [found[name].get("visible", True) for name in ("door", "crate")] == [True, False]


def test_a_robot_from_mjcf_is_drawn_by_its_collision_shapes(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "a.obj").write_text(CUBE)
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><asset><mesh name="m" file="a.obj"/></asset><worldbody><body name="arm" '
        'pos="0 0 1">'
        '<joint name="j" pos="0 0 0.5"/><geom type="box" size=".1 .2 .3" pos="1 2 3" '
        'euler="10 20 30"/><geom type="mesh" mesh="m" pos="4 5 6"/></body></worldbody></mujoco>'
    )
    engine, factory = plugins.resolve("backend", "mujoco"), Factory()
    world = World([Robot(path, collisions="none")])
    with engine.build(world) as simulation:
        drawing = WorldDrawing(factory, world, engine, simulation.layout, "world")
        drawing.show(simulation)
        events = [one for several in factory.take_events() for one in several.each()]
        (robot,) = [event.values for event in events if event.name == "robot"]
        tree = UrdfTree(parse_urdf(Path(robot["urdf"])))
        drawing.close()
    assert robot["bodies"] == tree.links == ["world", "arm.j", "arm"]
    box, mesh = tree.shapes("arm", "visual")
    assert (box.kind, box.size) == ("box", (0.2, 0.4, 0.6))
    np.testing.assert_allclose(box.pose[:3, 3], (1, 2, 3))
    turn = to_matrix(from_axis_angle((1, 0, 0), np.radians(10)))
    for axis, angle in (((0, 1, 0), 20), ((0, 0, 1), 30)):
        turn = turn @ to_matrix(from_axis_angle(axis, np.radians(angle)))
    np.testing.assert_allclose(box.pose[:3, :3], turn, atol=1e-12)
    assert mesh.mesh == str(tmp_path / "a.obj")
    np.testing.assert_allclose(mesh.pose[:3, 3], (4, 5, 6), atol=1e-9)


@pytest.mark.parametrize(
    ("ground", "names"),
    [
        (Ground(height=1.0, normal=(0.0, 0.0, -1.0)), {"ground"}),
        (Stairs(steps=2), {"ground", "stairs/0", "stairs/1"}),
        (HeightField(np.arange(12.0).reshape(3, 4), spacing=(1.0, 1.0)), {"ground"}),
        (None, set()),
    ],
)
def test_grounds_are_drawn(ground, names):
    found = drawn(World([Robot("ant", fixed_base=False)], ground=ground))
    assert found.keys() - {"robot", "view"} == names
    assert found["view"]["follow"] == "robot"
    assert [name for name in found if found[name].get("in_view") is False] == ["ground"][
        : len(names)
    ]
    if isinstance(ground, HeightField):
        np.testing.assert_array_equal(found["ground"]["heights"], ground.heights)
        assert found["ground"]["spacing"].tolist() == [1.0, 1.0]
        assert found["ground"]["position"].tolist() == [*ground.corner(), 0.0]
    elif isinstance(ground, Ground):
        assert found["ground"]["position"][2] == pytest.approx(-1.0, abs=0.02)


def test_a_camera_stays_where_the_base_is_fixed():
    assert "follow" not in drawn(World([Robot("cartpole")]))["view"]


def test_a_film_for_video_players(tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "a.mp4"
    shades = (0, 100, 200)
    write_film((np.full((33, 48, 3), shade, np.uint8) for shade in shades), path, 12.5)
    with av.open(str(path)) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 12.5
    assert [frame.shape for frame in frames] == [(32, 48, 3)] * 3
    assert [frame.mean() for frame in frames] == pytest.approx(shades, abs=6)


def test_films_in_other_formats_are_rejected(tmp_path):
    with pytest.raises(ConfigError, match=r"\.gif, \.webp, \.png, not a\.avi"):
        write_film([np.zeros((4, 4, 3), np.uint8)], tmp_path / "a.avi", 30)


def test_an_error_while_a_film_is_rendered_is_raised(tmp_path):
    def pictures():
        yield np.zeros((4, 4, 3), np.uint8)
        raise VisualizerError("no more")

    with pytest.raises(VisualizerError, match="no more"):
        write_film(pictures(), tmp_path / "a.gif", 30)


class Fake(Visualizer):
    """A visualizer that keeps what it is told."""

    opened: ClassVar[list[Fake]] = []

    def __init__(self, **options):
        self.options, self.steps, self.drawn, self.is_open = options, [], {}, True
        self.opened.append(self)

    def events(self, instance_id, step, events):
        actions = [event.action for event in events if event.kind != "time"]
        self.steps.append((instance_id, step, actions))
        self.drawn |= {event.name: event.values for event in events}

    def close(self):
        self.is_open = False


@pytest.mark.parametrize(("name", "shown"), [("PushBox", "positions"), ("ArmReach", "position")])
def test_an_environment_draws_its_goal(name, shown):
    env = gymnasium.make(f"physx/{name}-v0", render_mode="human").unwrapped
    env.viewer_kwargs |= {"visualizer": Fake}
    for seed in (1, 2):
        env.reset(seed=seed)
        env.render()
        drawn = np.reshape(Fake.opened[-1].drawn["goal"][shown], (-1, 3))
        middle = 0.5 * (drawn.min(axis=0) + drawn.max(axis=0))
        np.testing.assert_allclose(middle[: len(env.goal)], env.goal, atol=1e-6)
    env.close()


def test_a_viewer_for_humans_follows_each_step():
    Fake.opened.clear()
    env = RobotEnv(Simulator(World([Robot("cartpole")])), 0.02, render_mode="human")
    env.viewer_kwargs |= {"visualizer": Fake, "port": 5}
    env.reset(seed=0)
    assert env.render() is None
    for _ in range(3):
        env.step(env.action_space.sample())
    (viewer,) = Fake.opened
    assert viewer.options == {"mode": "spawn", "save": False, "port": 5}
    assert [step for _, step, _ in viewer.steps] == list(range(5))
    assert viewer.steps[0][2] == ["add", "add"]  # the view and the robot
    assert viewer.steps[4][2] == ["update"]
    env.close()
    assert not viewer.is_open


def test_a_simulator_with_changed_options_is_redrawn():
    Fake.opened.clear()
    env = RobotEnv(Simulator(World([Robot("cartpole")])), 0.02, render_mode="human")
    env.viewer_kwargs["visualizer"] = Fake
    env.reset(seed=0)
    env.reset(seed=0)
    assert len(Fake.opened) == 1
    env.stop()
    env.simulator.set_options({"world": {"gravity": (0.0, 0.0, -1.0)}})
    env.reset(seed=0)
    assert [viewer.is_open for viewer in Fake.opened] == [False, True]


def test_a_viewer_without_pictures_is_rejected():
    env = RobotEnv("cartpole", 0.02, render_mode="rgb_array")
    env.viewer_kwargs["visualizer"] = Fake
    env.reset(seed=0)
    with pytest.raises(VisualizerError, match="Fake cannot render pictures"):
        env.render()
