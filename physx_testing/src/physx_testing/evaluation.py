"""Checks that an evaluation of networks satisfies its contract."""

from __future__ import annotations

import contextlib
import io

from physx_core.components import Evaluation
from physx_testing.process_state import unchanged
from physx_testing.subject import Check, Subject, expect


def _says_whether(subject: Subject) -> None:
    evaluation: Evaluation = subject.make()
    for names in ([], ["a_field_that_no_network_has"]):
        found = evaluation.applies(names)
        expect(type(found) is bool, f"applies({names}) returns {found!r}, not a boolean")
        expect(not found, f"it claims networks whose fields are {names}")


def _helps(subject: Subject) -> None:
    told = io.StringIO()
    try:
        with contextlib.redirect_stdout(told), unchanged(subject.before):
            subject.make().run(["--help"])
    except SystemExit as end:
        expect(not end.code, f"--help ends with the exit status {end.code}")
    expect("physx evaluate" in told.getvalue(), "--help does not say what the command does")


CHECKS: dict[str, Check] = {
    "claims no networks of other kinds": _says_whether,
    "tells its options": _helps,
}
