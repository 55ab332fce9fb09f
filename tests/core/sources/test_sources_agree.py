"""Whatever an environment does is the same in process and over TCP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from physx_core.errors import EnvironmentFailedError

ENVS = Path(__file__).parents[1] / "programs" / "source_envs.py"


def same(a, b):
    """Check that two values have the same types and bits, arrays and events in them too."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert list(a) == list(b)
        for name in a:
            same(a[name], b[name])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            same(one, other)
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif hasattr(a, "values") and hasattr(a, "action"):
        same((a.action, a.kind, a.name, dict(a.values)), (b.action, b.kind, b.name, dict(b.values)))
    else:
        assert a == b


def observed(make, services, *, apply, stored, **settings):
    """Return all that is seen of a run from outside of its environments."""
    services.kept, services.shown = {}, []
    services.save_parameters = lambda number, values: services.kept.setdefault(number, {}).update(
        values
    )
    rows, rejected = [], []
    with make(f"{ENVS}:Everything", **settings) as source:
        for size in (2, 5, 12, 1):
            given = {"state": np.ones((size, 3))} if stored else None
            rows.append({name: array.copy() for name, array in source.batch(size, given).items()})
            rejected.append(source.pop_rejected())
            if apply:
                source.apply({"y": rows[-1]["state"] + 1})
        fields = source.fields
    shown = [[one for one in services.shown if one[0] == number] for number in (1, 2, 3)]
    kept = dict(sorted(services.kept.items()))
    return rows, rejected, [f.to_dict() for f in fields], kept, shown


@pytest.mark.parametrize(
    ("settings", "apply", "stored"),
    [
        ({"simulations_per_step": 3}, False, False),
        ({"visualizer": "rerun", "num_clients": 3}, False, False),
        ({"num_clients": 2, "simulations_per_step": 2}, True, False),
        ({"num_clients": 3, "visualizer": "rerun", "record_wrong_samples": True}, True, True),
    ],
)
def test_all_that_an_environment_does_is_the_same_in_clients(
    local, simulated, services, settings, apply, stored
):
    given = {**settings, "apply": apply, "stored": stored}
    ours = observed(local, services, **given)
    theirs = observed(lambda *a, **k: simulated(*a, run_ahead=0, **k), services, **given)
    for mine, other in zip(ours, theirs, strict=True):
        same(mine, other)
    rows, rejected, _, kept, shown = ours
    assert all(kept[number]["closed"] for number in kept)
    assert bool(rejected[2]) == bool(settings.get("record_wrong_samples"))
    assert bool(shown[0]) == ("visualizer" in settings)
    assert (kept[1]["sub_steps"] > 0) == ("simulations_per_step" in settings)
    assert any(row["last"].any() for row in rows) == apply


@pytest.mark.parametrize("sub_steps", [1, 2])
def test_what_an_environment_leaves_drawn_is_shown(local, simulated, services, sub_steps):
    for make in (local, lambda *a, **k: simulated(*a, run_ahead=0, **k)):
        services.shown = []
        settings = {"visualizer": "rerun", "simulations_per_step": sub_steps}
        with make(f"{ENVS}:LeavesDrawn", **settings) as source:
            for _ in range(5):
                source.batch(1)
                source.apply({"y": np.zeros((1, 1))})
        drawn = [
            (step, [(event.action, event.kind) for event in events])
            for _, step, events in services.shown
        ]
        ball, text = ("update", "sphere"), ("update", "text")
        own = [(1, [ball])] * sub_steps  # those that it sends itself come from sub-steps, too
        assert drawn == [
            (0, [("add", "sphere"), ("add", "text")]),
            (0, [ball]),
            (1, [text]),  # drawn by a prediction, that is between two steps
            *own,
            (2, [text]),
            (2, [ball]),  # of a sample that is rejected; there is nothing in step 3
            (4, [text]),
            *[(4, [ball])] * sub_steps,
            (4, [text]),  # drawn by check_sample
            (5, [text]),
            (5, [ball]),
            (6, [text]),
        ]


@pytest.mark.parametrize("method", ["create", "step"])
def test_the_error_that_is_told_is_the_first_one(local, simulated, method):
    for make in (local, simulated):
        with (
            pytest.raises(EnvironmentFailedError, match=rf"in {method}\(\).*first mistake"),
            make(f"{ENVS}:Broken", env_kwargs={"method": method}, num_clients=2) as source,
        ):
            source.batch(2)
