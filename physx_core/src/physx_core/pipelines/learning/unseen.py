"""Opens a trained network beside the samples that it has not learned from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from physx_core import checkpoint
from physx_core.dataset import Dataset
from physx_core.errors import UsageError
from physx_core.pipelines.learning.data_record import open_data, training_view, unseen_parts
from physx_core.pipelines.learning.learner import Learner
from physx_core.pipelines.learning.loading import load_learner
from physx_core.typing import Batch
from physx_core.views.batches import Batches
from physx_core.views.view import View

_BATCH = 256


@dataclass(frozen=True, eq=False)
class Unseen:
    """A trained network, and the samples that it has not learned from.

    Attributes:
        learner: The network.
        parts: Batches of these samples, in the order of writing: "validation", "test", or "other"
            ones that another dataset has.
        has_mode: Whether the samples for validation are a mode of their own.
    """

    learner: Learner
    parts: dict[str, Batches]
    has_mode: bool
    _opened: contextlib.ExitStack
    _training: partial[Batches]

    def compare(self, batch: Batch) -> tuple[Batch, Batch]:
        """Return predictions for a batch, and the true values, both by the names of the latter."""
        return self.learner.compare(batch, _BATCH)

    @cached_property
    def training(self) -> Batches:
        """Batches of the samples that it learned from.

        Raises:
            DatasetError: If they are not there any more.
        """
        return self._opened.enter_context(self._training())


@contextlib.contextmanager
def open_unseen(
    session: str | Path,
    data: str | Path | None = None,
    *,
    mode: str | None = None,
    trust: bool = False,
) -> Iterator[Unseen]:
    """Open the last network of a session, and samples that it has not learned from.

    Those that were held back are the rows that there were when it was trained.

    Args:
        session: The session's folder.
        data: Another dataset, all of whose samples are taken; None: those that were held back.
        mode: Their mode in another dataset; None: that of the training.
        trust: Whether to import whatever code the checkpoint names.

    Raises:
        CheckpointError: If there is no network, or it is damaged.
        UntrustedReferenceError: If it names code that is not trusted.
        DatasetError: If the samples are not there any more.
        UsageError: If the network learned from the other dataset.
    """
    place = Path(session)
    learner = load_learner(place, trust=trust)
    taken = checkpoint.find(place, None, -1).progress.snapshots
    names = dict.fromkeys((*learner.network.net_fields, *learner.network.opt_fields))
    with open_data(place) as (datasets, config), contextlib.ExitStack() as opened:
        info = next(iter(datasets.values())).info
        has_mode = "validation" in taken
        view = training_view(config, info, has_validation=has_mode)
        wanted: dict[str, tuple[str, View, Any]] = {}
        own, snapshots = datasets.get(""), taken
        if data is None:
            wanted |= unseen_parts(view, config.mode, has_mode=has_mode)
        else:
            own, snapshots = opened.enter_context(Dataset.open(data)), {}
            _check_other(own, datasets, mode or config.mode, taken)
            plain = replace(view, sources={}, order="stored", weights=None, drop_last=False)
            wanted["other"] = mode or config.mode, plain, "all"
        read = partial(Batches, fields=list(names), dtype=learner.config.data_type)
        parts = {
            name: opened.enter_context(
                read(
                    chosen, _BATCH, data=own, mode=of, part=part, snapshot=snapshots.get(of)
                )
            )
            for name, (of, chosen, part) in wanted.items()
        }  # fmt: skip
        training = partial(
            read, view, _BATCH, data=datasets.get(""), mode=config.mode,
            snapshot=taken.get(config.mode),
        )  # fmt: skip
        known = {name: each for name, each in parts.items() if each.num_items}
        yield Unseen(learner, known, has_mode, opened, training)


def _check_other(
    other: Dataset, datasets: dict[str, Dataset], mode: str, taken: dict[str, Any]
) -> None:
    """Check that a network has learned nothing from the samples of a mode."""
    learned = [each.directory.resolve() for each in datasets.values()]
    if other.directory.resolve() in learned and mode in taken:
        raise UsageError(
            f"The network was trained with the mode {mode} of {other.directory}: leave the dataset "
            "out to evaluate it on the samples that were held back, or name another mode."
        )
