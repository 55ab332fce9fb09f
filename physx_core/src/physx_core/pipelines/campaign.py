"""Campaign: which episodes of an environment a dataset holds, and which are missing."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np

from physx_core.config import EnvironmentConfig
from physx_core.dataset import Dataset, EpisodeStatus
from physx_core.errors import ConfigError, DatasetError
from physx_core.pipelines.pipeline import choose_seed, derive_seed
from physx_core.pipelines.storage import describe_environment
from physx_core.typing import Index

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
        environment: Describes the environment, with the seed: see `describe_environment`.
    """

    mode: str
    number: int
    environment: dict[str, Any]

    @property
    def seed(self) -> list[int]:
        """The seed of its episodes."""
        return derive_seed(self.environment["seed"], self.mode, self.number)

    @classmethod
    def begin(cls, dataset: Dataset, mode: str, config: EnvironmentConfig) -> Self:
        """Return a new campaign, recorded in a dataset.

        Args:
            dataset: The dataset, open for writing.
            mode: Mode of the rows.
            config: The environment; its seed is random if it is None.
        """
        known = _recorded(dataset)
        number = sum(each.mode == mode for each in known)
        described = describe_environment(config, choose_seed(config.seed))
        campaign = cls(mode, number, described)
        recorded = [asdict(each) for each in known]
        dataset.update_info(**{CAMPAIGNS: [*recorded, asdict(campaign)]})
        return campaign

    @classmethod
    def last(cls, dataset: Dataset, mode: str, config: EnvironmentConfig) -> Self:
        """Return the last campaign of a mode, which a configuration continues.

        Raises:
            ConfigError: If there is none, or its episodes would have other rows.
        """
        known = [each for each in _recorded(dataset) if each.mode == mode]
        if not known:
            raise ConfigError(
                f'{dataset.directory} has no episodes of the mode "{mode}" to go on with: leave '
                "resume out."
            )
        former = known[-1]
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
        return cls(former.mode, former.number, former.environment)

    def simulated(self, dataset: Dataset) -> Index:
        """Return the numbers that have ended, shape (n,), without those that were cut."""
        known = dataset.recorded_episodes(self.mode) if self.mode in dataset.modes else None
        if known is None:
            return np.zeros(0, np.int64)
        ended = (known.status == EpisodeStatus.FINISHED) | (known.status == EpisodeStatus.FAILED)
        chosen = ended & (known.campaign == self.number)
        first, count = known.episode[chosen], known.numbers[chosen]
        begins = np.repeat(first - np.cumsum(count) + count, count)
        return begins + np.arange(count.sum())


def _recorded(dataset: Dataset) -> list[Campaign]:
    try:
        return [Campaign(**each) for each in dataset.info.get(CAMPAIGNS, ())]
    except TypeError as error:
        raise DatasetError(
            f"{dataset.directory} does not say which campaigns it holds: {error}."
        ) from error
