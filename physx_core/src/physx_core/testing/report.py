"""Report: which checks of a component passed, failed, or did not apply."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

Status = Literal["passed", "failed", "expected", "skipped"]


class NotApplicableError(Exception):
    """Raised by a check of something that the component does not offer; its text is the reason."""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: What was checked, as a sentence.
        status: ``passed``, ``failed``, ``expected`` (it failed, as was said before), ``skipped``.
        reason: Why it did not pass; empty if it did.
    """

    name: str
    status: Status
    reason: str = ""


@dataclass(frozen=True)
class Report:
    """The results of all checks of a component.

    Attributes:
        component: What was checked.
        checks: The results.
    """

    component: str
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether no check failed unexpectedly, and at least one passed."""
        found = {check.status for check in self.checks}
        return "failed" not in found and "passed" in found

    def counts(self) -> dict[str, int]:
        """Return how many checks there are of each status."""
        names = ("passed", "failed", "expected", "skipped")
        return {name: sum(check.status == name for check in self.checks) for name in names}

    def __str__(self) -> str:
        """Return a line for each check that did not pass, and the counts."""
        lines = [
            f"{check.status:8}  {check.name}: {check.reason}"
            for check in self.checks
            if check.status != "passed"
        ]
        counts = ", ".join(f"{number} {name}" for name, number in self.counts().items() if number)
        return "\n".join([f"{self.component}: {counts}", *lines])


def run_checks(
    component: str,
    checks: Mapping[str, Callable[[], None]],
    expected_failures: Mapping[str, str] | None = None,
) -> Report:
    """Run checks, each of which raises if it fails, and return what they found.

    Args:
        component: What is checked.
        checks: Name of each check, a sentence, and the check.
        expected_failures: Names of checks that may fail, and why.

    Raises:
        KeyError: If there is no check of an expected name.
    """
    expected = dict(expected_failures or {})
    unknown = expected.keys() - checks.keys()
    if unknown:
        raise KeyError(f"There are no checks {sorted(unknown)}. There are: {sorted(checks)}.")
    found = []
    for name, check in checks.items():
        try:
            check()
        except NotApplicableError as reason:
            found.append(Check(name, "skipped", str(reason)))
        except Exception as error:  # whatever a component raises is what the report is about
            status: Status = "expected" if name in expected else "failed"
            found.append(Check(name, status, expected.get(name) or f"{_kind(error)}{error}"))
        else:
            found.append(Check(name, "passed"))
    return Report(component, tuple(found))


def _kind(error: Exception) -> str:
    return "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
