"""Values of all types, those that fit their fields and those that do not, and who gives them."""

from __future__ import annotations

import numpy as np

from physx_core import Environment, Field

INTEGERS = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]
DTYPES = ["bool", *INTEGERS, "float16", "float32", "float64", "complex64", "complex128"]
LIMITS = {name: np.iinfo(name) for name in INTEGERS}

EACH = {"bool": True, "complex64": 1 + 2j, "complex128": -3j, "float16": 7, "float32": 2**24 + 1}
ACCEPTED = [
    {name: EACH.get(name, 0) for name in DTYPES},
    dict.fromkeys(DTYPES, True),
    {name: np.array(LIMITS[name].max if name in LIMITS else 1, name) for name in DTYPES},
    {name: np.array(LIMITS[name].min if name in LIMITS else 0, name) for name in DTYPES},
    {name: np.array(7, ">i2") if name != "bool" else np.array(False) for name in DTYPES},
]
WRONG = {
    "int32": 3_000_000_000,
    "uint8": -1,
    "int64": np.array(2**63, "uint64"),
    "float32": 1e300,
    "float64": 1j,
    "bool": 1,
}


class Values(Environment):
    """Gives the accepted values; before them all wrong ones, rejected, or behind them one."""

    def __init__(self, *, rejects=False, wrong="", **kwargs):
        super().__init__(**kwargs)
        spoiled = [{**ACCEPTED[0], name: value} for name, value in WRONG.items()]
        self.rejected = len(spoiled) if rejects else 0
        self.samples = [*spoiled[: self.rejected], *ACCEPTED]
        if wrong:
            self.samples.append({**ACCEPTED[0], wrong: WRONG[wrong]})

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field(name, (), name) for name in DTYPES])

    def step(self):
        self.set_training_data(**self.samples[self.step_index])

    def check_sample(self):
        return self.step_index >= self.rejected
