"""Campaign: which episodes of an environment a dataset holds, and which are missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.config import WRONG, EnvironmentConfig
from physx_core.dataset import Dataset, EpisodeRecord, EpisodeStatus
from physx_core.errors import ConfigError, DatasetError, listed
from physx_core.fields import Field
from physx_core.pipelines.storage import describe_environment
from physx_core.typing import Batch, Index
from physx_core.workers.lease import Lease
from physx_core.workers.parameter_sets import ParameterSets

CAMPAIGNS = "campaigns"
"""Entry in a dataset's info: what its campaigns simulated, in order."""
_SAME = (
    *("environment", "env_kwargs", "independent_episodes", "episode_steps"),
    *("simulations_per_step", "sampler", "sampler_kwargs", "seed"),
)
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
        return sum(each.mode == mode for each in _recorded(dataset))

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
        campaign, numbers = _recorded(dataset).index(self), rows["episode"]
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
        known, number = _recorded(dataset), cls.count(dataset, mode)
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
        known = [each for each in _recorded(dataset) if each.mode == mode]
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

    def simulated(self, dataset: Dataset, *, failed: bool = True) -> Index:
        """Return the numbers that have ended, shape (n,), without those that were cut.

        Args:
            dataset: The dataset.
            failed: Whether those that failed are among them.
        """
        first, count, _ = self._ended(dataset, failed)
        begins = np.repeat(first - np.cumsum(count) + count, count)
        return begins + np.arange(count.sum())

    def records(self, dataset: Dataset, *, failed: bool = True) -> list[EpisodeRecord]:
        """Return what is recorded of those numbers: see `simulated`."""
        columns = (each.tolist() for each in self._ended(dataset, failed))
        return [EpisodeRecord(episode=e, count=n, rows=r) for e, n, r in zip(*columns, strict=True)]

    def _ended(self, dataset: Dataset, failed: bool) -> tuple[Index, Index, Index]:
        """Return the first number, the number of episodes and that of rows of each entry."""
        known = dataset.recorded_episodes(self.mode) if self.mode in dataset.modes else None
        if known is None:
            return (np.zeros(0, np.int64),) * 3
        status = [EpisodeStatus.FINISHED, *([EpisodeStatus.FAILED] if failed else [])]
        chosen = np.isin(known.status, status) & (known.campaign == self.number)
        return known.episode[chosen], known.numbers[chosen], known.rows[chosen]

    def cut(self, dataset: Dataset, surplus: int, sets: ParameterSets) -> None:
        """Leave out the last rows: the episodes that they belong to are recorded as cut.

        Args:
            dataset: The dataset, open for writing.
            surplus: How many rows to leave out.
            sets: Chooses the parameters of each number.
        """
        known = dataset.recorded_episodes(self.mode)
        assert known is not None
        columns = known.first, known.rows, known.episode, known.numbers
        own = np.flatnonzero((known.campaign == self.number) & (known.rows > 0))
        for place in own[::-1].tolist():
            first, rows, number, count = (int(column[place]) for column in columns)
            left_out = min(surplus, rows)
            if count > 1:  # of one row each
                kept, cut = 0, range(number + count - left_out, number + count)
            else:
                kept, cut = rows - left_out, range(number, number + 1)
            lease = Lease(cut, sets.values_of(cut))
            names = dataset.episode_fields
            fields = {n: dataset.episode_values(self.mode, n, first)[0] for n in names}
            records = [
                EpisodeRecord(
                    episode=each,
                    rows=kept,
                    campaign=self.number,
                    status=EpisodeStatus.CUT,
                    parameters=lease.parameters(each, 1),
                    fields=fields,
                )
                for each in cut
            ]
            mode = dataset[self.mode]
            stored = {name: mode[name][first : first + kept] for name in mode} if kept else {}
            dataset.append_episodes(self.mode, stored, records, checked=True)
            surplus -= left_out
            if not surplus:
                return


def _plain(parameters: Sequence[Parameter]) -> Any:
    """Return parameters as a dataset's info has them."""
    return json.loads(json.dumps([each.to_dict() for each in parameters]))


def _recorded(dataset: Dataset) -> list[Campaign]:
    try:
        return [Campaign(**each) for each in dataset.info.get(CAMPAIGNS, ())]
    except TypeError as error:
        raise DatasetError(
            f"{dataset.directory} does not say which campaigns it holds: {error}."
        ) from error
