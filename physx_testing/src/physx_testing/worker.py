"""Runs checks in a separate process: ``python -m physx_testing.worker DESCRIPTOR``."""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import socket
import struct
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from physx_core.errors import ComponentNotFoundError, MissingLibraryError
from physx_core.net import decode
from physx_core.plugins import resolve
from physx_core.processes import TemporaryFolder, prepare_worker
from physx_testing.kinds import checks_of
from physx_testing.process_state import process_state
from physx_testing.report import NotApplicableError
from physx_testing.subject import Check, Subject

LENGTH = struct.Struct("<Q")
_GIVEN = ("instance_id", "instance_nb", "seed")


def main() -> None:
    """Answer the single request that arrives through a socket, line by line."""
    link = socket.socket(fileno=int(sys.argv[1]))
    prepare_worker()
    with link, link.makefile("rb") as incoming:
        (length,) = LENGTH.unpack(incoming.read(LENGTH.size))
        request = decode(incoming.read(length))
        sys.path[:] = request["path"]
        for answer in _answers(request):
            link.sendall(json.dumps(answer).encode() + b"\n")
    # Nothing that the component left running may keep this process from exiting.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _answers(request: Mapping[str, Any]) -> Iterator[dict[str, str]]:
    """Yield the name of each check before it runs, then its result."""
    tempfile.gettempdir()  # sets tempfile.tempdir if it is not set yet
    subject = Subject(
        request["kind"],
        request["reference"],
        request["arguments"],
        request["options"],
        before=process_state(),
    )
    try:
        subject = _found(subject, request["file"])
    except Exception as error:
        yield {"unusable": f"{type(error).__name__}: {error}"}
        return
    if reason := _what_is_missing(subject):
        yield {"missing": reason}
        return
    known = checks_of(subject.kind)
    with TemporaryFolder("check-") as folder:
        for number, name in enumerate(request["checks"]):
            yield {"begin": name}
            own = Path(folder.path, str(number))
            own.mkdir()
            status, reason = _run(known[name], dataclasses.replace(subject, folder=own))
            yield {"status": status, "reason": reason}


def _found(subject: Subject, file: str) -> Subject:
    """Return the subject with a reference that this process can resolve."""
    try:
        resolve(subject.kind, subject.reference)
    except ComponentNotFoundError:
        name = subject.reference.rpartition(":")[2]
        if not file:
            raise
        subject = dataclasses.replace(subject, reference=f"{file}:{name}")
        resolve(subject.kind, subject.reference)
    return subject


def _what_is_missing(subject: Subject) -> str:
    """Return which options and libraries the component lacks; empty if it has all of them."""
    made = resolve(subject.kind, subject.reference)
    try:
        parameters = inspect.signature(made).parameters.values() if callable(made) else ()
    except (TypeError, ValueError):  # unknown, for example for a class in C
        parameters = ()
    needed = [
        parameter.name
        for parameter in parameters
        if parameter.default is parameter.empty
        and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        and parameter.name not in (*subject.arguments, *_GIVEN)
    ]
    if needed:
        return f"it needs options: {', '.join(needed)}"
    try:
        if subject.kind not in ("visualizer", "launcher", "backend"):  # which may open something
            subject.make()
    except MissingLibraryError as error:
        return str(error)
    except Exception:  # the checks report what is wrong
        return ""
    return ""


def _run(check: Check, subject: Subject) -> tuple[str, str]:
    """Return the status of a check and the reason if it did not pass."""
    try:
        check(subject)
    except Exception as error:  # anything a component raises belongs in the report
        reason = _not_applicable(error)
        if reason is not None:
            return "skipped", reason
        kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
        notes = "; ".join(getattr(error, "__notes__", []))
        return "failed", f"{kind}{error}{f' ({notes})' if notes else ''}"
    except SystemExit as error:
        return "failed", f"it ended the process: SystemExit: {error}"
    return "passed", ""


def _not_applicable(error: BaseException) -> str | None:
    """Return why a check does not apply, if that is what caused an error."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, NotApplicableError | MissingLibraryError):
            return str(seen)
        seen = seen.__cause__ or seen.__context__
    return None


if __name__ == "__main__":
    main()
