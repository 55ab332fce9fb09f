"""Episodes: the trajectories of a mode, found by what physx adds to each row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read.views import ModeView
from physx_core.errors import DatasetError
from physx_core.typing import Array

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Episode:
    """Rows that follow one another in time.

    Attributes:
        env_id: Instance that made them, counted from 1.
        episode: The instance's number of the trajectory, counted from 0. It is not unique: every
            run counts anew, and a trajectory that a sample is missing from is two.
        rows: Numbers of the rows in their mode, in the order of time.
    """

    env_id: int
    episode: int
    rows: Index


def find_episodes(view: ModeView, total: int) -> list[Episode]:
    """Return the trajectories among the first rows of a mode.

    A trajectory is a longest sequence of rows of one instance, in the order of writing, that have
    the same number in ``episode`` and steps without a gap.

    Args:
        view: Field name to values; a field that is missing is taken to be the same in all rows,
            ``step`` excepted.
        total: How many rows to look at.

    Returns:
        The trajectories, by their first rows.

    Raises:
        DatasetError: The rows have neither ``step`` nor ``episode``.
    """
    columns, order, begins = _cut(view, total)
    parts = np.split(order, begins[1:]) if total else []
    parts.sort(key=lambda rows: int(rows[0]))
    env_id, episode = columns["env_id"], columns["episode"]
    return [Episode(int(env_id[rows[0]]), int(episode[rows[0]]), rows) for rows in parts]


def episode_lengths(view: ModeView, total: int) -> tuple[Index, int]:
    """Return how many rows each trajectory has, and how many instances made them.

    The arguments and errors are those of `find_episodes`.
    """
    columns, order, begins = _cut(view, total)
    return np.diff(begins, append=len(order)), len(np.unique(columns["env_id"]))


def _cut(view: ModeView, total: int) -> tuple[dict[str, Array], Index, Index]:
    """Return the columns, the rows by instance, and where trajectories begin among these."""
    columns = {
        name: np.asarray(view[name][:total])
        for name in ("env_id", "episode", "step")
        if name in view
    }
    if "step" not in columns and "episode" not in columns:
        raise DatasetError(
            'The rows have no fields "step" and "episode", so nothing says where trajectories '
            "begin. Samples that environments make have them."
        )
    zeros = np.zeros(total, np.int64)
    env_id, episode = columns.setdefault("env_id", zeros), columns.setdefault("episode", zeros)
    order = np.argsort(env_id, kind="stable")
    begins = np.diff(env_id[order], prepend=-1) != 0
    begins |= np.diff(episode[order], prepend=-1) != 0
    if "step" in columns:
        begins |= np.diff(columns["step"][order], prepend=-2) != 1
    begins[:1] = True
    return columns, order, np.flatnonzero(begins)
