"""``physx branch``: simulate on from a stored row, as it was and with a change."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from physx_core import plugins
from physx_core.cli.pipeline_options import pipeline_from
from physx_core.cli.visualizers import visualizer_plugins
from physx_core.components import Cursor, Visualizer
from physx_core.errors import UsageError, listed
from physx_core.pipelines.branch import Branch

_CURSOR = "cursor"
_ROW = "row"
_SET = "--set"


def run(words: Sequence[str]) -> None:
    """Branch off a row; the first words are a session, dataset or log, and the row.

    Both futures are drawn by the given visualizer, by default that of the only installed visualizer
    plugin. The row ``cursor`` is where the cursor of an open viewer stands, which then shows the
    futures as well. ``--set NAME=VALUE ...`` is short for ``--change.NAME VALUE``.
    """
    words = list(_with_changes(words))
    is_given = any(word.partition("=")[0] == "--visualizer" for word in words)
    at_cursor = words[1:2] == [_CURSOR]
    viewers = [] if is_given and not at_cursor else visualizer_plugins()
    given: dict[str, Any] = {"visualizer": viewers[0]} if len(viewers) == 1 else {}
    if at_cursor:
        viewer, found = _cursor(viewers)
        words[1] = str(found.position)
        given = {"visualizer": viewer, "visualizer_kwargs": dict(found.options)}
    pipeline = pipeline_from(
        Branch,
        "branch",
        ("data", "row"),
        words,
        given,
        arguments="DATASET|LOG ROW|cursor",
        examples=(
            "sessions/data_generation 120 --set stiffness=5",
            "sessions/data_generation cursor --set stiffness=5 --step-nb 300",
            "sessions/data_generation 120 --policy sessions/training",
            "ant.h5 20 --set push.torso=[200,0,0]",
        ),
    )
    pipeline.execute()


def _with_changes(words: Sequence[str]) -> Iterator[str]:
    """Yield the words, with the option of a single change for each word after ``--set``."""
    sets = False
    for word in words:
        sets = word == _SET or (sets and not word.startswith("-"))
        if not sets:
            yield word
        elif word != _SET:
            name, equals, value = word.partition("=")
            if not equals:
                raise UsageError(f"{_SET} {word}: write {_SET} NAME=VALUE.")
            yield from (f"--change.{name}", value)


def _cursor(viewers: Sequence[str]) -> tuple[str, Cursor]:
    """Return the visualizer that has an open viewer, and where its cursor stands.

    Raises:
        UsageError: If there is none, or it is on another timeline.
    """
    for viewer in viewers:
        kind = plugins.resolve("visualizer", viewer)
        if not isinstance(kind, type) or not issubclass(kind, Visualizer):
            continue
        if (found := kind.cursor()) is None:
            continue
        if found.timeline != _ROW:
            raise UsageError(
                f"The cursor is on the timeline {found.timeline}: open the dataset with "
                "physx view DATASET --live, and put the cursor on one of its rows."
            )
        return viewer, found
    raise UsageError(f"No installed visualizer has a cursor: {listed(viewers) or 'there is none'}.")
