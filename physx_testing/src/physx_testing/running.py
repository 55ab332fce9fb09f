"""Runs the checks of a component in another process, so crashes and hangs stay there.

A check therefore leaves this process exactly as it was, whatever the component does.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core.config import NetworkConfig, reference_of, to_plain
from physx_core.errors import UsageError, listed
from physx_core.fields import Field
from physx_core.net import encode
from physx_core.processes import WorkerProcess
from physx_testing.kinds import checks_of
from physx_testing.report import Check, Report, Status
from physx_testing.worker import LENGTH

TIMEOUT = 120.0
"""Default time limit of a check, in s."""
_CREATED = "can be imported and created"
_MOST_LINES = 4


def run_checks(
    kind: str,
    component: str | type[Any] | Any,
    arguments: Mapping[str, Any],
    *,
    options: Mapping[str, Any] | None = None,
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
) -> Report:
    """Run all checks of a kind on a component and return the report.

    Args:
        kind: Kind of the component.
        component: Its reference, class, or a function that returns it.
        arguments: Keyword arguments for its constructor.
        options: See `Subject.options`.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    expected = dict(expected_failures or {})
    left = list(checks_of(kind))
    unknown = expected.keys() - set(left)
    if unknown:
        raise UsageError(f"There are no checks {sorted(unknown)}. Available: {listed(left)}.")
    reference = reference_of(component)
    request = {
        "kind": kind,
        "reference": reference,
        "file": _file_of(component),
        "arguments": dict(arguments),
        "options": dict(options or {}),
        "path": [str(Path(entry).resolve()) for entry in sys.path],
    }
    found: list[Check] = []
    while left:
        done = list(_run_some({**request, "checks": left}, left, timeout))
        found += done
        left = left[len(done) :] if done[-1].name != _CREATED else []
    return Report(kind, reference, tuple(_as_expected(check, expected) for check in found))


def _as_expected(check: Check, expected: Mapping[str, str]) -> Check:
    if check.status == "failed" and check.name in expected:
        return Check(check.name, "expected", expected[check.name])
    return check


def plain_options(
    *, fields: Sequence[Field] = (), network: NetworkConfig | None = None
) -> dict[str, Any]:
    """Return check options as data that another process can read."""
    options: dict[str, Any] = {}
    if fields:
        given = [option.name for option in dataclasses.fields(Field) if option.init]
        options["fields"] = [{name: getattr(field, name) for name in given} for field in fields]
    if network is not None:
        options["network"] = to_plain(network)
    return options


def _file_of(component: Any) -> str:
    """Return the file of a class whose module may be importable only in this process."""
    if isinstance(component, str):
        return ""
    file = getattr(sys.modules.get(component.__module__), "__file__", None)
    return str(Path(file).resolve()) if file else ""


def _run_some(request: Mapping[str, Any], names: Sequence[str], timeout: float) -> Iterator[Check]:
    """Yield the results of the checks, up to the one that ended the process, if any."""
    with WorkerProcess("physx_testing.worker", variables={}, stdout=subprocess.DEVNULL) as process:
        link = process.link
        payload = encode(dict(request), f"what the check of {request['reference']} needs")
        lines = _Lines(link)
        with contextlib.suppress(ConnectionError):
            link.sendall(LENGTH.pack(len(payload)) + payload)
        begun, count = _CREATED, 0
        while count < len(names):
            try:
                answer = lines.next(timeout)
            except TimeoutError:
                yield Check(begun, "failed", f"it had not ended after {timeout:g} s")
                return
            if answer is None:
                yield Check(begun, "failed", _how_it_ended(process))
                return
            if "begin" in answer:
                begun = answer["begin"]
                continue
            if "status" not in answer:
                yield _unusable(answer)
                return
            status: Status = answer["status"]
            count += 1
            yield Check(begun, status, answer["reason"])
            begun = _CREATED


def _unusable(answer: Mapping[str, str]) -> Check:
    if "missing" in answer:
        return Check(_CREATED, "skipped", answer["missing"])
    return Check(_CREATED, "failed", answer["unusable"])


def _how_it_ended(process: WorkerProcess) -> str:
    how = process.describe_end()
    lines = [line for line in process.stderr(0.5).splitlines() if line.strip()]
    return "\n".join([f"the process {how}", *lines[-_MOST_LINES:]])


class _Lines:
    """Reads JSON documents, one per line, from a socket."""

    def __init__(self, link: socket.socket) -> None:
        self._link, self._bytes = link, b""

    def next(self, timeout: float) -> dict[str, Any] | None:
        """Return the next document; None if the other side is gone.

        Raises:
            TimeoutError: If none arrived in time.
        """
        until = time.monotonic() + timeout
        while b"\n" not in self._bytes:
            self._link.settimeout(max(until - time.monotonic(), 1e-3))
            try:
                chunk = self._link.recv(1 << 16)
            except ConnectionError:
                return None
            if not chunk:
                return None
            self._bytes += chunk
        line, _, self._bytes = self._bytes.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer
