"""The kit names what is wrong with launchers, and finds nothing in a right one."""

import os
import signal
from pathlib import Path

import pytest

from physx_core.testing import check_launcher

pytestmark = pytest.mark.slow

WRONG = [
    ("ShowsToken", "keeps the token off command lines", "everybody"),
    ("AlwaysWell", "kills clients", "as if it had done its work"),
    ("Silent", "tells how a client ended, and its last words", "stderr()"),
    ("WrongOrder", "starts a client for each instance", "[4, 2, 1]"),
    ("KillsAll", "kills one client alone", "ended another one"),
    ("LeavesChildren", "leaves nothing of clients that hang", "sleep"),
    ("StartsNoSecondTime", "starts a killed client again", "out of machines"),
]


@pytest.mark.parametrize(("name", "check", "text"), WRONG)
def test_what_is_wrong_is_named(name, check, text, place, expect_named, nothing_stays_behind):
    try:
        expect_named(check_launcher(place("wrong_launchers", name)), check, text)
    finally:
        end_sleepers()


def end_sleepers():
    """Kill what a wrong launcher, as it must, has left; other processes of pytest test, too."""
    mine = f"PYTEST_XDIST_WORKER={os.environ.get('PYTEST_XDIST_WORKER', '')}".rstrip("=").encode()
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            variables = environ.read_bytes().split(b"\0")
            marked = any(each.startswith(b"PHYSX_KIT_MARK=") for each in variables)
            if marked and (mine in variables or b"=" not in mine):
                os.kill(int(environ.parent.name), signal.SIGKILL)
        except OSError:
            continue


def test_nothing_is_found_in_a_right_one(place, expect_right):
    expect_right(check_launcher(place("wrong_launchers", "Right")))
