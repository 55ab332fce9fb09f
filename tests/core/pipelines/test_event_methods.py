"""The events and steps of each pipeline: all of them, in their order, and what they can decide.

Whoever overrides an event loses nothing; whoever replaces a step is told what it leaves out.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Replay,
    Training,
    View,
)
from physx_core.errors import UsageError
from physx_core.pipelines.storage import STREAMS

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
NETWORK = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
DATA = DatasetConfig(existing_dir="sessions/run")

TIMED = ("info.txt", "results.json")


def noting(make, names):
    """A subclass that notes each event in `calls` and does what the pipeline does."""

    def note(name):
        def method(self):
            if not name.endswith("condition"):
                Noting.calls.append(name)
            return getattr(make, name)(self)

        return method

    Noting = type("Noting", (make,), {name: note(name) for name in names.split()} | {"calls": []})
    return Noting


@pytest.fixture(autouse=True)
def run():
    """A session with ten samples."""
    DataGeneration(SPRING, session_name="run", batch_nb=1, batch_size=10).execute()


def test_those_of_a_data_generation():
    make = noting(
        DataGeneration,
        "data_generation_begin data_generation_end "
        "batch_begin batch_condition batch_produce batch_count batch_end",
    )
    make(SPRING, batch_nb=2, batch_size=3).execute()
    batch = ["batch_begin", "batch_produce", "batch_count", "batch_end"]
    assert make.calls == ["data_generation_begin", *batch, *batch, "data_generation_end"]


def test_those_of_a_training():
    make = noting(
        Training,
        "train_begin train_end epoch_begin epoch_condition epoch_count epoch_end "
        "batch_begin batch_condition batch_produce optimize batch_count batch_end",
    )
    make(NETWORK, DATA, epoch_nb=2, batch_size=5).execute()
    batch = ["batch_begin", "batch_produce", "optimize", "batch_count", "batch_end"]
    epoch = ["epoch_begin", *batch, *batch, "epoch_count", "epoch_end"]
    assert make.calls == ["train_begin", *epoch, *epoch, "train_end"]


def test_those_of_a_prediction_and_a_replay():
    Training(NETWORK, DATA, epoch_nb=1, batch_size=10).execute()
    make = noting(
        Prediction,
        "prediction_begin prediction_condition prediction_end sample_begin predict sample_end",
    )
    make(NetworkConfig(), SPRING, step_nb=2).execute()
    step = ["sample_begin", "predict", "sample_end"]
    assert make.calls == ["prediction_begin", *step, *step, "prediction_end"]
    make = noting(Replay, "replay_begin replay_condition replay_end sample_begin replay sample_end")
    make(DATA, SPRING, step_nb=2).execute()
    step = ["sample_begin", "replay", "sample_end"]
    assert make.calls == ["replay_begin", *step, *step, "replay_end"]


def test_conditions_decide_how_long_a_run_is():
    class Short(Training):
        def epoch_condition(self):
            return self.epoch_id < 1

        def batch_condition(self):
            return self.batch_id < 3

    class Endless(Prediction):
        def prediction_condition(self):
            return self.step_id < 4

    short = Short(NETWORK, DATA, epoch_nb=5, batch_size=1)
    short.execute()
    assert (short.epoch_id, len(short.data.dataset.modes)) == (1, 1)
    rows = Path("sessions/training/stats/scalars.csv").read_text().count("loss/batch")
    assert rows == 3
    endless = Endless(NetworkConfig(), SPRING, step_nb=-1)
    endless.execute()
    assert endless.step_id == 4


def test_what_a_pipeline_works_with_is_at_hand_while_it_is_open():
    with DataGeneration(SPRING, batch_nb=1, batch_size=2) as pipeline:
        assert pipeline.source.instance_nb == 1 and pipeline.observers is not None
        pipeline.execute()
        assert pipeline.dataset.num_samples("training") == 2
    absolute = Path("elsewhere").absolute()
    with Training(
        NETWORK, DATA, epoch_nb=1, batch_size=5, session_dir=str(absolute), new_session=False
    ) as pipeline:
        assert pipeline.data.source is None and pipeline.learner.network.nb_parameters() > 0
        pipeline.execute()
    assert (absolute / "training" / "network" / "network_0").is_dir()


# Events are empty ---------------------------------------------------------------------------------


def generation(make=DataGeneration, place="plain", **options):
    options = {"session_dir": place, "batch_nb": 2, "batch_size": 3, **options}
    return make(SPRING, **options)


def training(make=Training, place="plain", data=None, *, save_each_epoch=True, **options):
    held_back = DatasetConfig(existing_dir="sessions/run", view=View(fold=0), normalize=True)
    network = dataclasses.replace(NETWORK, save_each_epoch=save_each_epoch)
    options = {"session_dir": place, "epoch_nb": 3, "batch_size": 3, "seed": 5, **options}
    return make(network, held_back if data is None else data, **options)


def online_training(make=Training, place="plain"):
    return training(
        make, place, DatasetConfig(), environment_config=SPRING, batch_nb=2, checkpoint_every=1
    )


def prediction(make=Prediction, place="plain"):
    training(place=place, new_session=False).execute()
    return make(NetworkConfig(), SPRING, session_dir=place, step_nb=3, record=True)


def replay(make=Replay, place="plain"):
    return make(DATA, SPRING, session_dir=place)


PIPELINES = [generation, training, online_training, prediction, replay]
KIND = {generation: DataGeneration, prediction: Prediction, replay: Replay}


def events_of(make):
    kind = KIND.get(make, Training)
    return [name for name in dir(kind) if name.endswith(("_begin", "_end")) and name[0] != "_"]


def stored(place):
    """The content of all files below a folder, except those that tell times, and file headers."""
    found = {}
    for path in Path(place).rglob("*"):
        name = str(path.relative_to(place))
        if path.name == "dataset.json":
            with Dataset.open(path.parent) as dataset:
                found[f"{name}: rows"] = {
                    (mode, field): values[:].tobytes()
                    for mode in dataset.modes
                    for field, values in dataset[mode].items()
                }
        if path.is_file() and path.suffix != ".h5" and path.name not in TIMED:
            found[name] = path.read_bytes().replace(str(place).encode(), b"PLACE")
        if path.name == "dataset.json":  # own steps say nothing of how to go on with the streams
            plain = json.loads(found[name])
            plain["info"].pop(STREAMS, None)
            found[name] = {key: value for key, value in plain.items() if key != "crc32"}
    return found


def without(kind, *names):
    return type("Own", (kind,), {name: lambda self: None for name in names})


@pytest.mark.slow
@pytest.mark.parametrize("make", PIPELINES)
def test_overriding_events_changes_no_file(make):
    make().execute()
    expected, names = stored("plain"), events_of(make)
    assert len(names) >= 4 and len(expected) >= 2
    for overridden in (names, *([name] for name in names)):
        place = "_".join(["own", *overridden])
        make(without(KIND.get(make, Training), *overridden), place).execute()
        assert stored(place) == expected, overridden


def test_an_epoch_ends_when_its_losses_are_known_and_before_its_checkpoint():
    class Own(Training):
        seen = ()

        def epoch_end(self):
            self.seen += ((self.epoch_id, self.validation_loss, self.checkpoint_path),)

        def train_end(self):
            self.learner.network.weights[:] = 7

    own = training(Own)
    own.execute()
    assert [number for number, *_ in own.seen] == [1, 2, 3]
    assert np.isfinite([loss for _, loss, _ in own.seen]).all()
    assert [path and path.name for *_, path in own.seen] == [None, "network_0", "network_1"]
    last = np.load(own.checkpoint_path / "parameters.npz")
    assert all((values == 7).all() for values in last.values())


def test_an_error_in_the_last_event_loses_no_network():
    class Own(Training):
        def train_end(self):
            raise ZeroDivisionError

    own = training(Own)
    with pytest.raises(ZeroDivisionError) as caught:
        own.execute()
    assert "network_2" in caught.value.__notes__[0] and own.checkpoint_path.name == "network_2"


# Steps may be replaced ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "step", "missing"),
    [
        (generation, "batch_condition", "returned None"),
        (generation, "batch_produce", "stored no samples"),
        (generation, "batch_count", "did not advance batch_id"),
        (training, "epoch_condition", "returned None"),
        (training, "batch_condition", "returned None"),
        (training, "batch_produce", "set no batch"),
        (training, "optimize", "set no losses"),
        (training, "batch_count", "did not advance batch_id"),
        (training, "epoch_count", "did not advance epoch_id"),
        (prediction, "prediction_condition", "returned None"),
        (prediction, "predict", "set no batch and prediction"),
        (replay, "replay_condition", "returned None"),
        (replay, "replay", "set no batch"),
    ],
)
def test_a_replaced_step_that_leaves_something_out_is_named(make, step, missing):
    own = without(KIND.get(make, Training), step)
    with pytest.raises(UsageError, match=rf"^Own\.{step}\(\) {missing}: call super\(\)\.{step}\("):
        make(own).execute()


def test_a_step_that_is_left_out_later_is_named_too():
    class Skips(Training):
        def optimize(self):
            if self.batch_id == 0:
                super().optimize()

    class Pauses(DataGeneration):
        def batch_produce(self):
            if self.batch_id == 0:
                super().batch_produce()

    for make, own in ((training, Skips), (generation, Pauses)):
        with pytest.raises(UsageError, match=r"(optimize|batch_produce)\(\) (set|stored) no"):
            make(own).execute()


def test_a_prediction_that_records_nothing_is_named():
    class Own(Prediction):
        def predict(self):
            self.batch = self.source.batch(1)
            self.prediction = self.learner.predict(self.batch)

    with pytest.raises(UsageError, match=r"Own\.predict\(\) recorded no samples"):
        prediction(Own).execute()


@pytest.mark.slow
def test_replaced_steps_that_do_the_same_store_the_same():
    class Generates(DataGeneration):
        def batch_produce(self):
            self.batch = self.source.batch(self.batch_size)
            self.dataset.define_fields("training", self.source.fields)
            self.dataset.append("training", self.batch)

        def batch_count(self):
            self.batch_id += 1

    class Trains(Training):
        def batch_produce(self):
            self.batch = self.data.next_batch()

        def optimize(self):
            self.losses.update(self.learner.optimize(self.batch))

        def batch_count(self):
            self.batch_id += 1

        def epoch_count(self):
            self.epoch_id += 1

    class Predicts(Prediction):
        def predict(self):
            self.batch = self.source.batch(1)
            self.prediction = self.learner.predict(self.batch)
            self.source.apply(self.prediction)
            self._store(self.dataset)

    for make, own in ((generation, Generates), (training, Trains), (prediction, Predicts)):
        for place, kind in (("plain", KIND.get(make, Training)), ("own", own)):
            make(kind, place).execute()
        assert stored("own") == stored("plain"), own


# A loop of one's own over the steps ---------------------------------------------------------------


def loop(pipeline, tells):
    """What `execute` does, written by a user who calls all events, or only the steps."""
    event = (lambda name: getattr(pipeline, name)()) if tells else lambda name: None
    if isinstance(pipeline, DataGeneration):
        event("data_generation_begin")
        while pipeline.batch_condition():
            event("batch_begin")
            pipeline.batch_produce()
            pipeline.batch_count()
            event("batch_end")
        event("data_generation_end")
    elif isinstance(pipeline, Training):
        train(pipeline, event)
    else:
        decides, step = (
            (pipeline.prediction_condition, pipeline.predict)
            if isinstance(pipeline, Prediction)
            else (pipeline.replay_condition, pipeline.replay)
        )
        while decides():
            event("sample_begin")
            step()
            event("sample_end")


def train(pipeline, event):
    event("train_begin")
    while pipeline.epoch_condition():
        event("epoch_begin")
        while pipeline.batch_condition():
            event("batch_begin")
            pipeline.batch_produce()
            pipeline.optimize()
            pipeline.batch_count()
            event("batch_end")
        pipeline.epoch_count()
        event("epoch_end")
    event("train_end")


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize("make", [generation, training, prediction, replay])
def test_a_loop_of_ones_own_stores_the_same(make, tells):
    kind = KIND.get(make, Training)
    own = {"save_each_epoch": False} if make is training else {}  # the loop decides when to write
    make(kind, "plain", **own).execute()
    with make(kind, "own", **own) as pipeline:
        loop(pipeline, tells)
    assert stored("own") == stored("plain")


def test_a_pipeline_runs_again_while_it_is_open_and_after_it_was_closed():
    pipeline = generation(new_session=False)
    with pipeline:
        pipeline.execute()
        pipeline.execute()
    with pipeline:
        loop(pipeline, tells=False)
    with Dataset.open(pipeline.session.path) as dataset:
        assert dataset.num_samples("training") == 3 * 6
