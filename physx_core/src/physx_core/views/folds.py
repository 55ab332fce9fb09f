"""Folds: which trajectories are held back, by their numbers, so that more of them move none."""

from __future__ import annotations

import itertools
from typing import Literal, TypeAlias

import numpy as np

from physx_core.dataset import Trajectories
from physx_core.dataset.read.shuffling import key_of, scramble
from physx_core.errors import ConfigError
from physx_core.typing import Index
from physx_core.views.options import ViewOptions

Part: TypeAlias = Literal["training", "validation", "test", "all"]


def choose_part(view: ViewOptions, part: Part, found: Trajectories) -> Trajectories:
    """Return those trajectories that are in a part of a view.

    Of fewer trajectories than folds, the folds are pieces of each: fold 0 is its end, fold 1 what
    is before that, and so on.

    Args:
        view: Divides them.
        part: The part.
        found: All trajectories.
    """
    held = view.held
    if part == "all" or (part == "training" and held == dict.fromkeys(held)):
        return found
    if part != "training" and held[part] is None:
        name = {"validation": "hold_back", "test": "test_fold"}[part]
        raise ConfigError(f"The view holds nothing back for the part {part!r}: set View.{name}.")
    back = {fold for fold in held.values() if fold is not None}
    wanted = {fold for fold in range(view.folds)
              if (fold not in back if part == "training" else fold == held[part])}  # fmt: skip
    if len(found.rows) < view.folds:
        return _pieces(found, view.folds, wanted)
    folds = folds_of(found.campaign, found.episode, view.folds, view.fold_seed)
    return found.take(np.isin(folds, list(wanted)))


def folds_of(campaign: Index, number: Index, folds: int, seed: int) -> Index:
    """Return the fold of each trajectory: of `folds` consecutive numbers, each has another one.

    Args:
        campaign: Number of its campaign, shape (n,).
        number: Its number in the campaign, shape (n,).
        folds: Number of folds.
        seed: Seed of the order in each group of `folds` numbers.
    """
    found = np.zeros(len(number), np.intp)
    for each in np.unique(campaign).tolist():
        own = np.flatnonzero(campaign == each)
        groups, places = np.divmod(number[own], folds)
        known, group = np.unique(groups, return_inverse=True)
        numbers = (known[:, None] * folds + np.arange(folds)).astype(np.uint64)
        hashed = scramble(numbers.ravel(), key_of(seed, each + 1, folds)).reshape(numbers.shape)
        found[own] = hashed.argsort(axis=1).argsort(axis=1)[group, places]
    return found


def _pieces(found: Trajectories, folds: int, wanted: set[int]) -> Trajectories:
    """Return some of the pieces of each trajectory; those that follow one another as one."""
    size = found.rows // folds
    ends = [found.rows - fold * size for fold in range(folds)] + [np.zeros_like(size)]
    which, start, rows = [], [], []
    if not wanted:
        return found.take(np.zeros(0, np.intp))
    for is_wanted, run in itertools.groupby(range(folds), wanted.__contains__):
        pieces = list(run)
        if is_wanted:
            begin = ends[pieces[-1] + 1]
            which.append(np.arange(len(size)))
            start.append(found.start + begin)
            rows.append(ends[pieces[0]] - begin)
    place = np.concatenate(which)
    order = np.lexsort((np.concatenate(start), place))
    chosen = found.take(place[order])
    return chosen._replace(start=np.concatenate(start)[order], rows=np.concatenate(rows)[order])
