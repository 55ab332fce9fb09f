"""``physx edit``: write a copy of a dataset with other rows or fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from physx_core.cli import count, options_from, show
from physx_core.errors import UsageError
from physx_core.observers import ProgressBar
from physx_core.views import View
from physx_formats import edit
from physx_formats.cli.pairs import parse_pairs


@dataclass
class Edit:
    """Write a dataset that has the rows and fields of another one as they should be.

    What is not named stays as it is. DIR is not changed; `physx info OUT` says what OUT was made
    from. Fields go by the names that they have in DIR.

    For example: `physx edit sessions/run coarse --drop-episodes 3 17 --stride 10 --cast u=float32`,
    or `physx edit sessions/run fast --derive speeds.py:speeds --units speed=m/s`.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The folder to create."""
    mode: tuple[str, ...] = ()
    """Modes; by default all that have samples."""
    episodes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=LOW:HIGH ...]")] = ()
    """Keep only independent episodes with a parameter, or `episode`, their number, from LOW to
    HIGH; or status=finished, status=cut."""
    where: str | None = None
    """Keep only episodes that a function "script.py:function" chooses: see View.where."""
    drop_episodes: tuple[int, ...] = ()
    """Numbers of independent episodes to leave out."""
    stride: int = 1
    """Keep only every n-th row of each trajectory."""
    rows: str | None = None
    """Keep only rows that a function chooses: it gets the fields of a trajectory by name, arrays of
    shape (rows, ...), and returns booleans of shape (rows,)."""
    part: Literal["all", "training", "validation", "test"] = "all"
    """Keep only this part: a fold of the episodes is that of validation, another one that of the
    test."""
    folds: int = 5
    """Number of folds."""
    fold: int = 0
    """The fold of validation."""
    test_fold: int | None = None
    """The fold of the test."""
    derive: str | None = None
    """A function that gets the fields of a trajectory, as `--rows`, and returns further ones."""
    keep: tuple[str, ...] = ()
    """Fields to keep; by default all."""
    drop: tuple[str, ...] = ()
    """Fields to leave out."""
    cast: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[FIELD=TYPE ...]")] = ()
    """New types of fields, such as float32."""
    units: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[FIELD=UNIT ...]")] = ()
    """New units of fields."""
    rename: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[FIELD=NAME ...]")] = ()
    """New names of fields."""


def run(words: Sequence[str]) -> None:
    """Write the dataset, and print the number of its samples."""
    options = options_from(Edit, words, "edit")
    bar = ProgressBar()
    bar.begin("edit", None, "B")
    try:
        stored = edit(
            options.directory,
            options.out,
            modes=options.mode,
            view=View(
                episodes=_ranges(options.episodes),
                where=options.where,
                stride=options.stride,
                folds=options.folds,
                fold=options.fold,
                test_fold=options.test_fold,
                hold_back=options.part != "all",
            ),
            part=options.part,
            drop_episodes=options.drop_episodes,
            rows=options.rows,
            derive=options.derive,
            keep=options.keep,
            drop=options.drop,
            cast=parse_pairs("cast", options.cast),
            units=parse_pairs("units", options.units),
            rename=parse_pairs("rename", options.rename),
            advance=bar.advance,
        )
    finally:
        bar.end()
    for mode, rows in stored.items():
        show(f"{count(rows, f'{mode} sample')}: {options.out}")


def _ranges(words: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in parse_pairs("episodes", words).items():
        if name == "status":
            found[name] = value
            continue
        try:
            low, high = map(float, value.split(":"))
        except ValueError:
            raise UsageError(
                f"--episodes {name}={value} is no range: write {name}=LOW:HIGH."
            ) from None
        found[name] = [low, high]
    return found
