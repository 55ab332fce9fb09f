"""What several files share: engines that environments are tested on, and a log."""

import numpy as np
import pytest

from physx_gym import Log


@pytest.fixture(params=["dart", "pinocchio"])
def backend(request):
    return request.param


@pytest.fixture
def log():
    """A log of two types of numbers, some of which are no ordinary ones."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((50, 3))
    values[3] = np.nan, np.inf, -np.inf
    variables = {"time": np.arange(50) * 0.01}
    variables |= {f"v.{number}": values[:, number] for number in range(3)}
    variables["n"] = rng.integers(-(2**63), 2**63 - 1, 50)
    return Log(
        {"seed": 3, "options": {"a": [1, None]}, "units": {"time": "s", "v.1": "m/s²"}}, variables
    )
