"""Shipped environments go on from their states in another process, on each engine."""

import numpy as np
import pytest

from physx_testing.instances import in_another_process, one_instance, rows_between
from physx_testing.subject import Subject

pytestmark = [pytest.mark.slow, pytest.mark.processes]

for library in ("dartpy", "pinocchio", "gymnasium", "scipy"):
    pytest.importorskip(library)

ROBOTS = ("Cartpole", "Acrobot", "Ant", "Quadruped", "ArmReach", "ArmReachGoal", "PushBox")
CASES = [
    *(("toy/spring", {}), ("toy/spring", {"mass": 2.0})),
    *((f"{engine}/{name}", {}) for engine in ("dart", "pinocchio")
      for name in ("arm", "double-pendulum")),
    *((f"{engine}/arm", {"task": "track", "feedforward": "none"})
      for engine in ("dart", "pinocchio")),
    *((f"gym/physx/{name}-v0", {"backend": engine}) for name in ROBOTS
      for engine in ("dart", "pinocchio")),
    *((f"gym/{name}", {}) for name in
      ("CartPole-v1", "Pendulum-v1", "MountainCar-v0", "Acrobot-v1", "Blackjack-v1")),
    *((f"environments/{file}.py:{name}", {}) for file, name in
      (("cloud", "Cloud"), ("heat", "Heat"), ("plate", "Plate"), ("vortices", "Vortices"),
       ("beam", "Beam"))),
]  # fmt: skip


@pytest.mark.parametrize(("reference", "arguments"), CASES)
def test_shipped_environments_go_on(reference, arguments, root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "examples"))
    if reference.startswith("environments/"):
        reference = f"{root}/examples/{reference}"
    if "beam" in reference:
        pytest.importorskip("felupe")
    subject = Subject("environment", reference, arguments)
    states = {}
    with one_instance(subject) as instance:
        instance.track_states()
        rows = rows_between(instance, 0, states)
    found = in_another_process(subject, states)
    assert list(found) == [1, 6]
    for made, others in found.items():
        assert len(others) == len(rows) - made
        for wanted, other in zip(rows[made:], others, strict=True):
            for name in wanted.keys() - {"seconds"}:
                np.testing.assert_array_equal(other[name], wanted[name], err_msg=name)
