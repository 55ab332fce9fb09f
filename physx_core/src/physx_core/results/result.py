"""Result: what a run found; a plain value that is printed, stored, and shown in notebooks."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from physx_core.plugins.commands import find_command
from physx_core.results.policy import PolicyResult
from physx_core.results.sweep import SweepResult
from physx_core.results.wording import WORDS, Interval, Verdict, between, number, percent, plain

_SHOWN_PARAMETERS = 4
_WIDEST = 10
"""Largest number of classes whose confusion is shown."""


@dataclass(frozen=True)
class EpisodeError:
    """How far off the network is in one episode.

    Attributes:
        error: Root mean square error in the field's unit, or the share of wrong values of a class.
        about: What is known of the episode: ``number``, ``first_row``, ``rows``, and of an
            independent one ``campaign`` and ``parameters``.
    """

    error: float
    about: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The episode in words."""
        known = self.about
        given = list(known.get("parameters", {}).items())
        shown = [f"{name} {plain(value)}" for name, value in given[:_SHOWN_PARAMETERS]]
        more = ["..."] if len(given) > len(shown) else []
        words = [f"{known.get('number', '?')}", f"({', '.join(shown + more)})" if shown else ""]
        return " ".join(word for word in words if word)


@dataclass(frozen=True)
class RivalResult:
    """A prediction that needs no network, compared with the network on the same samples.

    Attributes:
        errors: Its errors, as in `FieldResult.errors`; empty if it was not computed.
        verdict: "wins" or "loses", of the network, if the errors differ by 1 % at least and neither
            episodes drawn at random (a paired bootstrap) nor random signs of their differences
            leave more than 1 % to chance; else "even"; "unknown" if nothing can be said.
        ratio: The network's error divided by the rival's; NaN if the rival makes none.
        interval: 99 % interval of that ratio over episodes; None if there are too few.
        why: Why it was not computed, or nothing can be said; else empty.
    """

    errors: Mapping[str, float] = field(default_factory=dict)
    verdict: Verdict = "unknown"
    ratio: float = math.nan
    interval: Interval | None = None
    why: str = ""


@dataclass(frozen=True)
class FieldResult:
    """How good the predictions of one field are.

    Attributes:
        kind: "real" numbers, or "classes".
        unit: The field's unit; errors of real numbers have it. Those of components of several
            units, which it lists with commas, are in standard deviations of each component.
        errors: Errors by name. Real numbers have ``rmse``, the root mean square error of all
            values; ``max``, the largest absolute one; and ``relative_l2``, the norm of the error
            divided by that of the truth, both of a whole episode, averaged over episodes. Classes
            have ``accuracy`` and ``balanced_accuracy``, the mean over the true classes.
        interval: 95 % interval of ``rmse`` or ``accuracy`` over episodes; None: too few of them.
        by_component: ``rmse`` of each component with its unit, of fields with few of them.
        confusion: Number of values by true class, then by predicted class; of classes.
        classes: The classes in the order of `confusion`.
        near_zero: Number of episodes left out of ``relative_l2``, as the truth is nearly zero.
        episodes: The "best", "median" and "worst" episode.
        rivals: The rivals by name.
    """

    kind: Literal["real", "classes"]
    unit: str = ""
    errors: Mapping[str, float] = field(default_factory=dict)
    interval: Interval | None = None
    by_component: Sequence[tuple[float, str]] = ()
    confusion: Sequence[Sequence[int]] = ()
    classes: Sequence[int] = ()
    near_zero: int = 0
    episodes: Mapping[str, EpisodeError] = field(default_factory=dict)
    rivals: Mapping[str, RivalResult] = field(default_factory=dict)


@dataclass(frozen=True)
class PartResult:
    """How good a network is on samples that it has not learned from.

    Attributes:
        samples: Number of samples.
        episodes: Number of episodes, or of what else they are divided into.
        division: Where they come from, in words.
        used: What these samples decided about the network, in words; empty: nothing.
        fields: The predicted fields by name.
        compared: Number of samples on which rivals are compared, whole batches from all places.
        why: What speaks against comparing on these samples; empty: nothing.
        missing: Why other predicted fields are not judged, by name.
        metrics: The user's own errors, `Training.metrics`, averaged over the episodes, by name.
    """

    samples: int
    episodes: int
    division: str
    used: str = ""
    fields: Mapping[str, FieldResult] = field(default_factory=dict)
    compared: int = 0
    why: str = ""
    missing: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Drift:
    """How far a number that the physics keeps moves away, on average over episodes.

    Attributes:
        prediction: Absolute difference from its true value at the beginning, by row of
            `RolloutResult.rows`, of predictions that are fed back.
        truth: The same of the simulation.
    """

    prediction: Sequence[float]
    truth: Sequence[float]


@dataclass(frozen=True)
class RolloutResult:
    """How good predictions of a field are that are fed back, from the beginning of episodes.

    Attributes:
        unit: The unit of the errors; of components of several units, which it lists with commas,
            they are in standard deviations of each component.
        part: The samples: a name of `Result.parts`.
        episodes: Number of episodes.
        rows: Numbers of rows after the beginning, as far as half of the episodes reach.
        errors: Root mean square error of all values and episodes after each of them.
        low: The error that a tenth of the episodes is below.
        high: The error that a tenth is above.
        unchanged: The root mean square error of predicting that nothing changes.
        doubles: Number of rows after which the error is twice the first one; None: never.
        loses: Number of rows after which it is no smaller than if nothing changes; None: never.
        episode_errors: The "best", "median" and "worst" episode, over all rows.
        invariants: How numbers that the physics keeps move away, by name.
    """

    unit: str
    part: str
    episodes: int
    rows: Sequence[int]
    errors: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    unchanged: Sequence[float]
    doubles: int | None = None
    loses: int | None = None
    episode_errors: Mapping[str, EpisodeError] = field(default_factory=dict)
    invariants: Mapping[str, Drift] = field(default_factory=dict)

    @property
    def shown(self) -> list[int]:
        """Places in `rows` of about six rows, at growing distances."""
        wanted = {0, len(self.rows) - 1}
        size = 1
        while size < len(self.rows):
            wanted.add(size)
            size *= 4
        return sorted(wanted)


@dataclass(frozen=True)
class Result:
    """What a run found, and where it is.

    ``print(result)`` shows what the run prints at its end, ``result["error/x/rmse"]`` is a number.

    Attributes:
        kind: The pipeline: "training", "data_generation", "prediction" or "replay"; or
            "evaluation", or "sweep".
        session: Folder of the session, or of the study.
        seconds: Duration in s.
        summary: What was done, in lines.
        numbers: Losses and rates by name, with units in the names: see `values`.
        parts: The network's errors on the parts "validation" and "test", as far as they exist.
        rollouts: How good predictions are that are fed back, by predicted field.
        policies: How good the network is as a policy, by environment and engine.
        sweep: What the trials of a sweep have found; None: it is none.
        why: Why the network was not judged; empty if it was.
        places: Where things are, by what they are.
    """

    kind: str
    session: str
    seconds: float
    summary: Sequence[str] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    parts: Mapping[str, PartResult] = field(default_factory=dict)
    rollouts: Mapping[str, RolloutResult] = field(default_factory=dict)
    policies: Mapping[str, PolicyResult] = field(default_factory=dict)
    sweep: SweepResult | None = None
    why: str = ""
    places: Mapping[str, str] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, float]:
        """All numbers by name: `numbers`, and errors as ``error/FIELD/NAME``, ``test/FIELD/NAME``.

        The errors of a rival are ``error/FIELD/RIVAL/NAME``; the user's own ones ``metric/NAME``
        and ``test/metric/NAME``. ``rollout/FIELD/`` has ``rmse``, the error at the last row, and as
        numbers of rows ``doubles`` and ``loses``: see `RolloutResult`. The mean reward of an
        episode is ``reward``, after the name of the environment and engine if there are several;
        ``best`` that of the best setting of a sweep.
        """
        found = dict(self.numbers)
        for part, judged in self.parts.items():
            start = "error" if part == "validation" else part
            own = "metric" if part == "validation" else f"{part}/metric"
            found |= {f"{own}/{name}": value for name, value in judged.metrics.items()}
            for name, of in judged.fields.items():
                found |= {f"{start}/{name}/{key}": value for key, value in of.errors.items()}
                for rival, other in of.rivals.items():
                    found |= {
                        f"{start}/{name}/{rival}/{key}": value
                        for key, value in other.errors.items()
                    }
        for name, rollout in self.rollouts.items():
            found[f"rollout/{name}/rmse"] = rollout.errors[-1]
            for key, row in (("doubles", rollout.doubles), ("loses", rollout.loses)):
                if row is not None:
                    found[f"rollout/{name}/{key}"] = row
        for name, policy in self.policies.items():
            start = f"{name}/" if len(self.policies) > 1 else ""
            found |= {f"{start}{key}": value for key, value in policy.values.items()}
        best = None if self.sweep is None else self.sweep.best
        return found if best is None else {**found, "best": best.value}

    def __getitem__(self, name: str) -> float:
        """Return one of `values`."""
        known = self.values
        if name not in known:
            raise KeyError(f"{name!r}; the result has: {', '.join(known) or 'no numbers'}")
        return known[name]

    def to_plain(self) -> dict[str, Any]:
        """Return all of it as plain data; numbers that do not exist are None."""
        found: dict[str, Any] = _finite(dataclasses.asdict(self))
        return found

    def to_json(self) -> str:
        """Return all of it as JSON; numbers that do not exist are null."""
        return json.dumps(self.to_plain(), indent=1, allow_nan=False)

    @property
    def lines(self) -> list[str]:
        """The text, line by line."""
        found = list(self.summary)
        for name, part in self.parts.items():
            found += _part_lines(name, part)
        for name, rollout in self.rollouts.items():
            found += _rollout_lines(name, rollout)
        for name, policy in self.policies.items():
            found += policy.lines(name)
        found += [] if self.sweep is None else self.sweep.lines
        if self.why:
            found.append(f"not judged: {self.why}")
        return found

    def show(self, *, trust: bool = False) -> None:
        """Show the page of ``physx report`` below the notebook's cell; elsewhere print its path.

        Args:
            trust: Whether to import whatever code the session's files name.

        Raises:
            UsageError: If physx-report is not installed.
            PhysxError: If the page cannot be written.
        """
        find_command("report").show(self.session, trust=trust)

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def _repr_html_(self) -> str:
        """Return the text with tables, for notebooks."""
        from html import escape  # takes as long to import as all else here; runs need it never

        found = [f"<p>{'<br>'.join(escape(line) for line in self.summary)}</p>"]
        for name, part in self.parts.items():
            found.append(f"<h4>{escape(_heading(name, part))}</h4>")
            for label, of in part.fields.items():
                rows = [("network", _shown(of.errors, of.unit), ""), *_rival_rows(of)]
                cells = (
                    "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
                    for row in rows
                )
                found.append(
                    f"<table><caption>{escape(label)}</caption><tr><th></th><th>errors</th>"
                    f"<th>the network is</th></tr>{''.join(cells)}</table>"
                )
                found += [f"<p>{escape(line)}</p>" for line in _details(of)]
            notes = [*_metrics(part), *_missing(part), *([part.why] if part.why else [])]
            found += [f"<p>{escape(line)}</p>" for line in notes]
        blocks = [list(_rollout_lines(name, rollout)) for name, rollout in self.rollouts.items()]
        blocks += [policy.lines(name) for name, policy in self.policies.items()]
        blocks += [] if self.sweep is None else [self.sweep.lines]
        for lines in blocks:
            told = "\n".join(lines)
            found.append(f"<pre>{escape(told)}</pre>")
        if self.why:
            found.append(f"<p>not judged: {escape(self.why)}</p>")
        return "\n".join(found)


def _heading(name: str, part: PartResult) -> str:
    told = f"decided {part.used}" if part.used else "decided nothing about the network"
    return f"{name}: {part.samples:,} samples of {part.division}, which {told}"


def _part_lines(name: str, part: PartResult) -> Iterator[str]:
    yield _heading(name, part)
    for label, of in part.fields.items():
        told = f", 95 % interval {between(of.interval)}" if of.interval else ""
        yield f"  {label}: {_shown(of.errors, of.unit)}{told}"
        rows = list(_rival_rows(of))
        width = max([len(rival) for rival, _, _ in rows], default=0)
        for rival, errors, told in rows:
            yield "    " + f"{rival:{width}}  {errors:24}  {told}".rstrip()
        yield from (f"    {line}" for line in _details(of))
    yield from (f"  {line}" for line in (*_metrics(part), *_missing(part)))
    if part.why:
        yield f"  {part.why}"


def _metrics(part: PartResult) -> Iterator[str]:
    for name, value in part.metrics.items():
        yield f"{name}: {number(value)}, the mean over {part.episodes:,} episodes"


def _rollout_lines(name: str, of: RolloutResult) -> Iterator[str]:
    unit = _one_unit(of.unit)
    yield f"{name}, predictions fed back: {of.episodes} episodes ({of.part}), {of.rows[-1]:,} rows"
    head = ["after row", f"rmse {unit}".rstrip(), "80 % of the episodes", "if nothing changes"]
    cells = [head, *([
        f"{of.rows[k]:,}", number(of.errors[k]), f"{number(of.low[k])} to {number(of.high[k])}",
        number(of.unchanged[k]),
    ] for k in of.shown)]  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        padded = (f"{cell:>{size}}" for cell, size in zip(row, widths, strict=True))
        yield f"  {'  '.join(padded)}"
    yield f"  {'; '.join(rollout_notes(of))}"
    if of.episode_errors:
        each = (f"{n} {e.text}: {number(e.error)} {unit}" for n, e in of.episode_errors.items())
        yield f"  episodes: {', '.join(map(str.rstrip, each))}"
    for label, drift in of.invariants.items():
        yield (
            f"  {label} moves by {number(drift.prediction[-1])} in the predictions, by "
            f"{number(drift.truth[-1])} in the simulation, after row {of.rows[-1]:,}"
        )


def rollout_notes(of: RolloutResult) -> list[str]:
    """Return after how many rows predictions that are fed back become bad, in words."""
    last = of.rows[-1]
    return [
        f"twice the first error after row {of.doubles:,}"
        if of.doubles is not None else f"less than twice the first error to row {last:,}",
        f'no better than "nothing changes" after row {of.loses:,}'
        if of.loses is not None else f'better than "nothing changes" to row {last:,}',
    ]  # fmt: skip


def _missing(part: PartResult) -> Iterator[str]:
    yield from (f"{name} is not judged: {why}" for name, why in part.missing.items())


def _rival_rows(of: FieldResult) -> Iterator[tuple[str, str, str]]:
    """Yield name, errors and verdict of each rival."""
    for name, rival in of.rivals.items():
        if not rival.errors:
            yield name, "not run", rival.why
            continue
        key = "rmse" if of.kind == "real" else "accuracy"
        errors = _shown({key: rival.errors[key]}, of.unit)
        if rival.verdict == "unknown":
            yield name, errors, rival.why
            continue
        ratio = "" if math.isnan(rival.ratio) else f", {number(rival.ratio)} times the error"
        limits = f" ({between(rival.interval)})" if ratio and rival.interval else ""
        yield name, errors, f"{WORDS[rival.verdict]}{ratio}{limits}"


def _details(of: FieldResult) -> Iterator[str]:
    if of.by_component:
        each = ", ".join(f"{number(value)} {unit}".strip() for value, unit in of.by_component)
        yield f"rmse by component: {each}"
    if of.near_zero:
        yield f"{of.near_zero} episodes have no relative error, as the truth is nearly zero"
    if of.episodes:
        unit = _one_unit(of.unit) if of.kind == "real" else ""
        form = number if of.kind == "real" else percent
        each = ", ".join(
            f"{name} {episode.text}: {form(episode.error)} {unit}".rstrip()
            for name, episode in of.episodes.items()
        )
        yield f"episodes: {each}"
    if of.confusion and len(of.classes) <= _WIDEST:
        yield "true class: values by predicted class"
        for label, row in zip(of.classes, of.confusion, strict=True):
            yield f"  {label}: {', '.join(f'{count:,}' for count in row)}"


def _shown(errors: Mapping[str, float], unit: str) -> str:
    own = _one_unit(unit)
    words = []
    for name, value in errors.items():
        if name in ("accuracy", "balanced_accuracy", "relative_l2"):
            words.append(f"{name} {percent(value)}")
        else:
            words.append(f"{name} {number(value)} {own}".rstrip())
    return ", ".join(words)


def _one_unit(unit: str) -> str:
    """Return a unit; of components of several units, that in which their errors are added up."""
    return unit if "," not in unit else "std"


def _finite(value: Any) -> Any:
    """Return plain data in which numbers that are not finite are None."""
    if isinstance(value, Mapping):
        return {str(name): _finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
