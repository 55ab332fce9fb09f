"""The kit names what is wrong with launchers, and finds nothing in a right one."""

import os
import signal
from pathlib import Path

import pytest

from physx_testing import check_launcher

pytestmark = [pytest.mark.slow, pytest.mark.processes]

# Of one launcher each, with mistakes that do not hide one another: a run of the kit starts many
# clients.
WRONG = {
    "Careless": {
        "keeps the token off command lines": "everybody",
        "reports how a client ended, and its last output": "stderr()",
        "starts a client for each instance": "[4, 2, 1]",
        "starts a killed client again": "out of machines",
    },
    "Ruthless": {
        "kills clients": "as if it had done its work",
        "kills one client alone": "ended another one",
    },
    "LeavesChildren": {"cleans up after clients that hang": "sleep"},
}


@pytest.mark.parametrize(
    "name",
    ["Careless", *(pytest.param(name, marks=pytest.mark.faults) for name in list(WRONG)[1:])],
)
def test_what_is_wrong_is_named(name, place, expect_named, nothing_stays_behind):
    try:
        report = check_launcher(place("wrong_launchers", name))
        for check, text in WRONG[name].items():
            expect_named(report, check, text)
    finally:
        end_sleepers()


def end_sleepers():
    """Kill what a wrong launcher, as it must, has left; other processes of pytest test, too."""
    mine = f"PYTEST_XDIST_WORKER={os.environ.get('PYTEST_XDIST_WORKER', '')}".rstrip("=").encode()
    for environ in (folder / "environ" for folder in Path("/proc").glob("[0-9]*")):
        try:
            variables = environ.read_bytes().split(b"\0")
            marked = any(each.startswith(b"PHYSX_KIT_MARK=") for each in variables)
            if marked and (mine in variables or b"=" not in mine):
                os.kill(int(environ.parent.name), signal.SIGKILL)
        except OSError:
            continue


@pytest.mark.faults
def test_nothing_is_found_in_a_right_one(place, expect_right):
    expect_right(check_launcher(place("wrong_launchers", "Right")))
