"""Campaign: which episodes of an environment a dataset holds, and which are missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.config import WRONG, EnvironmentConfig
from physx_core.dataset import Dataset, EpisodeRecord, EpisodeStatus
from physx_core.dataset.read.order.records import Flags, RecordedEpisodes
from physx_core.errors import ConfigError, DatasetError, listed
from physx_core.fields import Field
from physx_core.pipelines.storage import EPISODE_OPTIONS, describe_environment
from physx_core.typing import Batch
from physx_core.workers.row_queue import NONE_ENDED, Ended

CAMPAIGNS = "campaigns"
"""Entry in a dataset's info: what its campaigns simulated, in order."""
_SAME = (*EPISODE_OPTIONS, "state_every", "seed")
"""Entries of a description on which the rows of an episode depend."""


@dataclass(frozen=True)
class Campaign:
    """The episodes of one environment with one seed, numbered from 0.

    Attributes:
        mode: Mode of their rows.
        number: Number of the campaign in this mode, counted from 0.
        environment: Describes the environment, with the run's seed: see `describe_environment`.
        seed: Seed of its episodes.
    """

    mode: str
    number: int
    environment: dict[str, Any]
    seed: list[int]

    @staticmethod
    def count(dataset: Dataset, mode: str) -> int:
        """Return how many campaigns a mode of a dataset has."""
        return sum(each.mode == mode for each in recorded_campaigns(dataset))

    def store_rejected(
        self,
        dataset: Dataset,
        rows: Batch,
        records: Sequence[EpisodeRecord],
        episode_fields: Sequence[Field],
    ) -> None:
        """Store samples that `check_sample` rejected, by number.

        They are stored before the records of their episodes: if a run is killed in between, an
        episode is simulated again, and its samples replace these.

        Args:
            dataset: The dataset, open for writing, in which the mode has its fields.
            rows: The samples.
            records: Records of the episodes that they belong to, the last part of each last.
            episode_fields: What each episode has once.
        """
        campaign, numbers = recorded_campaigns(dataset).index(self), rows["episode"]
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        counts, found = np.diff(begins, append=len(numbers)).tolist(), []
        for number, count in zip(numbers[begins].tolist(), counts, strict=True):
            of = next(each for each in records[::-1] if 0 <= number - each.episode < each.count)
            where: Any = number - of.episode if of.count > 1 else ()
            values = {name: np.asarray(each)[where] for name, each in of.parameters.items()}
            own = {"episode": number, "rows": count, "campaign": campaign}
            found.append(EpisodeRecord(**own, parameters=values, fields=of.fields))
        dataset.append_episodes(WRONG, rows, found, episode_fields=episode_fields, checked=True)

    @classmethod
    def begin(
        cls,
        dataset: Dataset,
        mode: str,
        config: EnvironmentConfig,
        run_seed: int,
        seed: list[int],
        parameters: Sequence[Parameter],
    ) -> Self:
        """Return a new campaign, recorded in a dataset.

        Args:
            dataset: The dataset, open for writing.
            mode: Mode of the rows.
            config: The environment.
            run_seed: Seed of the run.
            seed: Seed of the episodes.
            parameters: The parameters that the environment defines.
        """
        known, number = recorded_campaigns(dataset), cls.count(dataset, mode)
        described = describe_environment(config, run_seed)
        described["parameters"] = _plain(parameters)
        campaign = cls(mode, number, described, seed)
        recorded = [asdict(each) for each in known]
        dataset.update_info(**{CAMPAIGNS: [*recorded, asdict(campaign)]})
        return campaign

    @classmethod
    def last(
        cls, dataset: Dataset, mode: str, config: EnvironmentConfig, number: int = -1
    ) -> Campaign:
        """Return a campaign of a mode, by default the last one, which a configuration continues.

        Raises:
            ConfigError: If there is none, or its episodes would have other rows.
        """
        known = [each for each in recorded_campaigns(dataset) if each.mode == mode]
        if not known:
            raise ConfigError(
                f'{dataset.directory} has no episodes of the mode "{mode}" to go on with: leave '
                "resume out."
            )
        former = known[number]
        seed = former.environment["seed"] if config.seed is None else config.seed
        now = describe_environment(config, seed)
        for name in _SAME:
            before, after = former.environment.get(name), now.get(name)
            if before != after:
                raise ConfigError(
                    f"The episodes of {dataset.directory} cannot be continued: {name} was "
                    f"{before!r} and is now {after!r}, so the rows of an episode would differ. Use "
                    "the same value, or leave resume out for other episodes."
                )
        return former

    def check_parameters(self, parameters: Sequence[Parameter]) -> None:
        """Check that the environment defines the same parameters as when the campaign began.

        Raises:
            ConfigError: If not, so that an episode would get other values.
        """
        before, now = self.environment["parameters"], _plain(parameters)
        if before == now:
            return
        changed = [each for each in before if each not in now]
        changed += [each for each in now if each not in before]
        names = sorted({each["name"] for each in changed or before})
        raise ConfigError(
            "The campaign cannot be continued: the environment's parameters have changed since it "
            f"began ({listed(names)}), so episodes would get other values. Restore their "
            "definitions, or leave resume out for other episodes."
        )

    def ended(self, dataset: Dataset, *, failed: bool = True) -> Ended:
        """Return the episodes that have ended, without those that were cut.

        Args:
            dataset: The dataset.
            failed: Whether those that failed are among them.
        """
        known = self._recorded_episodes(dataset)
        if known is None:
            return NONE_ENDED
        status = [EpisodeStatus.FINISHED, *([EpisodeStatus.FAILED] if failed else [])]
        chosen = np.isin(known.status, status) & self._are_own(known)
        return Ended(known.episode[chosen], known.numbers[chosen], known.rows[chosen])

    def rows(self, dataset: Dataset) -> int:
        """Return how many rows it has."""
        known = self._recorded_episodes(dataset)
        return 0 if known is None else int(known.rows[self._are_own(known)].sum())

    def _recorded_episodes(self, dataset: Dataset) -> RecordedEpisodes | None:
        return dataset.recorded_episodes(self.mode) if self.mode in dataset.modes else None

    def _are_own(self, known: RecordedEpisodes) -> Flags:
        """Return which of a mode's episodes are its own; a stream before it has its number."""
        own: Flags = (known.campaign == self.number) & (known.status != EpisodeStatus.STREAM)
        return own

    def cut(self, dataset: Dataset, rows: int) -> None:
        """Leave out what follows the first rows: the episodes there are recorded as cut.

        How many were simulated beyond these rows is up to chance, so nothing of them stays: no
        rows, no rejected samples, and not that they have failed.

        Args:
            dataset: The dataset, open for writing.
            rows: How many rows to keep.
        """
        known = self._recorded_episodes(dataset)
        if known is None:
            return
        own = np.flatnonzero(self._are_own(known))
        counts = known.rows[own]
        before = np.cumsum(counts) - counts
        kept = np.clip(rows - before, 0, counts)
        changes = (kept < counts) | ((before >= rows) & (known.status[own] != EpisodeStatus.CUT))
        entries = own[changes]
        recorded, own_fields = dataset.recorded_values(self.mode, entries), dataset.episode_fields
        records: list[EpisodeRecord] = []
        for place, (entry, stays) in enumerate(zip(entries, kept[changes].tolist(), strict=True)):
            record = EpisodeRecord(
                episode=int(known.episode[entry]),
                rows=0,
                campaign=self.number,
                status=EpisodeStatus.CUT,
                parameters={n: recorded[n][place] for n in recorded.keys() - own_fields.keys()},
                fields={name: recorded[name][place] for name in own_fields},
            )
            count = int(known.numbers[entry])
            if count == 1 and stays:
                self._shorten(dataset, replace(record, rows=stays), int(known.first[entry]))
                continue
            numbers = range(record.episode + stays, record.episode + count)  # of one row each
            records += (replace(record, episode=number) for number in numbers)
        if records:
            dataset.append_episodes(self.mode, {}, records, checked=True)
            self._drop_rejected(dataset, records)

    def _shorten(self, dataset: Dataset, record: EpisodeRecord, first: int) -> None:
        """Store the first rows of an episode again, as all that it has."""
        mode = dataset[self.mode]
        rows = {name: mode[name][first : first + record.rows] for name in mode}
        dataset.append_episodes(self.mode, rows, [record], checked=True)

    def _drop_rejected(self, dataset: Dataset, records: Sequence[EpisodeRecord]) -> None:
        """Leave out the rejected samples of some episodes."""
        known = dataset.recorded_episodes(WRONG) if WRONG in dataset.modes else None
        if known is None:
            return
        campaign = recorded_campaigns(dataset).index(self)
        numbers = set(known.episode[(known.campaign == campaign) & (known.rows > 0)].tolist())
        gone = [replace(each, campaign=campaign) for each in records if each.episode in numbers]
        if gone:
            dataset.append_episodes(WRONG, {}, gone, checked=True)


def _plain(parameters: Sequence[Parameter]) -> Any:
    """Return parameters as a dataset's info has them."""
    return json.loads(json.dumps([each.to_dict() for each in parameters]))


def recorded_campaigns(dataset: Dataset) -> list[Campaign]:
    """Return the campaigns of a dataset, of all modes, in order.

    Raises:
        DatasetError: If their description is damaged.
    """
    try:
        return [Campaign(**each) for each in dataset.info.get(CAMPAIGNS, ())]
    except TypeError as error:
        raise DatasetError(
            f"{dataset.directory} does not say which campaigns it holds: {error}."
        ) from error
