"""The kit names what is wrong with an engine; DART and Pinocchio: tests/integration."""

from pathlib import Path

import pytest

from physx_sim.conformance import check_backend

pytestmark = [pytest.mark.slow, pytest.mark.processes]

ENGINES = Path(__file__).parent / "programs" / "wrong_engines.py"
# Of one engine each, with mistakes that do not hide one another: a run of the kit takes seconds.
WRONG = {
    "Crashes": {"has a mass matrix that agrees with the dynamics": "SIGSEGV"},
    "InAnotherWorld": {
        "falls as semi-implicit Euler steps do": "semi-implicit",
        "holds and slides by its friction": "slope",
        "bounces by its restitution": "restitution of 0.6",
    },
    "Careless": {
        "restores snapshots": "commands differ",
        "can do what its features say": '"raycast"',
        "refuses states and torques that make no sense": "torques with NaN",
        "has forward and inverse dynamics that agree": "inverse_dynamics()",
    },
    "KeepsImpulses": {
        "depends on nothing but the state that is set": "impulses",
        "continues from states and snapshots, in the middle of contacts too": "after 150 steps",
    },
    "Invents": {"claims features that exist": "antigravity"},
    "LivesOn": {"ends once and for all": "after close()"},
    "Aliases": {"gives copies of its state": "written to"},
    "Crowded": {"does not disturb another simulation": "alone"},
}


@pytest.mark.parametrize(
    "name", ["Crashes", *(pytest.param(name, marks=pytest.mark.faults) for name in list(WRONG)[1:])]
)
def test_what_is_wrong_is_named(name):
    report = check_backend(f"{ENGINES}:{name}")
    failed = {one.name: one.reason for one in report.checks if one.status == "failed"}
    assert not report.ok
    for check, text in WRONG[name].items():
        assert check in failed, str(report)
        assert text in failed[check]
