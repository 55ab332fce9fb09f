"""The section on what predictions look like, as their environment draws them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from physx_core import Batches
from physx_core.errors import PhysxError
from physx_core.pipelines import Redrawing, Unseen
from physx_core.results import EpisodeError, PartResult
from physx_core.typing import Array, Index, Sample
from physx_report import wording
from physx_report.blocks import Block, Picture, Text
from physx_report.film import MOST, Film, as_file, or_why_not, redraw
from physx_report.run import Run
from physx_report.scenes import Link
from physx_report.section import Section
from physx_report.sections.episodes import items_of

_SOUGHT = 16 * MOST
"""Number of samples among which those of one stream are sought."""
_NOTHING = (
    "Predictions are not drawn: nothing that the environment draws is a predicted field, moved or "
    "scaled. Environment.apply_prediction may draw them itself."
)


def _blocks(run: Run) -> Iterator[Block]:
    try:
        unseen = run.unseen
    except PhysxError:
        return  # the section on episodes says why
    if unseen is None or run.training is None:
        return
    parts = [name for name in ("test", *run.training.parts) if name in run.training.parts]
    name = next((each for each in parts if each in unseen.parts), None)
    if name is None or not run.training.parts[name].fields:
        return
    yield from or_why_not(_Films(run, unseen, name).blocks(run.training.parts[name]))


class _Films:
    """Draws episodes of a part of the samples."""

    def __init__(self, run: Run, unseen: Unseen, part: str) -> None:
        self._run, self._unseen, self._part = run, unseen, part
        self._batches: Batches = unseen.parts[part]
        batches = self._batches
        self._rows = np.concatenate([batches.rows(n)[0] for n in range(len(batches))])
        self._links: Sequence[Link] = ()

    def blocks(self, judged: PartResult) -> Iterator[Block]:
        """Yield a film of the median episode, and pictures of the best and the worst one."""
        is_joined = any(self._batches.fields[each].free_axis for each in judged.fields)
        if len(self._batches.datasets) > 1 or is_joined:
            return
        name, of = next(iter(judged.fields.items()))
        median = of.episodes.get("median")
        items = self._items(median)
        film = self._film(items)
        if not film.frames:
            return
        if not film.look:
            yield Text([_NOTHING])
            return
        self._links = film.links
        pictures = film.pictures(self._run.camera, range(len(film.frames)))
        whose = f"the median episode, {median.text}" if median and len(items) > 1 else "samples"
        told = f"{len(pictures)} rows, each predicted from its true inputs"
        yield Picture(as_file(pictures), f"Film of {whose} ({self._part}; {told}); {film.look}")
        for which in ("best", "worst"):
            if (episode := of.episodes.get(which)) is not None:
                yield from self._picture(name, which, episode, of.unit)

    def _picture(self, name: str, which: str, episode: EpisodeError, unit: str) -> Iterator[Block]:
        items = self._items(episode, alone=True)
        film = self._film(items)
        if not film.look:
            return
        errors = np.square(film.prediction[name] - film.truth[name]).reshape(len(film.frames), -1)
        row = int(errors.mean(axis=1).argmax())
        [picture] = film.pictures(self._run.camera, [row])
        error = wording.measured("rmse", episode.error, unit)
        where = f"at its largest error, row {row + 1} of {len(film.frames)}" if row else ""
        caption = f"{which.capitalize()} episode of {name}: {episode.text}, error {error}"
        yield Picture(
            as_file([picture]), f"{', '.join(filter(None, [caption, where]))}; {film.look}"
        )

    def _items(self, episode: EpisodeError | None, *, alone: bool = False) -> Index:
        """Return items of an episode, at equal distances; of one that has a single row, others too.

        Args:
            episode: The episode; None: the first items.
            alone: Whether there are to be no others.
        """
        items = items_of(self._rows, episode.about) if episode else self._rows[:0]
        if len(items) < 2 and not alone:
            items = np.arange(min(_SOUGHT, len(self._rows)))
            return np.asarray(items[self._of_one_stream(items)][:MOST])
        items = items[self._of_one_stream(items)]
        return np.asarray(items[np.unique(np.linspace(0, len(items) - 1, MOST).astype(int))])

    def _of_one_stream(self, items: Index) -> Array:
        """Return which items are of the same instance as the first one."""
        [dataset] = self._batches.datasets.values()
        if "env_id" not in dataset.fields(self._batches.mode) or not len(items):
            return np.ones(len(items), bool)
        column = dataset[self._batches.mode]["env_id"]
        owners = np.array([int(column[int(row)]) for row in self._rows[items]])
        return np.asarray(owners == owners[0])

    def _film(self, items: Index) -> Film:
        [dataset] = self._batches.datasets.values()
        batches = self._batches
        batch = batches.take(items)
        predicted, true = self._unseen.compare(batch)
        first = next(iter(true))
        offset = batches.window(first).at[0]
        names = [n for n in true if batches.window(n).at[0] == offset and true[n].dtype.kind == "f"]

        def values(of: Mapping[str, Array]) -> dict[str, Array]:
            return {n: of[n] if batches.window(n).is_single else of[n][:, 0] for n in names}

        rows = (self._rows[items] + offset).tolist()
        applied = self._applied(batch, rows) if not batches.view.windows else {}
        with Redrawing(dataset, batches.mode, trust=self._run.trust) as drawing:
            return redraw(drawing, rows, values(true), values(predicted), applied, self._links)

    def _applied(self, batch: Mapping[str, Array], rows: Sequence[int]) -> dict[int, Sample]:
        """Return what environments get of predictions, by row."""
        network = self._unseen.learner.network
        found = self._unseen.learner.predict({n: batch[n] for n in network.net_fields})
        return {
            row: {name: values[place] for name, values in found.items()}
            for place, row in enumerate(rows)
        }


SECTION = Section("What it looks like", _blocks, 18)
