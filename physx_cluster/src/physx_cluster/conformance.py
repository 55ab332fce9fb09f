"""Checks that an executor of a sweep's trials satisfies its contract."""

from __future__ import annotations

import time

from physx_cluster.sweep.executors.executor import Executor, Job
from physx_testing.subject import Check, Subject, expect

_LIMIT = 60.0


def _started(subject: Subject, executor: Executor) -> Job:
    """Return the job of a trial without a definition, which fails."""
    folder = subject.folder / "trial"
    folder.mkdir()
    return executor.start(folder.resolve())


def _says_how_it_ended(subject: Subject) -> None:
    with subject.make() as executor:
        expect(executor.interval > 0, "its interval is not positive")
        job = _started(subject, executor)
        until = time.monotonic() + _LIMIT
        while not job.has_ended():
            expect(time.monotonic() < until, f"a trial without a study runs for {_LIMIT:g} s")
            time.sleep(executor.interval)
        expect(bool(job.describe_end()), "it does not say how a trial ended")
        job.close()


def _ends_what_it_runs(subject: Subject) -> None:
    with subject.make() as executor:
        job = _started(subject, executor)
    expect(job.has_ended(), "a trial still runs after close()")


CHECKS: dict[str, Check] = {
    "says when and how a trial ended": _says_how_it_ended,
    "ends its trials when it is closed": _ends_what_it_runs,
}
