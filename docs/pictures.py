"""Draws the documentation's pictures of environments and examples.

python docs/pictures.py    # writes environments, replay, examples, learn/spring .png, branch.webp
python docs/pictures.py --demo PICTURE    # compares a picture of the demo with its kept film
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import run_pages
from PIL import Image

import physx_gym
from physx_core import Visualizer
from physx_core.components import Event, Factory
from physx_core.pipelines import Learner
from physx_rerun import RerunVisualizer, render_film, render_picture

HERE = Path(__file__).parent
EXAMPLES = HERE.parent / "examples"
DEMO = HERE / "examples" / "09_robot_arm.webp"
sys.path.insert(0, str(EXAMPLES))  # their modules import each other
PUSHES, CLOUDS = 1600, 20_000
"""Numbers of samples that the networks of the beam and of the cloud learn from in the examples."""
NAMES = ("Cartpole", "Acrobot", "Ant", "Quadruped", "ArmReach", "PushBox")
COLUMNS = 3
FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")


def moved(name: str, steps: int, **options: Any) -> Any:
    """Return an environment in evaluation mode after some steps of an oscillating action."""
    env: Any = gymnasium.make(f"physx/{name}-v0", **options).unwrapped
    env.eval()
    env.reset(seed=3)
    space = env.action_space
    for step in range(steps):
        if isinstance(space, gymnasium.spaces.Discrete):
            action: Any = step // 4 % space.n
        else:
            action = 0.3 * np.sin(0.3 * step + np.arange(space.shape[0]))
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    return env


def picture(name: str, size: tuple[int, int]) -> np.ndarray:
    """Return a picture of an environment, shape (height, width, 3), uint8."""
    env = moved(name, 5, render_mode="rgb_array")
    env.viewer_kwargs["picture_size"] = size
    try:
        drawn: np.ndarray = env.render()
    finally:
        env.close()
    return drawn


def environments(path: Path, size: tuple[int, int] = (320, 240)) -> None:
    """Draw all environments, side by side."""
    tiles = [picture(name, size) for name in NAMES]
    rows = [np.hstack(tiles[first : first + COLUMNS]) for first in range(0, len(tiles), COLUMNS)]
    Image.fromarray(np.vstack(rows)).save(path, optimize=True)


def replay(path: Path, size: tuple[int, int] = (1500, 800)) -> None:
    """Draw the replay of a quadruped: its signals, contacts, a foot's path, and another motion."""
    with tempfile.TemporaryDirectory() as folder:
        logs = []
        for steps in (40, 25):
            env = moved("Quadruped", steps)
            env.stop()
            logs.append(env.log_data)
            env.close()
        recording = Path(folder, "replay.rrd")
        physx_gym.replay(logs[0], ghosts=logs[1], trajectories=[FEET[0]], path=recording)
        render_picture(recording, path, size)


def load(name: str) -> Any:
    """Load an example script as a module."""
    path = EXAMPLES / name
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def learn(folder: Path, pushes: int, clouds: int) -> tuple[Learner, Learner]:
    """Train the networks of 06_deformable_solid and 03_predict.

    Args:
        folder: Folder for their sessions.
        pushes: Number of samples of the beam.
        clouds: Number of samples of the cloud.
    """
    common, bending = load("common.py"), load("06_deformable_solid.py")
    cloud, beam = load("environments/cloud.py"), load("environments/beam.py").Beam
    session = common.generate(beam, pushes, folder, as_tcp_ip_client=False)
    made = {name: rest for name, *rest in bending.networks(epochs=40)}
    kind, wanted, epochs, arguments = made[bending.OWN]
    options = {**arguments, "activation": "SiLU"}
    network = common.config(kind, "forces", wanted, epochs, 2e-3, **options)
    bent = common.trained(session, network, epochs, seed=0)
    session = common.generate(cloud.Cloud, clouds, folder, as_tcp_ip_client=False)
    spread = common.trained(session, cloud.network(), epochs=12, seed=0, batch_size=64)
    return bent.learner, spread.learner


def play(
    environment: Any, number: int, steps: int, learner: Learner | None = None
) -> Iterator[list[Event]]:
    """Step an example's environment, and yield what it draws in each step.

    Args:
        environment: Class of the environment.
        number: Number of the instance, counted from 1.
        steps: Number of steps.
        learner: The network whose predictions it gets; None: none.
    """
    env = environment(instance_id=number, seed=3)
    try:
        env.create()
        env.init()
        env.init_database()
        env.factory = Factory()
        env.init_visualization()
        for env.step_index in range(steps):
            env.step()
            sample = env.take_sample()
            if learner is not None:
                given = {name: sample[name][None] for name in learner.network.net_fields}
                found = learner.predict_in_training(given)
                env.apply_prediction({name: rows[0] for name, rows in found.items()})
            yield env.factory.take_events()
    finally:
        env.close()


def show_environments(
    folder: Path, learners: tuple[Learner, Learner], *visualizers: Visualizer
) -> None:
    """Show the arm, the beam and the cloud of the examples, side by side.

    Args:
        folder: Folder for what is recorded.
        learners: The networks of the beam and of the cloud; the arm has none.
        visualizers: Show the scenes.
    """
    bending, spread = learners
    scenes = (
        play(load("environments/arm.py").ComparedArm, 1, 100),
        play(load("environments/beam.py").Beam, 2, 10, bending),
        play(load("environments/cloud.py").Cloud, 3, 4, spread),
    )
    for visualizer in visualizers:
        visualizer.open("examples", folder, len(scenes))
    for number, scene in enumerate(scenes, 1):
        for step, events in enumerate(scene):
            for visualizer in visualizers:
                visualizer.events(number, step, events)


def show_robots(path: Path) -> None:
    """Write a recording of the pushed box and the walking quadruped from the examples."""
    pushing, walking = load("11_pushing.py"), load("10_quadruped.py")
    box: Any = gymnasium.make("physx/PushBox-v0").unwrapped
    robot: Any = physx_gym.load_pipeline(walking.ROBOT)()
    for env in (box, robot):
        env.eval()
    observation, _ = box.reset(seed=0)
    for _ in range(12):
        observation, *_ = box.step(pushing.push(observation))
    walking.walk(robot, 0.5)
    logs = []
    for env in (box, robot):
        env.stop()
        logs.append(env.log_data)
        env.close()
    physx_gym.replay(logs, plots=False, frame_rate=5.0, path=path)


def examples(
    *watching: Visualizer, pushes: int = PUSHES, clouds: int = CLOUDS
) -> dict[str, np.ndarray]:
    """Return pictures of the examples' scenes, by name.

    Args:
        watching: Show the environments, too.
        pushes: Number of samples that the network of the beam learns from.
        clouds: Number of samples that the network of the cloud learns from.

    Returns:
        Pictures 1000 pixels wide: the environments and the robots in Rerun's viewer, and the
        environments in the viewer of ``examples/05_own_plugin``.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rerun = RerunVisualizer(path=folder / "environments.rrd")
        plain = load("05_own_plugin/src/physx_matplotlib.py").MatplotlibVisualizer((1000, 340))
        show_environments(folder, learn(folder, pushes, clouds), rerun, plain, *watching)
        drawn = {"matplotlib": plain.capture()}
        rerun.close()
        show_robots(folder / "robots.rrd")
        for name, height in (("environments", 520), ("robots", 340)):
            path = render_picture(folder / f"{name}.rrd", folder / f"{name}.png", (1000, height))
            drawn[name] = np.asarray(Image.open(path).convert("RGB"))
    return drawn


def sheet(drawn: dict[str, np.ndarray]) -> Image.Image:
    """Return the pictures of `examples` stacked vertically, with few colors."""
    rows = [drawn[name] for name in ("environments", "robots", "matplotlib")]
    return Image.fromarray(np.vstack(rows)).quantize(256)


def spring() -> np.ndarray:
    """Return the picture of docs/learn/5_viewer.md, drawn by the code of that page."""
    pages = [page for page in run_pages.LEARN if page.stem in ("1_environment", "5_viewer")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run_pages.run(pages, folder)
        recording = folder / "sessions" / "drawn" / "drawn.rrd"
        path = render_picture(recording, folder / "spring.png", (1000, 560))
        return np.asarray(Image.open(path).convert("RGB"))


def branch(path: Path) -> None:
    """Film the branch of docs/howto/branch.md, made by the code of that page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run_pages.run([HERE / "howto" / "branch.md"], folder)
        recording = folder / "sessions" / "branch" / "branch.rrd"
        render_film(recording, path, (720, 300), frames=30, frame_rate=10.0)


def shares(picture: np.ndarray) -> dict[str, float]:
    """Return the share of a picture's pixels that have each of these colors."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    colors = {
        "light": np.minimum(np.minimum(red, green), blue) > 150,
        "red": red - np.maximum(green, blue) > 100,
        "orange": (red - green > 40) & (green - blue > 40),
        "yellow": (np.minimum(red, green) > 150) & (blue < 90),
        "green": green - np.maximum(red, blue) > 25,
        "blue": (blue - red > 50) & (blue >= green),
    }
    return {name: float(mask.mean()) for name, mask in colors.items()}


def check_demo(path: Path) -> None:
    """Check that a picture of the demo shows what its kept film shows, maybe at another time."""
    for file in (path, DEMO):
        with Image.open(file) as image:
            image.seek(getattr(image, "n_frames", 1) // 2)  # of a film
            drawn = np.asarray(image.convert("RGB"))
        height, width = drawn.shape[:2]
        row = drawn[height // 30 : height * 52 // 90]  # the windows without their titles
        arms = [shares(each) for each in np.array_split(row, 3, axis=1)]
        assert all(arm["light"] > 0.015 for arm in arms), (file, "the arms", arms)
        lags = [arm["green"] for arm in arms]  # the visible part of the reference
        assert lags[0] > max(0.005, 1.5 * lags[1], 1.5 * lags[2]), (file, "the reference", lags)
        curves = shares(drawn[height * 56 // 90 : height * 85 // 90, : width * 52 // 90])
        assert curves["blue"] > 5e-4 and curves["orange"] > 5e-4, (file, "the plot", curves)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--demo"]:
        check_demo(Path(sys.argv[2]))
        sys.exit(0)
    environments(HERE / "environments.png")
    branch(HERE / "branch.webp")
    replay(HERE / "replay.png")
    sheet(examples()).save(HERE / "examples.png", optimize=True)
    Image.fromarray(spring()).quantize(256).save(HERE / "learn" / "spring.png", optimize=True)
    sys.exit(0)
