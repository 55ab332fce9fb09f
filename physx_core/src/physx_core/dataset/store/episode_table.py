"""The table of episodes: the mode ``episodes``, whose records say which rows of others count.

The rows of independent episodes are stored as they come. A record of this table says where those of
an episode lie, and commits them: rows that no record covers do not exist for any reader. The rows
of a mode with records are those of its episodes, in order of campaign and number.

A record holds the fields `TABLE_FIELDS`, a column for each parameter of the environment, and one of
role ``episode`` for each field that an episode has once, which is 0 in records of failed episodes,
of parts that are not the last one, and of streams:

- ``mode_index``: index of the mode it speaks of in `RECORDED`.
- ``campaign``, ``episode``: the campaign, 0 for the first, and the episode's number in it.
- ``count``: for how many numbers it stands. If there are several, each has one row, in order, and
  they count together or not at all.
- ``first_row``, ``rows``: address of its first row, and number of rows. A row's address is its
  number in the mode when it was stored, counted on from ``first_row`` of its partition; unlike its
  number, it never changes. An address whose rows are lost or removed is never used again.
- ``part``: the rows of an episode may lie in several places, each with a record: 0, 1, ...
- ``status``: an `EpisodeStatus`.
- ``seconds``: what it cost.

An episode counts once all its parts are recorded, up to one that is not ``MORE``, and all their
rows are there. If its number is recorded again, from part 0 on, the later episode replaces the
earlier one as soon as it counts itself.

Rows without episodes are a *stream*: they count as they are stored. A mode without records is one.
Otherwise a record with the status ``STREAM`` covers the rows of a stream, which come before those
of the episodes of its campaign. While the stream is written it covers all further rows (``rows`` is
`OPEN`); when the next campaign begins, the same record with their number replaces it. Either is on
the disk before the next row is stored, so whatever is lost later, the rows of a stream count and
those of an unfinished episode do not.
"""

from __future__ import annotations

from physx_core.config import MODES, WRONG
from physx_core.dataset.store.manifest import Manifest
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field

EPISODES = "episodes"
"""Mode of the table of episodes."""

RECORDED = (*MODES, WRONG)
"""Modes that can hold episodes. The campaigns of the rejected samples of an episode, in the mode
"wrong", are those of all modes."""

LOST = "lost_episodes"
"""Entry in a dataset's info: records were lost, so no row of a mode without any counts."""

TABLE_FIELDS = (
    Field("mode_index", (), "int8", role="additional"),
    Field("campaign", (), "int64", role="additional"),
    Field("episode", (), "int64", role="additional"),
    Field("count", (), "int64", role="additional"),
    Field("first_row", (), "int64", role="additional"),
    Field("rows", (), "int64", role="additional"),
    Field("part", (), "int64", role="additional"),
    Field("status", (), "int8", role="additional"),
    Field("seconds", (), "float64", "s", role="additional"),
)
"""Fields of the table, in addition to the parameters and the fields of role ``episode``."""


def has_table(manifest: Manifest) -> bool:
    """Return whether a dataset has a table of episodes, not just a mode of that name."""
    mode = manifest.modes.get(EPISODES)
    return mode is not None and all(
        field.name in mode.fields
        and mode.fields[field.name].numpy_dtype == field.numpy_dtype
        and mode.fields[field.name].shape == ()
        for field in TABLE_FIELDS
    )


def mode_index(mode: str) -> int:
    """Return the index of a mode in the table.

    Raises:
        ConfigError: If there can be no episodes in it.
    """
    if mode not in RECORDED:
        raise ConfigError(f'Mode "{mode}" cannot hold episodes: only {listed(RECORDED)} can.')
    return RECORDED.index(mode)
