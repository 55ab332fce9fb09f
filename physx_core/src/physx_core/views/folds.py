"""Folds: which trajectories are held back, by their numbers, so that more of them move none."""

from __future__ import annotations

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

    Of streams with fewer trajectories than folds, the parts are pieces: the end of each is held
    back for validation, and what is before that for a test.

    Args:
        view: Divides them.
        part: The part.
        found: All trajectories.
    """
    held = {"validation": view.fold, "test": view.test_fold}
    if part == "all" or (part == "training" and held == dict.fromkeys(held)):
        return found
    if part != "training" and held[part] is None:
        name = {"validation": "fold", "test": "test_fold"}[part]
        raise ConfigError(f"The view holds nothing back for the part {part!r}: set View.{name}.")
    if len(found.rows) < view.folds and (found.campaign < 0).all():
        return _pieces(view, part, found)
    folds = folds_of(found.campaign, found.episode, view.folds, view.fold_seed)
    if part == "training":
        chosen = ~np.isin(folds, [fold for fold in held.values() if fold is not None])
    else:
        chosen = folds == held[part]
    return found.take(chosen)


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


def _pieces(view: ViewOptions, part: Part, found: Trajectories) -> Trajectories:
    """Return the part of each trajectory."""
    size = found.rows // view.folds
    end = found.rows - size * (view.fold is not None)
    before = end - size * (view.test_fold is not None)
    begin, stop = {
        "training": (np.zeros_like(end), before),
        "validation": (end, found.rows),
        "test": (before, end),
    }[part]
    return found._replace(start=found.start + begin, rows=stop - begin)
