"""The benchmarks run: what they measure, and whether it is enough, is not asked here."""

from pathlib import Path

import pytest

pytestmark = [pytest.mark.faults, pytest.mark.processes]

PROGRAM = Path(__file__).with_name("programs") / "one_round.py"
QUICK = (
    "backends", "calls", "checkpoint", "differentiable", "faults", "generation", "idle_threads",
    "prediction", "remote", "training",
)  # fmt: skip
"""Those that take seconds with a single round."""


@pytest.mark.parametrize("name", QUICK)
def test_a_benchmark_runs(name, run):
    assert "target" in run(PROGRAM, name).stdout
