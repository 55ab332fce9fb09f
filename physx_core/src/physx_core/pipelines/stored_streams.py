"""StoredStreams: the streams of a data generation, which go on in a run that is resumed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from physx_core.closeable import Closeable
from physx_core.components.hand import HAND
from physx_core.config import EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.pipelines.generation import Generation
from physx_core.pipelines.saved_parameters import end_without_rows
from physx_core.pipelines.services import Touch
from physx_core.pipelines.storage import STREAMS, describe_environment, last_steps
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.workers.pasts import NOTHING, PastFiles

_ADVICE = "Start another run for more of them."


def states_of(streams: Generation, session: Path) -> PastFiles:
    """Return the last states of streams, which are in the folder of their session."""
    return PastFiles(session / "states", streams.name)


class StoredStreams(Closeable):
    """What is stored of streams: their rows in the dataset, and their last states beside it.

    Attributes:
        skip: What an earlier run has stored.
        earlier: Step of the last stored row of each instance.
    """

    def __init__(
        self,
        session: Session,
        dataset: Dataset,
        mode: str,
        config: EnvironmentConfig,
        seed: int,
        offset: int,
        former: Generation | None,
        needed: int,
    ) -> None:
        """Find out what is stored, and check that the rows go on.

        Args:
            session: Where the states are kept.
            dataset: The session's dataset, open for writing.
            mode: Mode of the rows.
            config: The environment.
            seed: Seed of the run.
            offset: From what the seed of the streams is derived, besides.
            former: The streams to go on with; None: they begin.
            needed: Total number of rows.

        Raises:
            ConfigError: If they cannot go on with this configuration.
        """
        described = describe_environment(config, seed if config.seed is None else config.seed)
        now = replace(Generation.begin(STREAMS, dataset, mode, seed, described), offset=offset)
        known = former or now
        self._files = states_of(known, session.path)
        self.skip, self.earlier = NOTHING, dict[int, int]()
        self._dataset, self._mode = dataset, mode
        self._first, self._count = known.first, config.num_clients
        self._new = now if former is None else None
        if former is None:
            now.keep_parameters(dataset)
            return
        count = self._count
        self.skip = skip = former.resume(dataset, config, now, needed, _ADVICE)
        if skip.rows < needed:
            former.restore_parameters(dataset)
        stop = former.first + skip.rows
        self.earlier = last_steps(dataset, mode, former.first, stop, count)
        if config.state_every:
            pasts = self._files.read(lambda number, past: skip.covers(number, past, count))
            self.skip = skip._replace(pasts=pasts)

    @staticmethod
    def find(dataset: Dataset, mode: str, *, others: bool) -> Generation | None:
        """Return the description of the streams of a mode with which a run can go on.

        Args:
            dataset: Contains them.
            mode: The mode.
            others: Whether there are independent episodes, too: what was generated last goes on.
        """
        former = Generation.find(dataset.info, STREAMS)
        if former is None or former.mode != mode or (others and former.ended is not None):
            return None
        return former

    def begin(self) -> None:
        """Record what the rows depend on, just before the first of them is stored."""
        new, self._new = self._new, None
        if new is not None:
            self._files.clear()
            new.start(self._dataset)

    def touched(self, touch: Touch) -> Touch:
        """Return what a person did before rows that are repeated, and does before others.

        Args:
            touch: What a person does.
        """
        if not self.skip.rows or HAND not in self._dataset[self._mode]:
            return touch
        stored, count = self._dataset[self._mode][HAND], self._count
        rows = Counter({number: past.rows for number, past in self.skip.pasts.items()})

        def done(instance_id: int) -> Sequence[float]:
            row = rows[instance_id]
            rows[instance_id] += 1
            if row >= self.skip.rows_of(instance_id, count):
                return touch(instance_id)
            before: Sequence[float] = stored[self._first + row * count + instance_id - 1].tolist()
            return before

        return done

    def missing(self, wanted: int, size: int) -> int:
        """Return how many rows of a batch are not stored.

        Args:
            wanted: Number of rows up to its end.
            size: Its size.
        """
        return max(0, min(wanted - self.skip.rows, size))

    def keep(self, source: Source) -> None:
        """Keep the states up to the last batch, which is stored."""
        self._files.keep(source.take_pasts() or {})

    def close(self) -> None:
        """Write the last states, once the dataset is closed."""
        self._files.close()
        if self._new is not None:
            end_without_rows(self._dataset.directory)
