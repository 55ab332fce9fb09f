"""The kit names what is wrong with a visualizer, and built-in ones pass it."""

import threading
import time

import numpy as np
import pytest
from physx_matplotlib import MatplotlibVisualizer

from physx_core import Visualizer
from physx_core.components import KINDS
from physx_core.errors import UsageError
from physx_testing import check_visualizer
from physx_testing.scene import OBJECTS

pytestmark = pytest.mark.processes


class Silent(Visualizer):
    pass


class NoCylinders(Visualizer):
    def events(self, instance_id, step, events):
        if any(event.kind == "cylinder" for event in events):
            raise NotImplementedError("no cylinders")


class OneByOne(Visualizer):
    def events(self, instance_id, step, events):
        assert all(len(event.names) == 1 for event in events)


class OneInstance(Visualizer):
    def events(self, instance_id, step, events):
        assert instance_id == 1


class FailsWhenClosed(Visualizer):
    def open(self, run_name, session_dir, instance_nb):
        self.scene = {}

    def events(self, instance_id, step, events):
        self.scene[instance_id] = events


class Overwrites(Visualizer):
    def open(self, run_name, session_dir, instance_nb):
        self.path = session_dir / "run.txt"

    def close(self):
        self.path.write_text("scene")

    def outputs(self):
        return [f"text: {self.path}"]


class NamesNoFile(Visualizer):
    def outputs(self):
        return ["text: nowhere.txt"]


class Moves(Visualizer):
    def events(self, instance_id, step, events):
        for event in events:
            if "positions" in event.values and isinstance(event.values["positions"], np.ndarray):
                event.values["positions"] += 1.0


class OnlyFinite(Visualizer):
    def scalars(self, values, step, timeline):
        assert np.isfinite(list(values.values())).all()


class StillPicture(Visualizer):
    def capture(self):
        return np.zeros((4, 4, 3), np.uint8)


class FloatPicture(Visualizer):
    def capture(self):
        return np.random.default_rng().random((4, 4, 3))


class LeavesThread(Visualizer):
    def open(self, run_name, session_dir, instance_nb):
        threading.Thread(target=time.sleep, args=(20,), daemon=True, name="left").start()


WRONG = {
    NoCylinders: "draws cylinder",
    OneByOne: "draws many objects at once",
    OneInstance: "draws several instances",
    FailsWhenClosed: "ignores what comes before open and after close",
    Overwrites: "opens again, and keeps what it left before",
    NamesNoFile: "names the files that it leaves",
    Moves: "does not change what it draws",
    OnlyFinite: "takes numbers that are not finite",
    StillPicture: "shows motion in its pictures",
    FloatPicture: "shows motion in its pictures",
    LeavesThread: "leaves no thread behind",
}


@pytest.mark.parametrize(("make", "name"), WRONG.items(), ids=lambda each: str(each)[-30:])
def test_what_is_wrong_is_named(make, name):
    report = check_visualizer(make)
    assert not report.ok
    assert name in [check.name for check in report.checks if check.status == "failed"]
    assert name in str(report)


def test_a_visualizer_that_draws_nothing_is_right_but_has_no_files_and_pictures():
    report = check_visualizer(Silent)
    assert report.ok and report.counts()["skipped"] == 2


@pytest.mark.faults
def test_a_visualizer_in_matplotlib_passes():
    report = check_visualizer(MatplotlibVisualizer, size=(64, 48))
    assert report.ok and report.counts()["passed"] == len(report.checks), str(report)


def test_all_kinds_are_drawn():
    assert OBJECTS.keys() == KINDS.keys()


def test_an_expected_failure_of_no_check_is_an_error():
    with pytest.raises(UsageError, match="no checks"):
        check_visualizer(Silent, expected_failures={"flies": "it cannot"})
