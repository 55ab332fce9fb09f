"""Comparison: one of several candidates, such as networks, against the best of the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from physx_core.errors import UsageError
from physx_core.results.result import Result


@dataclass(frozen=True)
class Comparison:
    """Errors of candidates over several seeds, and whether one of them beats all others.

    A seed may be lucky: the worst error of the candidate that is judged has to be smaller than the
    mean error of the best of the others. ``print(comparison)`` shows the errors and what follows.

    Attributes:
        errors: Errors by candidate, one for each seed; small ones are good.
        subject: The candidate that is judged.
        what: Name and unit of the errors.
        networks: The candidates that are networks; the others need no training.
        references: Candidates that need not be beaten, such as an exact model.

    Raises:
        UsageError: If a candidate has no errors, or there is nobody to beat.
    """

    errors: Mapping[str, Sequence[float]]
    subject: str
    what: str = "error"
    networks: Sequence[str] = ()
    references: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name in (self.subject, *self.networks, *self.references):
            if name not in self.errors:
                raise UsageError(f"There are no errors of {name!r}, only of {list(self.errors)}.")
        empty = [name for name, found in self.errors.items() if not len(found)]
        if empty or not self.rivals:
            raise UsageError(f"There are no errors of {empty or 'a rival'}.")

    @classmethod
    def of(
        cls, results: Mapping[str, Sequence[Result]], error: str, subject: str | None = None
    ) -> Comparison:
        """Compare trainings on the same samples, and the rivals that they were judged with.

        Args:
            results: What `Training.execute` returned, by candidate, one for each seed.
            error: An error as in `Result.values`: "error/FIELD/rmse", "test/FIELD/relative_l2"; of
                an accuracy, what is missing to 1.
            subject: The candidate that is judged; None: the last one.

        Raises:
            KeyError: If a network was not judged by that error.
        """
        part, field, name = error.split("/")
        own = {candidate: [each[error] for each in of] for candidate, of in results.items()}
        found: dict[str, list[float]] = {}
        unit = ""
        for each in (each for of in results.values() for each in of):
            judged = each.parts["validation" if part == "error" else part].fields[field]
            unit = judged.unit if name in ("rmse", "max") else ""
            for rival, of in judged.rivals.items():
                if of.errors:
                    found.setdefault(rival, []).append(of.errors[name])
        found |= own
        if "accuracy" in name:
            found = {candidate: [1 - each for each in of] for candidate, of in found.items()}
            name = f"1 - {name}"
        what = f"{field}: {name}{f' in {unit}' if unit else ''}"
        return cls(found, list(results)[-1] if subject is None else subject, what, list(results))

    @property
    def rivals(self) -> list[str]:
        """Whom the subject has to beat."""
        return [name for name in self.errors if name not in (self.subject, *self.references)]

    @property
    def wins(self) -> bool:
        """Whether the subject's worst error is smaller than the mean error of the best rival."""
        return max(self.errors[self.subject]) < self._mean(self._best(self.rivals))

    @property
    def table(self) -> str:
        """The mean error of each candidate, and that of its worst seed."""
        rows = [(self.what, "mean", "worst seed")]
        rows += [(n, f"{fmean(e):.3g}", f"{max(e):.3g}") for n, e in self.errors.items()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return "\n".join(f"{a:{widths[0]}}  {b:>{widths[1]}}  {c:>{widths[2]}}" for a, b, c in rows)

    def __str__(self) -> str:
        return "\n".join([self.table, "", *self._verdict()])

    def _verdict(self) -> Iterator[str]:
        best, own = self._best(self.rivals), self._mean(self.subject)
        ratio = own / self._mean(best)
        yield f"{self.subject}: {ratio:.2f} times the error of the best rival, {best}"
        plain = [name for name in self.rivals if name not in self.networks]
        if plain and best in self.networks:
            best = self._best(plain)
            told = _times(own, self._mean(best))
            yield f"{self.subject}: {told} {best}, the best without a network"
        for name in self.references:
            yield f"{name}: {_times(self._mean(name), own)} {self.subject}"

    def _mean(self, name: str) -> float:
        return fmean(self.errors[name])

    def _best(self, names: Sequence[str]) -> str:
        return min(names, key=self._mean)


def _times(error: float, other: float) -> str:
    if error > other:
        return f"{error / other:.2g} times farther off than"
    return f"{other / error:.2g} times closer than"
