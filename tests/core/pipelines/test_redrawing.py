"""Redrawing: stored rows are drawn again by the environment that generated them, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig, Field, Parameter
from physx_core.errors import UntrustedReferenceError, UsageError
from physx_core.pipelines import Redrawing


class Ball(Environment):
    """A ball at random places, drawn, that saves a number and may be told a prediction."""

    shift = 0.0

    def create(self):
        self.define_parameters([Parameter("height", 0.0, 1.0)])
        self.save_parameters(offset=self.load_parameters().get("offset", 0.5))

    def init_database(self):
        self.define_training_fields([Field("place", (3,))])

    def init_visualization(self):
        self.factory.add_sphere("ball", radius=0.1)

    def reset_parameters(self, height):
        self.height = height

    def step(self):
        place = [self.rng.uniform(), self.height, self.load_parameters()["offset"]]
        self.set_training_data(place=np.array(place) + self.shift)
        self.factory.update_sphere("ball", position=place)


class Throw(Ball):
    """Throws of a ball, by number."""

    episode_steps = 4


class Draw(Ball):
    """Each place is an episode."""

    episode_steps = 1


class Told(Ball):
    """Draws what is predicted."""

    def init_visualization(self):
        self.factory.add_sphere("ball", radius=0.1)
        self.factory.add_sphere("predicted", radius=0.1)

    def apply_prediction(self, prediction):
        self.factory.update_sphere("predicted", position=prediction["place"])


def generate(kind, **options):
    environment = EnvironmentConfig(kind, as_tcp_ip_client=False, seed=3, **options)
    amount = {"episodes": 10} if kind.episode_steps else {"batch_nb": 5, "batch_size": 8}
    with DataGeneration(environment, session_name="data", quiet=True, **amount) as run:
        run.execute()


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def places(frames, name="ball"):
    """Return where an object was last drawn at each frame."""
    found, place = [], None
    for frame in frames:
        for event in (one for several in frame for one in several.each()):
            if event.name == name and "position" in event.values:
                place = event.values["position"]
        found.append(place)
    return np.array(found)


@pytest.mark.parametrize(
    ("kind", "clients", "rows"),
    [(Throw, 2, [5, 6, 18, 39]), (Draw, 1, [2, 3, 9]), (Ball, 2, [1, 7, 39]), (Ball, 1, [0, 3])],
)
def test_rows_are_drawn_as_they_were_generated(kind, clients, rows):
    generate(kind, num_clients=clients)
    with Dataset.open("sessions/data") as dataset:
        stored = np.array(dataset["training"]["place"])[rows]
        for _ in range(2):
            with Redrawing(dataset, "training", trust=True) as drawing:
                drawn = places(drawing.frames(rows))
            np.testing.assert_allclose(drawn, stored, rtol=1e-6)
        assert not drawing.takes_predictions


def test_an_environment_that_draws_predictions_gets_them():
    generate(Told)
    with Dataset.open("sessions/data") as dataset:
        known = {row: {"place": np.full(3, float(row))} for row in (1, 3)}
        with Redrawing(dataset, "training", trust=True) as drawing:
            drawn = places(drawing.frames([1, 3], known.get), "predicted")
        assert drawing.takes_predictions
    np.testing.assert_allclose(drawn, [[1, 1, 1], [3, 3, 3]])


@pytest.mark.parametrize("kind", [Throw, Ball])
def test_an_environment_that_has_changed_draws_nothing(monkeypatch, kind):
    generate(kind)
    monkeypatch.setattr(kind, "shift", 1e-6)
    with (
        Dataset.open("sessions/data") as dataset,
        Redrawing(dataset, "training", trust=True) as drawing,
        pytest.raises(UsageError, match='simulated again, row 0 has another "place"'),
    ):
        list(drawing.frames([1, 2]))


def test_code_of_others_is_not_imported_and_rows_of_unknown_origin_are_not_drawn():
    generate(Throw)
    with Dataset.open("sessions/data") as dataset:
        with pytest.raises(UntrustedReferenceError, match="trust"):
            Redrawing(dataset, "training")
        before = {each: each.read_bytes() for each in dataset.directory.rglob("*.bin")}
        with Redrawing(dataset, "training", trust=True) as drawing:
            list(drawing.frames([0]))
        assert before == {each: each.read_bytes() for each in dataset.directory.rglob("*.bin")}
    generate(Ball)
    with Dataset.open("sessions/data_1", writable=True) as dataset:
        dataset.append("test", {"place": np.zeros((4, 3))})
        with (
            Redrawing(dataset, "test", trust=True) as drawing,
            pytest.raises(UsageError, match="does not say how these rows were generated"),
        ):
            list(drawing.frames([0]))
