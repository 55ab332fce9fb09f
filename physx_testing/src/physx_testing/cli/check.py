"""``physx check``: check the components of plugins against the contract of their kind."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from physx_core.cli import options_from, show
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, ContractError, UsageError
from physx_core.fields import Field
from physx_testing import Report, check_plugin

_STATUSES = ("passed", "failed", "expected", "skipped")
_NAME = 45  # columns of kind and name, which leave 35 for the numbers


@dataclass
class Check:
    """Check a plugin, or one component, against what physx and its users expect of its kind.

    Each check runs in its own process, so a crash counts as a failed check. The exit status is 1 if
    a check fails, or if the only component could not be checked at all.
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLUGIN|REFERENCE")]
    """A plugin, such as "toy", or a component, such as "toy/spring", "package.module:Class" or
    "script.py:Class"."""
    kind: str | None = None
    """Kind of component, such as "environment"; None: all kinds that the name stands for."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of the component's constructor."""
    fields: dict[str, Any] = field(default_factory=dict)
    """Fields of a network with their shapes, such as "input=[8,3] ground_truth=3"; by default
    several are tried."""
    network: str | None = None
    """Network to check an optimization or transformation with; None: one from its plugin."""
    network_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of that network's constructor."""
    loss: str | None = None
    """Loss of an optimization."""
    optimizer: str | None = None
    """Optimizer of an optimization."""
    lr: float | None = None
    """Learning rate of an optimization."""
    expect: dict[str, Any] = field(default_factory=dict)
    """Checks that may fail, and why, as in "bounces by its restitution=nothing bounces in it"."""
    timeout: float = 120.0
    """Time in s after which an unfinished check counts as failed."""
    json: bool = False
    """Print the reports as JSON."""


def run(words: Sequence[str]) -> None:
    """Print a table of counts, then the findings."""
    options = options_from(Check, words, "check")
    found = check_plugin(
        options.name,
        kind=options.kind,
        arguments=options.kwargs,
        network=_network(options),
        fields=_fields(options.fields),
        expected_failures={name: str(reason) for name, reason in options.expect.items()},
        timeout=options.timeout,
    )
    reports = list(found) if options.json else _shown(found)
    failed = [report for report in reports if not report.ok]
    if len(reports) > 1:  # components that need arguments from the user are not failures
        failed = [report for report in failed if report.counts()["failed"]]
    if options.json:
        plain = {"ok": not failed, "reports": [report.to_dict() for report in reports]}
        print(json.dumps(plain, indent=1))
    if failed:
        names = ", ".join(f"{report.kind} {report.component}" for report in failed)
        raise ContractError(f"{len(failed)} of {len(reports)} not as expected: {names}.")


def _network(options: Check) -> NetworkConfig | None:
    given = (options.loss, options.optimizer, options.lr)
    if options.network is None:
        if any(value is not None for value in given) or options.network_kwargs:
            raise UsageError("--network-kwargs, --loss, --optimizer and --lr need --network.")
        return None
    return NetworkConfig(
        options.network,
        network_kwargs=options.network_kwargs,
        loss=options.loss,
        optimizer=options.optimizer,
        lr=options.lr,
    )


def _fields(given: Mapping[str, Any]) -> list[Field]:
    fields = []
    for name, shape in given.items():
        sizes = [shape] if isinstance(shape, int) else shape
        if not isinstance(sizes, list) or not all(type(size) is int for size in sizes):
            raise ConfigError(
                f"--fields: {name}={shape} is not a shape: give {name}=3 or {name}=[3,3]."
            )
        fields.append(Field(name, tuple(sizes)))
    return fields


def _shown(reports: Iterable[Report]) -> list[Report]:
    """Print a line for each report as it arrives, then the findings."""
    done = []
    show(_row("kind", "component", _STATUSES))
    for report in reports:
        counts = report.counts()
        name = report.component.rpartition("/")[2] if ":" in report.component else report.component
        show(_row(report.kind, name, [counts[status] for status in _STATUSES]))
        done.append(report)
    for report in done:
        for check in report.findings():
            lines = check.reason.replace("\n", "\n    ")
            show(
                f"\n{check.status}: {report.kind} {report.component}\n  {check.name}:\n    {lines}"
            )
    return done


def _row(kind: str, name: str, cells: Sequence[object]) -> str:
    """Return a row of the table; its numbers follow in another line if the name is long."""
    begin = f"{kind:14}  {name:{_NAME - 16}}"
    begin += f"\n{'':{_NAME}}" if len(begin) > _NAME else ""
    of = zip(_STATUSES, cells, strict=True)
    return begin + "".join(f"  {cell!s:>{len(status)}}" for status, cell in of)
