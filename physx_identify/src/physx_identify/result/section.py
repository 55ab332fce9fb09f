"""The section of a report on parameters identified from a log."""

from __future__ import annotations

from collections.abc import Iterator

from physx_identify.result import wording
from physx_identify.result.identification import Identification
from physx_identify.result.stored import FILE, read_identification
from physx_report import Run, Section, Table, Text


def _blocks(run: Run) -> Iterator[Text | Table]:
    path = run.path / FILE
    if not path.is_file():
        return
    found = read_identification(path)
    yield Text(found.verdict, "verdict")
    yield Text([
        wording.origin_text(found.robot, found.source, found.samples, found.period),
        wording.noise_text(found.noise),
    ])  # fmt: skip
    head = (*wording.HEAD[:-1], "by blocks", "")
    rows = [
        [*cells[:-1], "" if each.blocks is None else f"x {each.blocks:.2f}", cells[-1]]
        for each, cells in ((each, wording.row_of(each)) for each in found.estimates)
    ]
    yield Table(head, rows, f"{100 * found.level:g} % intervals, and the errors that blocks show")
    if found.combinations:
        texts = [wording.combination_text(each) for each in found.combinations]
        yield Text([f"{wording.TOGETHER}:", *texts])
    if found.engines:
        engines = wording.engine_rows(found.engines)
        yield Table(engines[0], engines[1:], wording.ELSEWHERE)
        yield Text(wording.engine_lines(found.engines), "verdict")
    rows = [
        [each.joint or "all", each.lacks, f"{each.probability:.3g}", "yes" if each.failed else ""]
        for each in found.tests
    ]
    threshold = found.tests[0].threshold if found.tests else 0.0
    yield Table(
        ("joint", "does the model lack", "probability", "found"),
        rows,
        f"Tests of what is left; found below {threshold:.2g}, together in at most 1 of 20 logs "
        "without model error",
    )
    names = [each.name for each in found.estimates if each.error is not None]
    yield Table(("", *names), _correlations(found), "Correlations of the errors")


def _correlations(found: Identification) -> list[list[str]]:
    places = [n for n, each in enumerate(found.estimates) if each.error is not None]
    rows = []
    for one in places:
        cells = [found.estimates[one].name]
        for other in places:
            scale = (found.covariance[one][one] * found.covariance[other][other]) ** 0.5
            cells.append(f"{found.covariance[one][other] / scale:.2f}" if scale else "")
        rows.append(cells)
    return rows


SECTION = Section("What the log says about the robot", _blocks, 24)
