"""CampaignWriter: simulates the missing episodes of a campaign, and stores them as they end."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from physx_core.config import WRONG
from physx_core.dataset import TABLE_FIELDS, Dataset, EpisodeRecord, EpisodeStatus
from physx_core.dataset.store.definitions import compare_fields
from physx_core.dataset.write.delegation import Delegation
from physx_core.errors import ConfigError, FailedEpisodesError
from physx_core.pipelines.campaign import Campaign
from physx_core.pipelines.independence import IndependenceProof
from physx_core.sources.episode_source import EpisodeSource
from physx_core.sources.source import Source
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock
from physx_core.workers.pasts import Past, PastFiles
from physx_core.workers.row_queue import RowQueue


class CampaignWriter:
    """Stores episodes in any order; the dataset's rows are those of its episodes in order.

    Attributes:
        campaign: The campaign.
        queue: The numbers that nobody has simulated yet.
        failed: Number of episodes that have failed in this run. Of those beyond the last row that
            is needed, of which there are more or fewer by chance, none counts.
    """

    def __init__(
        self,
        dataset: Dataset,
        campaign: Campaign,
        queue: EpisodeQueue,
        max_failed: int,
        *,
        keeps_rejected: bool,
        states: PastFiles | None,
    ) -> None:
        """Prepare; `open` gives it what simulates.

        Args:
            dataset: Stores the episodes; open for writing.
            campaign: The campaign.
            queue: The numbers that are missing.
            max_failed: How many episodes of this run may fail.
            keeps_rejected: Whether to store the samples that `check_sample` rejects.
            states: Keeps the states of episodes that have not ended; None: there are none.
        """
        self.campaign, self.queue, self.failed = campaign, queue, 0
        self._dataset, self._max_failed = dataset, max_failed
        self._keeps_rejected, self._states = keeps_rejected, states
        self._delegation: Delegation | None = None
        self._unsure: list[EpisodeRecord] = []  # failed, but perhaps not needed
        self._source: Source | None = None
        self._episodes: EpisodeSource | None = None
        self._proof = IndependenceProof()

    def open(self, source: Source, delegation: Delegation | None = None) -> None:
        """Simulate with open environments, whose episodes are independent.

        Args:
            source: The environments.
            delegation: Lets their clients write the rows; None: this process writes them.

        Raises:
            ConfigError: If they define other parameters than when the campaign began, or two names
                of what is recorded of an episode are the same.
            FieldsMismatchError: If the dataset's episodes have other fields of their own.
        """
        self.campaign.check_parameters(source.sets.parameters)
        self._check_episode_fields(source)
        self._delegation = delegation
        parameters = [each.field for each in source.sets.parameters]
        self._dataset.define_episodes(parameters, source.episode_fields)
        self._source, self._episodes = source, source.lease(self.queue)

    def _check_episode_fields(self, source: Source) -> None:
        """Check what is recorded of episodes before any is simulated."""
        names = [each.name for each in (*TABLE_FIELDS, *source.episode_fields)]
        names += [each.name for each in source.sets.parameters]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(
                f'The name "{twice[0]}" of a parameter, or of a field of episodes, is that of '
                "something else that is recorded of each episode: rename it."
            )
        if self._dataset.has_episodes:
            known, given = self._dataset.episode_fields, source.episode_fields
            own = {field.name: field for field in given}
            compare_fields(f"The table of episodes in {self._dataset.directory}", known, own)

    def store(self) -> int:
        """Store the episodes that end next; return how many have ended.

        Raises:
            FailedEpisodesError: If too many episodes have failed.
            PhysxError: If an environment or client fails in a way that concerns all episodes.
        """
        assert self._source is not None
        assert self._episodes is not None
        before, mode = self.queue.finished, self.campaign.mode
        block = self._episodes.take()
        self._proof.note(block)
        if mode not in self._dataset.modes:
            self._dataset.define_fields(mode, self._episodes.fields)
        records = [replace(record, campaign=self.campaign.number) for record in block.records]
        if block.rejected and self._keeps_rejected:
            self._dataset.define_fields(WRONG, self._episodes.fields)
            self.campaign.store_rejected(
                self._dataset, block.rejected, records, self._source.episode_fields
            )
        fields = self._source.episode_fields
        self._dataset.append_episodes(
            mode,
            block.rows,
            records,
            episode_fields=fields,
            checked=True,
            first_row=block.first_row,
        )
        if self._states is not None:
            self._keep_state(self._states, block)
        self._count_failed(record for record in records if record.status is EpisodeStatus.FAILED)
        return self.queue.finished - before

    def _keep_state(self, states: PastFiles, block: EpisodeBlock) -> None:
        """Keep the state that comes with rows, which are stored, and no state of what has ended."""
        for record in block.records:
            if record.status is not EpisodeStatus.MORE:
                states.forget(range(record.episode, record.episode + record.count))
        if block.state is not None:
            number, made, state = block.state
            states.keep({number: Past(made, state)})

    def _count_failed(self, failed: Iterable[EpisodeRecord]) -> None:
        """Count the failed episodes that are known to be needed.

        Raises:
            FailedEpisodesError: If there are too many.
        """
        needed: list[EpisodeRecord] = []
        unsure, self._unsure = [*self._unsure, *failed], []
        for record in unsure:
            (needed if self.queue.needs(record.episode) else self._unsure).append(record)
        self.failed += len(needed)
        if needed and self.failed > self._max_failed:
            raise FailedEpisodesError(self.failed, needed[-1].episode, needed[-1].reason)

    def store_rows(self, rows: int) -> None:
        """Store episodes until those before the first missing one have enough rows."""
        assert isinstance(self.queue, RowQueue)
        self.queue.goal = max(self.queue.goal, rows)
        while self.queue.rows < rows:
            self.store()

    def cut(self, rows: int) -> None:
        """Leave out what the campaign has more than some rows; nothing may be stored afterwards.

        When this returns, a kill of the process loses nothing of it.
        """
        if self._delegation is not None:
            self._delegation.close()
        if self._episodes is not None:
            self.campaign.cut(self._dataset, rows)
        self._dataset.flush()

    @property
    def rows(self) -> int:
        """How many rows the campaign has."""
        return self.campaign.rows(self._dataset)

    def prove_independence(self) -> None:
        """Simulate an episode again, if that costs little, and compare its rows.

        Raises:
            DependentEpisodeError: If they differ.
        """
        if self._episodes is not None:
            self._proof.check(
                self._episodes, self._dataset, self.campaign.mode, self.campaign.number
            )
