"""Replays: what they draw beside the motion, seen by a viewer that keeps all events."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from typing import ClassVar

import h5py
import numpy as np
import pytest

from physx_core.components import Visualizer
from physx_gym import RobotEnv, Simulator, replay
from physx_gym.cli import log as log_command
from physx_gym.errors import LogError
from physx_gym.telemetry.log_file import read_log
from physx_sim import BodySettings, Box, Ground, Robot, World
from physx_sim.errors import SimulationError


class Witness(Visualizer):
    """Keeps the events of the last replay: per object its first and its later values."""

    added: ClassVar[dict[str, dict]] = {}
    updates: ClassVar[dict[str, list]] = {}

    def __init__(self, **options):
        Witness.added, Witness.updates = {}, defaultdict(list)
        self.time = 0.0

    def events(self, instance_id, step, events):
        for event in events:
            if event.kind == "time":
                assert event.values["seconds"] >= self.time
                self.time = event.values["seconds"]
            elif event.action == "add":
                Witness.added[event.name] = {"kind": event.kind, **event.values}
        for event in (one for several in events for one in several.each()):
            if event.action == "update" and event.kind != "time":
                Witness.updates[event.name].append((self.time, dict(event.values)))


class Chase(RobotEnv):
    """The ant on the ground, and a target that moves after half of the episode."""

    view: ClassVar = {"eye": (3.0, 3.0, 2.0)}

    def __init__(self):
        world = World([Robot("ant", fixed_base=False)], period=5e-3, ground=Ground())
        super().__init__(Simulator(world, sensors=()), 0.05)
        self.target = np.zeros(3)

    def _initialize_buffers(self):
        self.target[:] = 1.0

    def _refresh_buffers(self):
        if self.num_steps == 10:
            self.target[0] = 2.0

    def has_terminated(self, info):
        return False, False

    def compute_reward(self, terminated, info):
        return float(self.num_steps)

    def _draw(self, scene):
        scene.add_sphere("target", 0.1, position=self.target)

    def _redraw(self, scene):
        scene.update_sphere("target", position=self.target)


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Files of two episodes."""
    found = []
    env = Chase()
    env.eval()
    for seed in range(2):
        path = tmp_path_factory.mktemp("logs") / f"ant{seed}.h5"
        env.reset(seed=seed, options={"log_path": path})
        for _ in range(20):
            env.step(env.action_space.sample())
        found.append(path)
        env.stop()
    env.close()
    return found


def test_a_replay_shows_signals_contacts_goals_ways_and_ghosts(paths):
    first, second = paths
    replay(first, ghosts=second, trajectories=["torso"], visualizer=Witness)
    added, updates = Witness.added, Witness.updates
    assert added["view"]["eye"].tolist() == [3.0, 3.0, 2.0]
    # signals: every row, with units
    units = {name: each["unit"] for name, each in added.items() if each["kind"] == "scalars"}
    assert units["q.base"] == "m"
    assert units["q"] == "rad"
    assert units["v.base 2"] == "rad/s"
    assert units["motor.torque"] == "N m"
    assert "a" not in units
    log = read_log(first)
    assert [values["values"].item() for _, values in updates["reward"]] == pytest.approx(
        log.column("reward.step").tolist()
    )
    assert [time for time, _ in updates["reward"]] == pytest.approx(log.time.tolist(), abs=1e-6)
    # contacts: forces carry the robot's weight once it stands
    assert added["contacts"]["kind"] == "arrows"
    assert any(len(values["vectors"]) for _, values in updates["contacts"])
    upwards = [values["vectors"][:, 2].sum() for _, values in updates["contacts"]]
    assert max(upwards) > 0
    # the goal, and when it moved
    assert added["target"]["position"].tolist() == [1.0, 1.0, 1.0]
    ((moved, values),) = updates["target"]
    assert values["position"].tolist() == [2.0, 1.0, 1.0]
    assert moved == pytest.approx(0.5, abs=0.05)
    # the way of the torso, and the ghost
    (way,) = added["path of torso"]["positions"]
    trajectory = log.trajectory().positions
    assert way[0] == pytest.approx(trajectory[0, :3], abs=1e-5)
    assert way[-1] == pytest.approx(trajectory[-1, :3], abs=1e-5)
    ghost = added["ghost1_robot"]
    assert ghost["alpha"] < 0.5
    assert len(updates["ghost1_robot"]) == len(updates["robot"])


def test_what_a_replay_shows_is_chosen(paths):
    replay(paths[0], plots=["motor.command"], contacts=False, visualizer=Witness)
    kinds = {name: each["kind"] for name, each in Witness.added.items()}
    assert [name for name, kind in kinds.items() if kind == "scalars"] == ["motor.command"]
    assert "contacts" not in kinds
    replay(paths[0], plots=False, ghosts=read_log(paths[1]).trajectory(), visualizer=Witness)
    assert "scalars" not in {each["kind"] for each in Witness.added.values()}
    assert "ghost1_robot" in Witness.added
    with pytest.raises(SimulationError, match="trunk"):
        replay(paths[0], trajectories="trunk", visualizer=Witness)


@pytest.mark.slow
def test_a_command_replays_with_ghosts(paths, tmp_path, capsys):
    path = tmp_path / "both.rrd"
    words = [str(paths[0]), "--replay", str(path), "--ghosts", str(paths[1])]
    log_command.run([*words, "--columns", "motor.torque", "--trajectories", "torso"])
    assert f"recording: {path}" in capsys.readouterr().out
    assert path.stat().st_size > 1000


class Hall(Chase):
    """A door that moves and a crate that is hidden after half of the episode."""

    def __init__(self):
        door = Box(name="door", size=(0.1, 1.0, 1.0), static=True, position=(2.0, 0.0, 0.5))
        crate = Box(name="crate", size=(0.2, 0.2, 0.2), position=(0.0, 3.0, 0.1))
        robots = [Robot("ant", fixed_base=False)]
        world = World(robots, period=5e-3, ground=Ground(), objects=[door, crate])
        RobotEnv.__init__(self, Simulator(world, sensors=()), 0.05)
        self.target = np.zeros(3)

    def _initialize_buffers(self):
        self.simulator.simulation.set_body("door", BodySettings(velocity=(0.0, 1.0, 0.0)))

    def _refresh_buffers(self):
        if self.num_steps == 10:
            self.simulator.simulation.set_body("crate", BodySettings(hidden=True))


def test_objects_that_moved_or_were_hidden_are_so_in_the_replay(tmp_path):
    with Hall() as env:
        env.eval()
        env.reset(seed=0, options={"log_path": tmp_path / "hall.h5"})
        for _ in range(20):
            env.step(env.action_space.sample())
        env.stop()
    replay(tmp_path / "hall.h5", path=tmp_path / "hall.rrd", visualizer=Witness)
    times, places = zip(
        *((time, values["position"][1]) for time, values in Witness.updates["door"]), strict=True
    )
    np.testing.assert_allclose(places, times, atol=0.06)
    assert places[-1] == pytest.approx(1.0, abs=0.06)
    seen = [time for time, values in Witness.updates["crate"] if values.get("visible") is False]
    assert seen and seen[0] == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("moved", [[1], [[0.0, "nothing", [], True]], [[0.0, "ground", [1], True]]])
def test_moved_objects_that_cannot_be_read_are_an_error_of_the_log(paths, moved):
    log = read_log(paths[0])
    damaged = dataclasses.replace(log, constants={**log.constants, "scene": {"moved": moved}})
    with pytest.raises(LogError, match="moved objects"):
        replay(damaged, path="unused.rrd", visualizer=Witness)


def test_contacts_and_scenes_go_through_files_and_restored_states(tmp_path):
    env = Chase()
    env.eval()
    env.reset(seed=0, options={"log_path": tmp_path / "a.h5"})
    for _ in range(8):
        env.step(env.action_space.sample())
    state, sampled = env.snapshot(), [env.action_space.sample() for _ in range(8)]
    for _ in range(2):
        env.restore(state)
        for action in sampled:
            env.step(action)
    data = env.log_data["constants"]
    env.stop()
    assert len(data["scene"]["changes"]) == 1
    contacts = data["contacts"]
    assert (np.diff(contacts[:, 0]) >= 0).all()
    read = read_log(tmp_path / "a.h5")
    assert np.array_equal(read.contacts, contacts)
    assert read.constants["scene"]["changes"][0][1:] == ["target", {"position": [2.0, 1.0, 1.0]}]
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["contacts"]
        file["contacts"] = np.zeros((3, 6))
    with pytest.raises(LogError, match="contacts of 6 numbers"):
        read_log(tmp_path / "a.h5")


@pytest.mark.parametrize(
    "scene",
    [
        {"added": [{"kind": "take_events", "name": "x", "values": {}}]},
        {"added": [{"kind": "box", "name": "x", "values": {"half_sizes": [1, 2]}}]},
        {"added": [], "changes": [[0.0, "unknown", {}]]},
        {"added": 5},
    ],
    ids=["kind", "shape", "name", "type"],
)
def test_a_scene_that_cannot_be_drawn_is_an_error_of_the_log(paths, scene):
    log = read_log(paths[0])
    damaged = dataclasses.replace(log, constants={**log.constants, "scene": scene})
    with pytest.raises(LogError, match="drawn again"):
        replay(damaged, visualizer=Witness)
