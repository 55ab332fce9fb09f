"""What clients warn of is repeated by the run."""

from __future__ import annotations

import re

import pytest

from physx_core import DataGeneration, EnvironmentConfig

pytestmark = pytest.mark.processes

SCRIPT = """
import warnings
import numpy as np
from physx_core import Environment, Field

class Overflows(Environment):
    def create(self):
        self.x = np.ones(2)

    def init_database(self):
        self.define_training_fields([Field("before", (2,)), Field("after", (2,))])

    def apply_predictions(self, prediction):
        pass

    def step(self):
        np.float32(1e38) * np.float32(1e10)
        warnings.warn("two\\nlines")
        self.set_training_data(before=self.x, after=self.x)
"""


def test_what_clients_warn_of_is_repeated_once(tmp_path, monkeypatch, nothing_stays_behind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text(SCRIPT)
    config = EnvironmentConfig("script.py:Overflows", num_clients=2)
    with pytest.warns(UserWarning) as caught:
        DataGeneration(config, batch_nb=2, batch_size=4).execute()
    told = sorted(
        re.sub(r"(?<=Client) [12]|(?<=:)\d+(?=\))", "", str(each.message))
        for each in caught
        if issubclass(each.category, UserWarning)
    )
    assert told[0].startswith("Client warned: RuntimeWarning: overflow encountered in")
    assert told[0].endswith("(script.py:)")
    assert told[1].startswith('Client warned: The fields "before" and "after" are the same array')
    assert told[1].endswith("array.copy().")
    assert told[2].endswith("Overflows.apply_predictions(). Did you mean apply_prediction()?")
    assert told[3:] == ["Client warned: two lines (script.py:)"]
