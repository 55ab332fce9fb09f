"""The main road of trainings and predictions stays short: Python calls inside physx are counted."""

import sys

import numpy as np
import pytest

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
)


class Counter:
    """Counts the calls of functions of physx."""

    def __enter__(self):
        self.calls = []
        sys.setprofile(self._note)
        return self

    def _note(self, frame, event, argument):
        if event == "call" and "/src/physx_" in frame.f_code.co_filename:
            self.calls.append(frame.f_code.co_qualname)

    def __exit__(self, *error):
        sys.setprofile(None)


@pytest.fixture
def network(tmp_path, monkeypatch):
    """Return the configuration of a network for the samples of toy/spring in "data"."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        rows = {"state": rng.random((60, 2)), "next_state": rng.random((60, 2))}
        dataset.append("training", rows)
    fields = {"net_fields": "state", "opt_fields": "next_state"}
    options = {"layers": [2, 8, 2], **fields}
    return NetworkConfig("torch/fc", options, loss="MSELoss", optimizer="Adam", lr=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("normalize", [False, True])
def test_a_training_batch_makes_at_most_40_calls(network, normalize):
    data = DatasetConfig(existing_dir="data", normalize=normalize)
    with Training(network, data, epoch_nb=1, batch_size=10, quiet=True) as pipeline:
        pipeline.epoch_begin()
        for number in range(3):
            with Counter() as counter:
                pipeline.batch_condition()
                pipeline.batch_begin()
                pipeline.batch_produce()
                pipeline.optimize()
                pipeline.batch_count()
                pipeline.batch_end()
            assert number < 2 or len(counter.calls) <= 40, "\n".join(counter.calls)


@pytest.mark.slow
def test_a_prediction_step_makes_at_most_45_calls(network):
    data = DatasetConfig(existing_dir="data")
    Training(network, data, epoch_nb=1, batch_size=10, quiet=True).execute()
    environment = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    with Prediction(NetworkConfig(), environment, quiet=True) as pipeline:
        for number in range(3):
            with Counter() as counter:
                pipeline.sample_begin()
                pipeline.predict()
                pipeline.sample_end()
            assert number < 2 or len(counter.calls) <= 45, "\n".join(counter.calls)
