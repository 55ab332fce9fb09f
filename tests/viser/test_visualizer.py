"""What a person does on the page reaches the simulation, and is stored with its rows."""

from __future__ import annotations

import subprocess
from shutil import which
from types import SimpleNamespace

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig, Field, Parameter
from physx_core.components import Factory
from physx_core.pipelines import Branch
from physx_viser import ViserVisualizer

pytestmark = pytest.mark.processes


class Net(Environment):
    """Nodes in a row, which can be pulled at."""

    def create(self):
        self.stiffness, self.places = 1.0, np.zeros((4, 3))
        self.places[:, 0] = np.arange(4)
        self.pulled = np.zeros((4, 3))
        self.define_controls(Parameter("stiffness", 0.5, 2.0), ["net"])

    def init_database(self):
        self.define_training_fields(Field("places", (4, 3)))

    def init_visualization(self):
        self.factory.add_mesh("net", self.places, [[0, 1, 2], [1, 2, 3]])

    def pull(self, name, node, force):
        self.pulled[:] = 0.0
        self.pulled[node] = force

    def step(self):
        self.places += 0.1 * (self.pulled - self.stiffness * np.sin(self.places))
        self.set_training_data(places=self.places)
        self.factory.update_mesh("net", positions=self.places)


class Clock:
    """Time that passes only in sleep."""

    now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def page(tmp_path):
    """A page with a net, whose slider and nodes somebody can touch."""
    visualizer, net = ViserVisualizer(), Net()
    visualizer.open("net", tmp_path, 1)
    net.factory = factory = Factory()
    net.create()
    net.init_visualization()
    factory.add_controls("hand", ["stiffness"], low=[0.5], high=[2.0], values=[1.0], pulls=["net"])
    visualizer.events(1, 0, factory.take_events())
    yield visualizer
    visualizer.close()


def mouse(phase, at, to, part=None):
    return SimpleNamespace(phase=phase, start_position=at, end_position=to, instance_index=part)


def test_a_drag_pulls_at_the_nearest_vertex_until_the_mouse_lets_go(page):
    item = page._scenes[1].items["net"]
    assert page.touch(1) == [1.0, -1.0, 0.0, 0.0, 0.0, 0.0]
    page.drag(1, item, None, mouse("start", (2.2, 0.1, 0.0), (2.2, 0.1, 0.0)))
    page.drag(1, item, None, mouse("update", (2.2, 0.1, 0.0), (2.0, 0.0, 0.5)))
    assert page.touch(1) == [1.0, 0, 2, 0.0, 0.0, 5.0]
    page.drag(1, item, None, mouse("end", (2.2, 0.1, 0.0), (2.0, 0.0, 0.5)))
    assert page.touch(1)[1] == -1.0


def test_sliders_have_the_range_of_their_control(page):
    (slider,) = page._sliders
    assert (slider.min, slider.max, slider.value) == (0.5, 2.0, 1.0)
    slider.value = 1.5
    assert page.touch(1)[0] == 1.5


def test_a_simulation_is_held_back_to_its_own_time(page, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(ViserVisualizer, "clock", clock)
    factory = Factory()
    for step in range(1, 6):
        factory.set_time(0.1 * step)
        page.events(1, step, factory.take_events())
        page.touch(1)
    assert clock.now == pytest.approx(0.4)
    factory.set_time(0.0)  # another episode
    page.events(1, 6, factory.take_events())
    page.touch(1)
    assert clock.now == pytest.approx(0.4)


class Person(ViserVisualizer):
    """Moves the slider and drags, as if in a browser."""

    asked = 0

    def touch(self, instance_id):
        self.asked += 1
        if self.asked == 4:
            self._sliders[0].value = 1.75
        if self.asked in (6, 9):
            item, to = self._scenes[1].items["net"], (1.0, 0.3, 0.1 * self.asked)
            phase = "start" if self.asked == 6 else "update"
            self.drag(1, item, None, mouse(phase, (1.1, 0.0, 0.0), to))
        if self.asked == 12:
            self.grips.clear()
        return super().touch(instance_id)


def test_what_is_done_on_the_page_is_stored_and_simulated_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = EnvironmentConfig(Net, visualizer=Person, as_tcp_ip_client=False)
    run = DataGeneration(config, batch_nb=2, batch_size=10, quiet=True)
    run.execute()
    with Dataset.open(run.session.path) as dataset:
        hand = np.array(dataset["training"]["hand"][:])
    assert (hand[:3, 0] == 1.0).all() and (hand[3:, 0] == 1.75).all()
    assert (np.flatnonzero(hand[:, 1] == 0) == np.arange(5, 11)).all()
    assert len({*hand[5:11, 2]}) == 1 and hand[5:11, 3:].any()
    branch = Branch(run.session.path, 15, {"stiffness": 0.6}, step_nb=4, quiet=True, trust=True)
    branch.execute()
    assert branch.rows_equal == (16, 4)


@pytest.mark.faults
@pytest.mark.skipif(which("chromium") is None, reason="needs chromium")
def test_a_browser_opens_the_page(page):
    seen = []
    page.server.on_client_connect(lambda client: seen.append(client.client_id))
    (line,) = page.announcements()
    browser = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    subprocess.run(
        [*browser, "--virtual-time-budget=20000", line.removeprefix("viewer: ")],
        capture_output=True,
        timeout=120,
        check=True,
    )
    assert seen
