"""Branches: back to a stored row with the same bits, and on from there with a change."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Parameter,
    Training,
    Visualizer,
)
from physx_core.cli import main
from physx_core.components import Cursor
from physx_core.errors import DatasetError, UsageError
from physx_core.pipelines import Branch
from physx_core.results import read_results


class Walk(Environment):
    """A random walk whose steps have a length; 12 rows an episode."""

    episode_steps = 12

    def create(self):
        self.define_parameters([Parameter("length", 0.5, 2.0)])
        self.place = np.zeros(2)

    def init_database(self):
        self.define_training_fields([Field("before", (2,)), Field("after", (2,))])

    def init_visualization(self):
        self.factory.add_sphere("walker", radius=0.1)

    def reset_parameters(self, length):
        self.length, self.place[:] = length, 0.0

    def step(self):
        before = self.place.copy()
        self.place += self.length * self.rng.normal(size=2)
        self.set_training_data(before=before, after=self.place.copy())
        self.factory.update_sphere("walker", position=[*self.place, 0.0])


class Stream(Walk):
    """The same, without end."""

    episode_steps = None

    def create(self):
        self.place, self.length = np.zeros(2), 1.0

    def reset_parameters(self):
        pass


class Single(Walk):
    """Each row is an episode."""

    episode_steps = 1


class Asking(Walk):
    """Goes where a network says, if there is one to be asked."""

    def create(self):
        super().create()
        self.guide = "nobody"

    def step(self):
        if self.guide == "network":
            self.place[:] = self.get_prediction(before=self.place)["after"]
        super().step()


class Corrected(Walk):
    """Goes where it is told to be."""

    def apply_prediction(self, prediction):
        self.place[:] = prediction["after"]


class Painter(Visualizer):
    """Keeps what it gets."""

    known: list = []  # noqa: RUF012

    def open(self, run_name, session_dir, instance_nb):
        self.known.clear()
        self.known.append(instance_nb)

    def events(self, instance_id, step, events):
        self.known.append((instance_id, step, list(events)))

    @classmethod
    def cursor(cls):
        return Cursor("row", 17, {})


class Elsewhere(Painter):
    """Its cursor is on another timeline."""

    @classmethod
    def cursor(cls):
        return Cursor("epoch", 17, {})


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def generate(kind=Walk, clients=1, **amount):
    environment = EnvironmentConfig(kind, as_tcp_ip_client=False, seed=5, num_clients=clients)
    with DataGeneration(
        environment, session_name="data", quiet=True, **(amount or {"episodes": 4})
    ) as run:
        run.execute()
    return "sessions/data"


def branch(data, row, change=None, **options):
    run = Branch(data, row, change or {}, trust=True, quiet=True, **options)
    run.execute()
    return run


def stored(field):
    with Dataset.open("sessions/data") as dataset:
        return np.asarray(dataset["training"][field][:])


@pytest.mark.parametrize("row", [0, 12, 17, 46])
@pytest.mark.reported(
    "IsaacLab#2133",
    "Genesis#1150",
    about="an environment is copied, or goes back to an earlier moment",
)
def test_the_unchanged_future_is_the_stored_one_and_the_other_differs(row):
    run = branch(generate(), row, {"length": 0.0})
    left = 11 - row % 12
    was, changed = run.futures
    assert run.rows_equal == (row % 12 + 1, left)
    after = stored("after")
    assert np.array_equal(was["after"], after[row + 1 : row + 1 + left])
    assert np.array_equal(changed["after"], np.repeat(after[row : row + 1], left, axis=0))


def test_a_stream_of_several_instances_goes_on_beyond_its_stored_rows():
    run = branch(generate(Stream, clients=3, batch_nb=1, batch_size=30), 16, {"length": 2.0})
    was, changed = run.futures
    assert run.rows_equal == (6, 4) and len(was["after"]) == len(changed["after"]) == 100
    after = stored("after")
    assert np.array_equal(was["after"][:4], after[[19, 22, 25, 28]])
    steps = np.diff(np.concatenate([after[16:17], changed["after"]]), axis=0)
    own = np.diff(np.concatenate([after[16:17], was["after"]]), axis=0)
    assert np.allclose(steps, 2.0 * own)


@pytest.mark.parametrize("past", [3, 100])
def test_a_late_row_of_a_long_stream_is_reached_from_its_last_state(past):
    environment = EnvironmentConfig(
        Stream, as_tcp_ip_client=False, seed=5, num_clients=2, state_every=10
    )
    options = {"batch_nb": 10, "batch_size": 20, "session_name": "data", "quiet": True}
    DataGeneration(environment, **options).execute()
    run = branch("sessions/data", 191, {"length": 2.0}, past=past, step_nb=6)
    assert run.rows_equal == (6, 4)  # from row 90 of 100 of the second instance
    after = stored("after")
    assert np.array_equal(run.futures[0]["after"][:4], after[193::2])
    early = branch("sessions/data", 101, {"length": 2.0}, past=past, step_nb=6)
    assert early.rows_equal[0] > 40 and early.rows_equal[1] == 6  # from one long before


@pytest.mark.parametrize("kind", [Walk, Stream])
def test_a_row_of_a_run_that_goes_on_can_be_branched_off(kind):
    found = []

    class Looking(DataGeneration):
        def batch_end(self):
            if self.batch_id == 2:
                found.append(branch("sessions/data", 17, {"length": 0.0}, step_nb=3).rows_equal)

    environment = EnvironmentConfig(kind, as_tcp_ip_client=False, seed=5)
    options = {"batch_nb": 4, "batch_size": 12, "session_name": "data", "quiet": True}
    Looking(environment, **options).execute()
    assert found == [(6 if kind is Walk else 18, 3)]
    assert len(stored("after")) == 48


def test_arrays_are_changed_in_place_from_numbers_of_the_same_shape():
    run = branch(generate(), 3, {"place": [10.0, 20.0]})
    assert np.array_equal(run.futures[1]["before"][0], [10.0, 20.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lenght": 1.0}, "Walk has no lenght that could be set. It has length, place"),
        ({"rng": 1.0}, "Walk has no rng that could be set"),
        ({"length": "long"}, "length is .*; 'long' does not fit"),
        ({"place": [1.0, 2.0, 3.0]}, r"place has the shape \(2,\)"),
        ({"place": "here"}, "'here' does not fit"),
    ],
)
def test_changes_that_do_not_fit_are_named(change, message):
    data = generate()
    with pytest.raises(UsageError, match=message):
        branch(data, 3, change)


def test_rows_that_are_not_there_and_branches_without_a_change_are_refused():
    data = generate()
    with pytest.raises(DatasetError, match="no row 48 in the mode training: it has 48 rows"):
        branch(data, 48, {"length": 1.0})
    with pytest.raises(DatasetError, match='no mode "validation"'):
        branch(data, 0, {"length": 1.0}, mode="validation")
    with pytest.raises(UsageError, match="Nothing changes: give change"):
        branch(data, 0)


def test_an_environment_that_makes_other_rows_is_refused(monkeypatch):
    data = generate()
    monkeypatch.setattr(Walk, "reset_parameters", lambda self, length: setattr(self, "length", 3.0))
    with pytest.raises(UsageError, match='simulated again, row 0 has another "after"'):
        branch(data, 3, {"length": 1.0})


def train(data):
    network = NetworkConfig("toy/linear", {"net_fields": "before", "opt_fields": "after"})
    with Training(
        network, data, epoch_nb=1, batch_size=8, session_name="net", quiet=True, rivals="none"
    ) as run:
        run.execute()
        return run.learner


def test_a_network_is_asked_in_the_second_future_only():
    learner = train(generate(Asking))
    run = branch("sessions/data", 5, {"guide": "network"}, policy="sessions/net")
    expected = learner.predict({"before": stored("after")[5:6]})["after"][0]
    assert run.rows_equal == (6, 6)
    assert np.allclose(run.futures[1]["before"][0], expected)


def test_predictions_are_applied_in_the_second_future():
    learner = train(generate(Corrected))
    run = branch("sessions/data", 5, policy="sessions/net")
    changed = run.futures[1]
    told = learner.predict({"before": changed["before"]})["after"]
    assert np.allclose(changed["before"][1:], told[:-1])
    assert np.array_equal(changed["after"][0], stored("after")[6])


def test_a_network_that_nobody_asks_is_named():
    train(generate())
    with pytest.raises(UsageError, match="The network of sessions/net was never asked"):
        branch("sessions/data", 5, policy="sessions/net")


def test_both_futures_are_drawn_beside_their_common_past():
    painter = f"{__name__}:Painter"
    run = branch(generate(), 17, {"length": 0.0}, visualizer=painter, past=4)
    count, *drawn = Painter.known
    assert count == 2
    titles = [
        event.values["title"] for _, _, events in drawn for event in events if event.kind == "view"
    ]
    assert titles == ["as it was", "with length = 0"]
    places = {1: [], 2: []}
    for instance, _, events in drawn:
        places[instance] += [
            event.values["position"][:2] for event in events
            if event.kind == "sphere" and "position" in event.values
        ]  # fmt: skip
    past = stored("after")[14:18]
    for instance, future in zip((1, 2), run.futures, strict=True):
        assert np.allclose(places[instance][-len(past) - 6 :], [*past, *future["after"]])


def test_the_command_prints_what_became_of_both_and_stores_it(capsys):
    generate()
    words = ["sessions/data", "17", "--set", "length=0", "--visualizer", "None", "--trust"]
    assert main(["branch", *words]) == 0
    printed = capsys.readouterr().err
    assert "row 17 of training, simulated again: 6 rows equal those stored" in printed
    assert "as it was: 6 rows, of which 6 are stored and equal" in printed
    assert "with length = 0: 6 rows" in printed and "after: root mean square" in printed
    result = read_results("sessions/branch")["branch"]
    assert result["difference/after/rmse"] > 0
    assert main(["branch", *words[:1], "99", *words[2:]]) == 1
    assert "no row 99" in capsys.readouterr().err


def test_the_row_may_be_that_of_a_viewers_cursor(capsys, monkeypatch):
    generate()
    for kind, status, message in (
        (Painter, 0, "row 17 of training"),
        (Elsewhere, 1, "The cursor is on the timeline epoch"),
        (Visualizer, 1, "No installed visualizer has a cursor"),
    ):
        name = f"{kind.__module__}:{kind.__name__}"
        monkeypatch.setattr(
            "physx_core.cli.commands.branch.visualizer_plugins", lambda name=name: [name]
        )
        words = ["sessions/data", "cursor", "--set", "length=0", "--trust"]
        assert main(["branch", *words]) == status
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("at", [1, 9])
def test_ctrl_c_in_the_past_or_the_first_future_ends_it(monkeypatch, at):
    data, step, count = generate(), Walk.step, 0

    def interrupted(self):
        nonlocal count
        count += 1
        if count == at:
            signal.raise_signal(signal.SIGINT)
        step(self)

    monkeypatch.setattr(Walk, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        branch(data, 6, {"length": 0.0})
    assert count == at


@pytest.mark.parametrize(("kind", "row"), [(Walk, 47), (Single, 2)])
def test_the_last_row_of_an_episode_has_no_future(kind, row):
    data = generate(kind)
    with pytest.raises(UsageError, match=f"episode of row {row} ends with it"):
        branch(data, row, {"length": 0.0})
