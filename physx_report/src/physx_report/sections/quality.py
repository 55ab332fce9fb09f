"""The section on how good a network is, and compared with what."""

from __future__ import annotations

import math
from collections.abc import Iterator

from physx_core.results import FieldResult, PartResult
from physx_report import wording
from physx_report.blocks import Block, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_WORDS = {
    "wins": "better",
    "loses": "worse",
    "even": "no clear difference",
    "unknown": "unknown",
}


def _blocks(run: Run) -> Iterator[Block]:
    result, evaluated = run.training, run.results.get("evaluation")
    if result is not None and result.why:
        yield Text([f"How good the network is, is not known: {result.why}."], "verdict")
    parts = {**(result.parts if result else {}), **(evaluated.parts if evaluated else {})}
    for name, part in parts.items():
        yield Text([_verdict(label, of) for label, of in part.fields.items()], "verdict")
        yield Text(list(_about(name, part)))
        for label, of in part.fields.items():
            yield _table(label, of)
            yield from _components(label, of)
            yield from _confusion(label, of)
        if part.metrics:
            rows = [[label, wording.number(value)] for label, value in part.metrics.items()]
            caption = f"Your own errors, means over {part.episodes:,} episodes ({name})"
            yield Table(["metric", "mean"], rows, caption)


def _verdict(label: str, of: FieldResult) -> str:
    """Return the most important number of a field, beside its best rival."""
    key = "relative_l2" if "relative_l2" in of.errors else next(iter(of.errors), "")
    if not key:
        return f"{label}: no error could be measured."
    told = f"{label}: {wording.named(key)} {wording.measured(key, of.errors[key], of.unit)}"
    run = {name: rival for name, rival in of.rivals.items() if rival.errors}
    if not run:
        return f"{told}; nothing to compare it with."
    main = "rmse" if of.kind == "real" else "accuracy"
    best = (min if of.kind == "real" else max)(run, key=lambda name: run[name].errors[main])
    rival = run[best]
    if rival.verdict == "unknown":
        return f"{told}; against the best rival ({best}): {rival.why or 'not known'}."
    ratio = "" if math.isnan(rival.ratio) else f", {wording.number(rival.ratio)} times its error"
    return f"{told}; against the best rival ({best}): {_WORDS[rival.verdict]}{ratio}."


def _about(name: str, part: PartResult) -> Iterator[str]:
    used = f"They decided {part.used}." if part.used else "They decided nothing about the network."
    yield f"On {part.samples:,} samples of {part.division} ({name}). {used}"
    yield from (f"{label} is not judged: {why}." for label, why in part.missing.items())
    if part.why:
        yield f"{part.why[:1].upper()}{part.why[1:]}."


def _table(label: str, of: FieldResult) -> Table:
    names = list(of.errors)

    def cells(errors: object) -> list[str]:
        known = errors if isinstance(errors, dict) else {}
        return [wording.measured(n, known[n], of.unit) if n in known else "" for n in names]

    rows = [["network", *cells(dict(of.errors)), ""]]
    for name, rival in of.rivals.items():
        told = _WORDS[rival.verdict] if rival.verdict != "unknown" else rival.why
        if rival.interval is not None:
            low, high = map(wording.number, rival.interval)
            told = f"{told}: {wording.number(rival.ratio)} times its error ({low} to {high})"
        rows.append([name, *cells(dict(rival.errors)), told])
    head = ["", *map(wording.named, names), "the network is"]
    return Table(head, rows, label, marks=[0])


def _components(label: str, of: FieldResult) -> Iterator[Table]:
    if of.by_component:
        rows = [
            [str(place), wording.measured("rmse", value, unit)]
            for place, (value, unit) in enumerate(of.by_component)
        ]
        yield Table(["component", wording.named("rmse")], rows, f"{label}, by component")


def _confusion(label: str, of: FieldResult) -> Iterator[Table]:
    if of.confusion:
        head = ["true class", *(f"as {each}" for each in of.classes)]
        rows = [
            [str(name), *(f"{count:,}" for count in row)]
            for name, row in zip(of.classes, of.confusion, strict=True)
        ]
        yield Table(head, rows, f"{label}, number of values by predicted class")


SECTION = Section("How good it is", _blocks, 10)
