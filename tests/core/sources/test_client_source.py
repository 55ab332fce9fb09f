"""ClientSource: the rows of LocalSource, and where clients find the class."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import Environment
from physx_core.errors import ComponentNotFoundError, UsageError

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "worker_envs.py"


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


# Rows -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("instances", "ahead", "options"),
    [
        (1, None, {}),
        (1, 0, {"refuse": 3}),
        (2, None, {"delay": 0.004}),
        (2, 0, {"size": 40}),
        (3, None, {"refuse": 4}),
        (3, 5, {"delay": 0.002}),
        (3, 0, {}),
    ],
)
def test_rows_are_those_of_a_local_source(local, clients, instances, ahead, options):
    settings = {"num_clients": instances, "env_kwargs": options, "simulations_per_step": 2}
    sizes = [1, 2, 5, 1, 16, 3] if "delay" in options else [1, 2, 5, 700, 16, 1, 3, 2000]
    with (
        local("Walk", **settings) as ours,
        clients("Walk", run_ahead=ahead, total=sum(sizes), **settings) as theirs,
    ):
        assert theirs.fields == ours.fields
        for size in sizes:
            same(theirs.batch(size), ours.batch(size))
        assert theirs.fields == ours.fields


def test_rows_do_not_depend_on_the_sizes_of_batches(clients):
    collected = []
    for sizes in ([40], [1] * 40, [7, 13, 2, 18]):
        with clients("Walk", num_clients=3) as source:
            parts = [source.batch(size)["state"].copy() for size in sizes]
        collected.append(np.concatenate(parts))
    assert np.array_equal(collected[0], collected[1])
    assert np.array_equal(collected[0], collected[2])


def test_large_rows_arrive_whole(local, clients):
    settings = {"env_kwargs": {"size": 30_000}, "num_clients": 2}
    with local("Walk", **settings) as ours, clients("Walk", **settings) as theirs:
        for size in (3, 20):
            same(theirs.batch(size), ours.batch(size))


def test_a_batch_has_at_least_one_row_and_an_open_source(clients):
    source = clients("Plain")
    with pytest.raises(UsageError, match="not open"):
        source.batch(1)
    with source, pytest.raises(UsageError, match="at least one row, not 0"):
        source.batch(0)
    source.close()
    with pytest.raises(UsageError, match="not open"):
        source.batch(1)


def test_clients_make_no_more_than_they_may(clients, services):
    def steps():
        return [step for _, step, events in services.shown if events[0].action == "update"]

    for ahead, total, most in ((0, None, 6), (2, None, 10), (100, 8, 8), (0, 2, 6)):
        services.shown.clear()
        settings = {"num_clients": 2, "visualizer": "rerun"}
        with clients("Drawing", run_ahead=ahead, total=total, **settings) as source:
            source.batch(6)
            deadline = time.monotonic() + 60
            while len(steps()) < most and time.monotonic() < deadline:
                source._group.server.pump(0.01)
            time.sleep(0.1)  # for what they must not make
        assert len(steps()) == most


# Where the class comes from ---------------------------------------------------------------------


class HereDefined(Environment):
    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=float(self.step_index))


def test_the_class_may_come_from_a_module(clients, tmp_path, monkeypatch):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "some_physx_test_module.py").write_text(ENVS.read_text())
    monkeypatch.syspath_prepend(str(folder))
    module = __import__("some_physx_test_module")
    for reference in ("some_physx_test_module:Plain", module.Plain):
        with clients(reference) as source:
            assert source.batch(2)["x"].tolist() == [[1, 0], [1, 1]]
    del sys.modules["some_physx_test_module"]


def test_the_class_may_come_from_a_plugin(clients, tmp_path, monkeypatch):
    (tmp_path / "beans_plugin.py").write_text(
        "from physx_core.plugins import hookimpl\n"
        "@hookimpl\n"
        "def physx_environments():\n"
        f"    from physx_core.plugins import resolve\n"
        f"    return {{'plain': resolve('environment', {f'{ENVS}:Plain'!r})}}\n"
    )
    info = tmp_path / "beans-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: beans\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[physx]\nbeans = beans_plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with clients("beans/plain") as source:
        assert source.batch(1)["x"].tolist() == [[1, 0]]


def test_the_class_may_come_from_the_script_that_runs(tmp_path, nothing_stays_behind):
    script = tmp_path / "script.py"
    script.write_text(
        ENVS.read_text()
        + f"""
if __name__ == "__main__":
    sys.path.insert(0, {str(ENVS.parent)!r})
    from physx_core.config import EnvironmentConfig
    from physx_core.sources.client_source import ClientSource
    with ClientSource(EnvironmentConfig(Plain, num_clients=2), None, [1]) as clients:
        print(clients.batch(3)["x"].tolist())
"""
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.stdout.strip() == "[[1.0, 0.0], [2.0, 0.0], [1.0, 1.0]]", done.stderr


def test_a_class_that_no_other_process_finds_is_rejected(clients):
    class Inside(HereDefined):
        pass

    with pytest.raises(UsageError, match="inside a function"):
        clients(Inside).open()


def test_an_unknown_class_is_named_as_in_process(clients):
    with pytest.raises(ComponentNotFoundError, match='Did you mean "Plain"'), clients("Plane"):
        pass
