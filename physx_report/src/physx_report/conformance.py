"""Checks that a section of reports satisfies its contract."""

from __future__ import annotations

from pathlib import Path

from physx_core import DataGeneration, EnvironmentConfig
from physx_report.page import page_of
from physx_report.run import Run
from physx_report.section import Section
from physx_testing.process_state import unchanged
from physx_testing.subject import Check, Subject, expect


def _session(folder: Path) -> Path:
    """Return a session with twelve rows of a spring."""
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
    run = DataGeneration(
        spring, session_dir=str(folder), session_name="run", batch_nb=1, batch_size=12
    )
    run.quiet = True
    run.execute()
    return run.session.path


def _has_a_title(subject: Subject) -> None:
    section: Section = subject.make()
    expect(bool(section.title.strip()), "it has no title")
    expect(type(section.rank) is int, f"its rank is {section.rank!r}, not a whole number")


def _is_drawn(subject: Subject) -> None:
    path = _session(subject.folder)
    pages = []
    for _ in range(2):
        with Run(path) as run:
            pages.append(page_of(run, [subject.make()]))
    expect(pages[1] == pages[0], "the page of the same session has other bytes when made again")


def _changes_nothing(subject: Subject) -> None:
    path = _session(subject.folder)
    before = {each: each.read_bytes() for each in path.rglob("*") if each.is_file()}
    with unchanged(), Run(path) as run:  # which closes what it opens
        list(subject.make().blocks(run))
    now = {each: each.read_bytes() for each in path.rglob("*") if each.is_file()}
    expect(now == before, "it changes files of the session")


CHECKS: dict[str, Check] = {
    "has a title and a rank": _has_a_title,
    "is drawn on the page of a generation, with equal bytes twice": _is_drawn,
    "changes nothing in the session": _changes_nothing,
}
