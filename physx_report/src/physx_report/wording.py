"""Wording: numbers and names as people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SHARES = ("relative_l2", "accuracy", "balanced_accuracy")
_NAMES = {
    "rmse": "root mean square error",
    "max": "largest error",
    "relative_l2": "relative error",
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
}


def named(error: str) -> str:
    """Return the name of an error."""
    return _NAMES.get(error, error)


def number(value: float) -> str:
    """Return a number of three digits."""
    return f"{value:.3g}"


def value(given: object) -> str:
    """Return the value of an option."""
    return f"{given:.4g}" if isinstance(given, float) else str(given)


def measured(name: str, error: float, unit: str) -> str:
    """Return an error with its unit, shares in percent."""
    if name in SHARES:
        return f"{number(100 * error)} %"
    own = unit if "," not in unit else "std"
    return f"{number(error)} {own}".rstrip()


def flat(table: Mapping[str, Any], start: str = "") -> dict[str, str]:
    """Return nested options as text by dotted name."""
    found: dict[str, str] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{start}{name}.")
        else:
            found[start + name] = str(value)
    return found
