"""Report: which checks of a component passed, failed, or did not apply."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

Status = Literal["passed", "failed", "expected", "skipped"]


class NotApplicableError(Exception):
    """Raised by a check of something the component does not offer; its message is the reason."""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: What was checked, as a sentence.
        status: ``passed``, ``failed``, ``expected`` (an announced failure), ``skipped``.
        reason: Why it did not pass; empty if it did.
    """

    name: str
    status: Status
    reason: str = ""


@dataclass(frozen=True)
class Report:
    """The results of all checks of a component.

    Attributes:
        kind: Kind of the component, such as ``environment``.
        component: Reference of the checked component.
        checks: The results.
    """

    kind: str
    component: str
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether no check failed unexpectedly and at least one passed."""
        found = {check.status for check in self.checks}
        return "failed" not in found and "passed" in found

    def counts(self) -> dict[str, int]:
        """Return the number of checks with each status."""
        names = get_args(Status)
        return {name: sum(check.status == name for check in self.checks) for name in names}

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain data: kind, component, ok, counts, and checks."""
        checks = [asdict(check) for check in self.checks]
        named = {"kind": self.kind, "component": self.component, "ok": self.ok}
        return {**named, "counts": self.counts(), "checks": checks}

    def findings(self) -> list[Check]:
        """Return the checks that did not pass, merging those skipped for the same reason."""
        found: dict[tuple[str, str], list[Check]] = {}
        for check in self.checks:
            if check.status != "passed":
                same = check.reason if check.status == "skipped" else check.name
                found.setdefault((check.status, same), []).append(check)
        several = {key: f"{len(checks)} checks" for key, checks in found.items() if checks[1:]}
        return [
            replace(checks[0], name=several.get(key, checks[0].name))
            for key, checks in found.items()
        ]

    def __str__(self) -> str:
        """Return the counts and one line for each of the `findings`."""
        lines = [f"{check.status:8}  {check.name}: {check.reason}" for check in self.findings()]
        counts = ", ".join(f"{number} {name}" for name, number in self.counts().items() if number)
        return "\n".join([f"{self.kind} {self.component}: {counts}", *lines])
