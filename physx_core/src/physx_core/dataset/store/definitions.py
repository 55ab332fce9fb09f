"""Compares the fields of a mode with given fields and completes their shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from physx_core.errors import FieldsMismatchError
from physx_core.fields import Field


def compare_fields(what: str, known: Mapping[str, Field], given: Mapping[str, Field]) -> None:
    """Check that two sets of fields are equal; a shape of None matches any.

    Args:
        what: Owner of the known fields, for the error message.
        known: Defined fields.
        given: Fields to compare with them.
    """
    differences = dict.fromkeys(given.keys() - known.keys(), "is not one of its fields")
    differences |= dict.fromkeys(known.keys() - given.keys(), "is missing")
    for name in known.keys() & given.keys():
        difference = _difference(known[name], given[name])
        if difference:
            differences[name] = difference
    if differences:
        raise FieldsMismatchError(f"{what} has different fields", dict(sorted(differences.items())))


def complete_shapes(known: Mapping[str, Field], given: Mapping[str, Field]) -> dict[str, Field]:
    """Return the known fields, with undefined shapes taken from the given ones."""
    return {
        name: replace(field, shape=given[name].shape) if field.shape is None else field
        for name, field in known.items()
    }


def _difference(known: Field, given: Field) -> str:
    parts = []
    if None not in (known.shape, given.shape) and known.shape != given.shape:
        parts.append(f"shape {known.shape}, not {given.shape}")
    if known.dtype != given.dtype:
        parts.append(f"type {np.dtype(known.dtype)}, not {np.dtype(given.dtype)}")
    if known.unit != given.unit:
        parts.append(f"unit {known.unit!r}, not {given.unit!r}")
    if known.role != given.role:
        parts.append(f"role {known.role}, not {given.role}")
    if known.axes != given.axes:
        parts.append(f"axes {known.axes}, not {given.axes}")
    if known.like != given.like:
        parts.append(f"like {known.like!r}, not {given.like!r}")
    return f"has {'; '.join(parts)}" if parts else ""
