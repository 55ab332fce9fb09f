"""Everything that environments draw is in their pictures."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import physx_gym  # noqa: F401 - registers environments
from physx_core import DataGeneration, EnvironmentConfig, plugins
from physx_core.components import Factory, Visualizer
from physx_core.rotations import rotate_rows
from physx_rerun.drawing.chunks import ChunkBuilder
from physx_rerun.drawing.drawing import Drawing
from physx_rerun.drawing.framing import Frame
from physx_rerun.drawing.windows import WindowLayout

EXAMPLES = Path(__file__).parents[3] / "examples"
PLUGINS = ("toy", "dart", "pinocchio")
ENVIRONMENTS = [
    f"{name}/{environment}"
    for name in PLUGINS
    for environment in plugins.load(name).components["environment"]
]
GYM = sorted(name for name in gymnasium.registry if name.startswith("physx/"))
FIELD = np.tan(np.deg2rad(55 / 2))  # of Rerun's pictures, upward
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


class Recorder(Visualizer):
    """Keeps the events of each step."""

    steps: list

    def __init__(self, **options):
        Recorder.steps = []

    def events(self, instance_id, step, events):
        Recorder.steps.append(list(events))

    def capture(self):
        return np.zeros((3, 4, 3), np.uint8)


def points_of(kind, values):
    """Return points of an object in the world; of robots the origins of their links."""
    if kind == "robot":
        return values["poses"][:, :3]
    if kind == "lines":
        return np.concatenate(values["positions"])
    if kind in ("box", "sphere", "capsule", "cylinder"):
        if kind == "box":
            half = values["half_sizes"]
        else:
            radius, length = values["radius"], values.get("length", 0.0)
            cap = radius if kind != "cylinder" else 0.0
            half = np.array([radius, radius, 0.5 * length + cap])
        turn = np.array(values.get("orientation", [0, 0, 0, 1]), float)
        return rotate_rows(turn, SIGNS * half) + values.get("position", np.zeros(3))
    if "vectors" in values:
        return np.concatenate([values["positions"], values["positions"] + values["vectors"]])
    return values["positions"]


def hidden_of(steps):
    """Draw steps; return the names of the objects that are not in the picture of their step."""
    rows, layout = ChunkBuilder(), WindowLayout(1)
    drawing, scene, found = Drawing(1, rows, layout, draws_shapes=True), {}, set()
    follows = False
    for step, events in enumerate(steps):
        drawing.draw([event for event in events if event.kind != "time"], {"step": step})
        rows.pop_chunks()
        for event in (one for several in events for one in several.each()):
            if event.kind == "view":
                follows = bool(event.values.get("follow"))
            elif event.kind not in ("time", "text", "scalars", "image"):
                values = scene.setdefault((event.kind, event.name), {})
                values.update(event.values)
        if follows and step:
            continue
        for (kind, name), values in scene.items():
            if values.get("in_view", True) and not is_seen(layout, points_of(kind, values)):
                found.add(name)
    assert scene
    return found


def is_seen(layout, points):
    """Return whether the camera of a layout has points in its picture of 4 by 3."""
    contents = layout.blueprint().root_container.contents
    while not hasattr(contents[0], "properties"):
        contents = contents[0].contents
    eye = contents[0].properties["EyeControls3D"]
    position, target, up = (
        np.array(part.as_arrow_array().to_pylist()[0])
        for part in (eye.position, eye.look_target, eye.eye_up)
    )
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    ahead, aside, above = (
        (points - position) @ axis for axis in (forward, right, np.cross(right, forward))
    )
    in_width, in_height = np.abs(aside) <= 4 / 3 * FIELD * ahead, np.abs(above) <= FIELD * ahead
    return bool((ahead > 0).all() and in_width.all() and in_height.all())


@pytest.mark.slow
@pytest.mark.parametrize("reference", ENVIRONMENTS)
def test_every_environment_is_in_its_picture(reference, tmp_path):
    DataGeneration(
        EnvironmentConfig(reference, as_tcp_ip_client=False, visualizer=Recorder, seed=1),
        session_dir=str(tmp_path),
        batch_nb=1,
        batch_size=20,
    ).execute()
    assert hidden_of(Recorder.steps) == set()


@pytest.mark.slow
@pytest.mark.parametrize("name", GYM)
def test_every_robot_environment_is_in_its_picture(name):
    env = gymnasium.make(name, render_mode="rgb_array")
    env.unwrapped.viewer_kwargs["visualizer"] = Recorder
    for seed in (1, 60):
        env.reset(seed=seed)
        env.render()
        for _ in range(3):
            env.step(env.action_space.sample())
            env.render()
    env.close()
    assert hidden_of(Recorder.steps) == set()


@pytest.mark.parametrize(
    ("file", "cls"), [("environments/cloud.py", "Cloud"), ("environments/beam.py", "Beam")]
)
def test_every_example_is_in_its_picture(file, cls, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    spec = importlib.util.spec_from_file_location("example", EXAMPLES / file)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        pytest.skip(f"the example needs {error.name}")
    DataGeneration(
        EnvironmentConfig(
            getattr(module, cls), as_tcp_ip_client=False, visualizer=Recorder, seed=1
        ),
        session_dir=str(tmp_path),
        batch_nb=1,
        batch_size=4,
    ).execute()
    assert hidden_of(Recorder.steps) == set()


def recorded(draw, steps=1):
    factory, found = Factory(), []
    for step in range(steps):
        draw(factory, step)
        found.append(factory.take_events())
    return found


def test_small_things_do_not_hide_large_ones():
    def draw(factory, step):
        factory.add_points("cloud", np.random.default_rng(0).random((9, 3)), size=0.02)
        factory.add_sphere("goal", 0.01, position=[3, 0, 0])
        factory.add_box("ground", (100, 100, 1), in_view=False)
        factory.add_points("corner", [[0, 0, 4]])

    assert hidden_of(recorded(draw)) == set()


def test_what_moves_stays_in_view():
    def draw(factory, step):
        if step == 0:
            factory.add_box("near", [1, 2, 3])
            factory.add_box("far", [1, 2, 3])
            factory.add_points("cloud", np.zeros((1, 3)))
        factory.update_box("far", position=[step, 2 * step, 0], orientation=[0, 0, 1, 1])
        factory.update_points("cloud", positions=[[-step, 0, 0]])

    assert hidden_of(recorded(draw, 40)) == set()


def test_a_scene_that_grows_is_seldom_framed_anew():
    frame, times = Frame(), 0
    for size in range(1, 1000):
        frame.see(np.zeros(3), np.full(3, float(size)))
        frame.camera()
        times += frame.grow()
    assert times < 40
