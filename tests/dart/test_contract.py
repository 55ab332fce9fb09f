"""The kit names what is wrong with an engine; DART and Pinocchio: tests/integration."""

from pathlib import Path

import pytest

from physx_core.testing import check_backend

pytestmark = pytest.mark.slow

ENGINES = Path(__file__).parent / "programs" / "wrong_engines.py"
WRONG = [
    ("Heavy", "falls as semi-implicit Euler steps do", "semi-implicit"),
    ("Smooth", "holds and slides by its friction", "slope"),
    ("Elastic", "bounces by its restitution", "restitution of 0.6"),
    ("ForgetsCommands", "restores snapshots", "commands differ"),
    ("KeepsImpulses", "depends on nothing but the state that is set", "impulses"),
    ("ClaimsRays", "can do what its features say", '"raycast"'),
    ("Invents", "claims features that exist", "antigravity"),
    ("TakesAnything", "refuses states and torques that make no sense", "torques with NaN"),
    ("LivesOn", "ends once and for all", "after close()"),
    ("Imprecise", "has forward and inverse dynamics that agree", "inverse_dynamics()"),
    ("Aliases", "gives copies of its state", "written to"),
    ("Crowded", "does not disturb another simulation", "alone"),
    ("Crashes", "has a mass matrix that agrees with the dynamics", "SIGSEGV"),
]


@pytest.mark.parametrize(("name", "check", "text"), WRONG)
def test_what_is_wrong_is_named(name, check, text):
    report = check_backend(f"{ENGINES}:{name}")
    failed = {one.name: one.reason for one in report.checks if one.status == "failed"}
    assert not report.ok and check in failed, str(report)
    assert text in failed[check]
