"""Trials and their results, and the files that store them in the trials' folders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from physx_cluster.errors import StudyError
from physx_cluster.sweep.parameters import Setting
from physx_core import files
from physx_core.config import read_toml
from physx_core.errors import PhysxError

TRIAL, RESULT, FAILURE = "trial.toml", "result.toml", "failure.toml"
LOCK, OUTPUT = "trial.lock", "output.txt"
COMPLETE, PRUNED, FAILED = "complete", "pruned", "failed"


@dataclass(frozen=True)
class Trial:
    """A training, possibly preceded by a data generation, with one setting and one seed.

    Attributes:
        number: Number of the trial in the study, from 1.
        pipeline: Name of the pipeline.
        setting: Number of the setting within the pipeline, from 1.
        seed: The seed.
        values: Values of the parameters.
        known: Number of trials whose results were known when its batch was chosen. They are the
            first ones, and the only ones that it is compared with while it runs.
    """

    number: int
    pipeline: str
    setting: int
    seed: int
    values: Setting
    known: int

    @property
    def name(self) -> str:
        """Name of the trial's folder."""
        return f"trial_{self.number:04}"


@dataclass(frozen=True)
class Result:
    """The result of a trial.

    Attributes:
        state: "complete"; "pruned" if it fell behind; "failed" if an error ended it.
        value: The number to compare; NaN if it failed.
        epochs: Number of completed epochs; None if it failed.
        error: Name of the error's class.
        numbers: The number to compare, by epoch.
        rungs: The pruner's records of the trial.
    """

    state: str
    value: float = math.nan
    epochs: int | None = None
    error: str = ""
    numbers: Mapping[int, float] = field(default_factory=dict)
    rungs: Mapping[str, float] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write it into a trial's folder atomically."""
        plain: dict[str, Any] = {"state": self.state, "value": self.value}
        plain |= {} if self.epochs is None else {"epochs": self.epochs}
        plain |= {"error": self.error} if self.error else {}
        plain["numbers"] = {str(epoch): value for epoch, value in self.numbers.items()}
        plain["rungs"] = dict(self.rungs)
        files.replace(folder / RESULT, tomli_w.dumps(plain).encode())

    @classmethod
    def read(cls, folder: Path) -> Result | None:
        """Return the result in a trial's folder; None if there is none.

        Raises:
            StudyError: If the file is damaged.
        """
        path = folder / RESULT
        if not path.exists():
            return None
        try:
            plain = read_toml(path)
            numbers = {int(epoch): float(value) for epoch, value in plain["numbers"].items()}
            rungs = {str(name): float(value) for name, value in plain["rungs"].items()}
            state, epochs, error = plain["state"], plain.get("epochs"), plain.get("error", "")
            if state not in (COMPLETE, PRUNED, FAILED):
                raise ValueError(f"the state is {state!r}")
            if not isinstance(epochs, int | None) or not isinstance(error, str):
                raise TypeError("epochs or error has the wrong type")
            return cls(state, float(plain["value"]), epochs, error, numbers, rungs)
        except (PhysxError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise StudyError(
                f"{path} is damaged ({error}). Remove it: the trial then resumes from its last "
                "checkpoint and reaches the same result."
            ) from None


@dataclass(frozen=True)
class Failure:
    """The error that ended an attempt at a trial.

    Attributes:
        error: Name of the error's class.
        message: Text of the error.
        is_final: Whether another attempt would end the same way.
        is_result: Whether the trial itself caused the error, which is then its result. Otherwise,
            the cause is the machine, for example a full disk, or the study.
    """

    error: str
    message: str
    is_final: bool
    is_result: bool

    def write(self, folder: Path) -> None:
        """Write it into a trial's folder."""
        plain = vars(self)
        files.replace(folder / FAILURE, tomli_w.dumps(plain).encode())

    @classmethod
    def read(cls, folder: Path) -> Failure | None:
        """Return the error in a trial's folder; None if there is none or it cannot be read."""
        try:
            plain = read_toml(folder / FAILURE)
            texts = str(plain["error"]), str(plain["message"])
            return cls(*texts, bool(plain["is_final"]), bool(plain["is_result"]))
        except (PhysxError, LookupError):
            return None
