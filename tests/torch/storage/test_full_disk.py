"""A checkpoint's parameters that do not fit on the disk."""

import resource

import numpy as np
import pytest

from physx_core import Field, NetworkConfig
from physx_core.checkpoint import Progress
from physx_core.errors import CheckpointError
from physx_core.pipelines import Learner, load_learner

PROGRESS = Progress(1, 0, 1, 0)


@pytest.mark.slow
def test_parameters_that_do_not_fit_leave_the_earlier_checkpoint_and_no_leftover(tmp_path):
    arguments = {"layers": [64, 200, 64], "net_fields": "x", "opt_fields": "y"}
    config = NetworkConfig("torch/fc", arguments, loss="MSELoss", optimizer="Adam", device="cpu")
    learner = Learner(config, trains=True)
    learner.bind({name: Field(name, (64,)) for name in ("x", "y")}, {})
    folder = tmp_path / "network"
    before = learner.save(folder, PROGRESS)
    batch = {name: np.ones((3, 64), "float32") for name in ("x", "y")}
    expected = learner.predict(batch)["y"]
    learner.optimize(batch)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (50_000, 150_000):  # less than the parameters; more, but less than the state
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            with pytest.raises(CheckpointError, match="disk is full.*network_0.*intact"):
                learner.save(folder, PROGRESS)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert [path.name for path in folder.iterdir()] == [before.name]
    found = load_learner(folder, NetworkConfig(device="cpu")).predict(batch)
    np.testing.assert_array_equal(next(iter(found.values())), expected)
