"""The event methods of each pipeline: all of them, in their order, and what they can decide."""

from __future__ import annotations

from pathlib import Path

import pytest

from physx_core import (
    DataGeneration,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Replay,
    Training,
)

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
NETWORK = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
DATA = DatasetConfig(existing_dir="sessions/run")


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
