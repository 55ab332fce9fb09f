"""Opens a trained network beside the samples that it has not learned from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from physx_core import checkpoint
from physx_core.pipelines.learning.data_record import open_data, training_view, unseen_parts
from physx_core.pipelines.learning.learner import Learner, load_learner
from physx_core.typing import Batch
from physx_core.views.batches import Batches

_BATCH = 256


@dataclass(frozen=True, eq=False)
class Unseen:
    """A trained network, and the samples that it has not learned from.

    Attributes:
        learner: The network.
        parts: Batches of these samples, in the order of writing: "validation", "test".
    """

    learner: Learner
    parts: dict[str, Batches]

    def compare(self, batch: Batch) -> tuple[Batch, Batch]:
        """Return predictions for a batch, and the true values, both by the names of the latter."""
        return self.learner.compare(batch, _BATCH)


@contextlib.contextmanager
def open_unseen(session: str | Path, *, trust: bool = False) -> Iterator[Unseen]:
    """Open the last network of a session, and the samples that it has not learned from.

    They are the rows that there were when it was trained.

    Args:
        session: The session's folder.
        trust: Whether to import whatever code the checkpoint names.

    Raises:
        CheckpointError: If there is no network, or it is damaged.
        UntrustedReferenceError: If it names code that is not trusted.
        DatasetError: If the samples are not there any more.
    """
    place = Path(session)
    learner = load_learner(place, trust=trust)
    taken = checkpoint.find(place, None, -1).progress.snapshots
    names = dict.fromkeys((*learner.network.net_fields, *learner.network.opt_fields))
    with open_data(place) as (datasets, config), contextlib.ExitStack() as opened:
        own = datasets.get("")
        info = next(iter(datasets.values())).info
        has_mode = "validation" in taken
        view = training_view(config, info, has_validation=has_mode)
        wanted = unseen_parts(view, config.mode, has_mode=has_mode)
        parts = {
            name: opened.enter_context(
                Batches(
                    chosen,
                    _BATCH,
                    data=own,
                    mode=mode,
                    part=part,
                    snapshot=taken.get(mode),
                    fields=list(names),
                    dtype=learner.config.data_type,
                )
            )
            for name, (mode, chosen, part) in wanted.items()
        }
        yield Unseen(learner, {name: each for name, each in parts.items() if each.num_items})
