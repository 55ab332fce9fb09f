"""A person's hand: what was changed while environments ran is stored, and simulated again."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    Environment,
    EnvironmentConfig,
    Field,
    Parameter,
    Visualizer,
)
from physx_core.errors import UsageError
from physx_core.pipelines import Branch

pytestmark = pytest.mark.processes


class Chain(Environment):
    """Masses on springs in a row; it can be pulled at, and has a stiffness."""

    def create(self):
        self.stiffness, self.gravity = 4.0, np.array([0.0, 0.0, -1.0])
        self.places = np.arange(5.0)[:, np.newaxis] * [1.0, 0.0, 0.0]
        self.speeds, self.external = np.zeros((5, 3)), np.zeros((5, 3))
        self.define_controls(
            [Parameter("stiffness", 1, 20), Parameter("gravity", -10, 10, shape=(3,))], ["chain"]
        )

    def init_database(self):
        self.define_training_fields(Field("places", (5, 3)))

    def init_visualization(self):
        self.factory.add_points("chain", self.places)

    def pull(self, name, node, force):
        assert name == "chain"
        self.external[:] = 0.0
        self.external[node] = force

    def step(self):
        stretch = np.diff(self.places, axis=0) - [1.0, 0.0, 0.0]
        force = self.external + self.gravity
        force[:-1] += self.stiffness * stretch
        force[1:] -= self.stiffness * stretch
        force += 0.01 * self.rng.normal(size=(5, 3))
        self.speeds += 0.05 * force
        self.places += 0.05 * self.speeds
        self.set_training_data(places=self.places)
        self.factory.update_points("chain", positions=self.places)


class Parts(Chain):
    """The same in independent episodes, of which a sample is rejected now and then."""

    episode_steps = 8

    def reset_parameters(self):
        self.places[:] = np.arange(5.0)[:, np.newaxis] * [1.0, 0.0, 0.0]
        self.speeds[:] = 0.0

    def check_sample(self):
        return bool(self.rng.random() < 0.8)


class Mortal(Chain):
    """Its process dies once."""

    def step(self):
        if self.step_index == 9 and self.instance_id == 1 and not Path("died").exists():
            Path("died").touch()
            os._exit(9)
        super().step()


class Browser(Visualizer):
    """Somebody who moves sliders and pulls, at random but for a while."""

    known: list = []  # noqa: RUF012
    asked = 0

    def events(self, instance_id, step, events):
        self.known += [each for each in events if each.kind == "controls"]

    def touch(self, instance_id):
        Browser.asked += 1
        chosen = np.random.default_rng([Browser.asked // 3, instance_id])
        if chosen.random() < 0.3:
            return []
        pull = [0, chosen.integers(5), *chosen.normal(size=3)]
        pull = pull if chosen.random() < 0.7 else [-1, 0, 0, 0, 0]
        return [chosen.uniform(1, 20), *chosen.uniform(-1, 1, size=3), *pull]


class Crowded(Browser):
    """Sends what does not fit."""

    def touch(self, instance_id):
        return [1.0]


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Browser.known, Browser.asked = [], 0


def generate(environment, batches=4, clients=2, visualizer=Browser, **kwargs):
    config = EnvironmentConfig(
        environment, num_clients=clients, seed=5, visualizer=visualizer, **kwargs
    )
    run = DataGeneration(config, batch_nb=batches, batch_size=20, quiet=True)
    run.execute()
    return run.session.path


@pytest.mark.parametrize("environment", [Chain, Parts])
@pytest.mark.parametrize("clients", [False, True], ids=["in this process", "clients"])
def test_a_row_that_was_touched_is_simulated_again_with_the_same_bits(environment, clients):
    named = f"{__file__}:{environment.__name__}"
    path = generate(named if clients else environment, as_tcp_ip_client=clients)
    with Dataset.open(path) as dataset:
        done = np.array(dataset["training"]["hand"][:])
    assert len(np.unique(done[:, 0])) > 5 and {-1.0, 0.0} == {*done[:, 4]}
    row = 70
    branch = Branch(path, row, {"stiffness": 2.0}, step_nb=4, quiet=True, trust=True)
    branch.execute()
    past, future = branch.rows_equal
    assert past == (36 if environment is Chain else row % 8 + 1)
    assert future == (4 if environment is Chain else 8 - past)
    assert (branch.futures[0]["hand"] == branch.futures[1]["hand"]).all()


def test_viewers_are_told_what_can_be_changed():
    generate(Chain, batches=1, as_tcp_ip_client=False)
    assert len(Browser.known) == 2
    told = dict(Browser.known[0].values)
    assert list(told["labels"]) == ["stiffness", "gravity_0", "gravity_1", "gravity_2"]
    assert list(told["pulls"]) == ["chain"]
    assert told["low"].tolist() == [1, -10, -10, -10] and told["values"].tolist() == [4, 0, 0, -1]


def test_without_such_a_viewer_rows_have_no_hand_and_nobody_is_asked():
    path = generate(Chain, visualizer=None, as_tcp_ip_client=False)
    with Dataset.open(path) as dataset:
        assert "hand" not in dataset["training"]
    assert not Browser.asked


@pytest.mark.parametrize("every", [0, 7])
def test_a_resumed_run_goes_on_from_what_was_done(every):
    config = EnvironmentConfig(
        Chain, seed=5, visualizer=Browser, as_tcp_ip_client=False, state_every=every
    )
    options = {"batch_nb": 4, "batch_size": 10, "quiet": True, "session_name": "touched"}

    class Stopped(DataGeneration):
        def batch_end(self):
            if self.batch_id == 2:
                raise KeyboardInterrupt

    stopped = Stopped(config, **options)
    with pytest.raises(KeyboardInterrupt):
        stopped.execute()
    with Dataset.open(stopped.session.path) as dataset:
        assert len(dataset["training"]["hand"]) < 40
    run = DataGeneration(config, **options, new_session=False, resume=True)
    run.execute()
    with Dataset.open(run.session.path) as dataset:
        assert len(dataset["training"]["hand"]) == 40
    shutil.rmtree(run.session.path / "states", ignore_errors=True)  # repeat all of it
    branch = Branch(run.session.path, 35, {"stiffness": 2.0}, step_nb=4, quiet=True, trust=True)
    branch.execute()
    assert branch.rows_equal == (36, 4)


def test_a_client_that_takes_the_place_of_another_is_told_what_was_done_to_it():
    path = generate(f"{__file__}:Mortal", as_tcp_ip_client=True, retries=1)
    assert Path("died").exists()
    branch = Branch(path, 70, {"stiffness": 2.0}, step_nb=4, quiet=True, trust=True)
    branch.execute()
    assert branch.rows_equal == (36, 4)


def test_what_does_not_fit_is_an_error():
    with pytest.raises(UsageError, match="9 finite numbers"):
        generate(Chain, visualizer=Crowded, as_tcp_ip_client=False)

    class Deaf(Chain):
        pull = Environment.pull

    with pytest.raises(UsageError, match=r"pull\(\)"):
        generate(Deaf, as_tcp_ip_client=False)

    class Empty(Chain):
        def create(self):
            super().create()
            del self.stiffness

    with pytest.raises(UsageError, match="stiffness is None, but a control"):
        generate(Empty, as_tcp_ip_client=False)
