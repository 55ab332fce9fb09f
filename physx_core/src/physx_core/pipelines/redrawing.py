"""Redrawing: draws stored rows again, with the environment that generated them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.closeable import Closeable
from physx_core.components.hand import HAND
from physx_core.components.scene.event import Event
from physx_core.config import EnvironmentConfig, from_plain
from physx_core.dataset import Dataset
from physx_core.errors import DatasetError, UsageError
from physx_core.net.values import decode
from physx_core.pipelines.campaign import recorded_campaigns
from physx_core.pipelines.generation import Generation
from physx_core.pipelines.pipeline import derive_seed
from physx_core.pipelines.replay import recorded_environment
from physx_core.pipelines.services import Predict, RunServices, Show, Touch
from physx_core.pipelines.storage import STREAMS
from physx_core.pipelines.stored_streams import states_of
from physx_core.typing import Sample
from physx_core.workers.instance import Instance, instance_arguments
from physx_core.workers.pasts import Past


class Redrawing(Closeable):
    """Draws stored rows again, with the environment that generated them, in this process.

    The environment simulates them again: independent episodes by their numbers, the others from the
    last state that their stream has left before, or from its beginning. Each row is compared with
    the stored one, bit by bit, so that nothing else is drawn in its place. Nothing is stored.

    Attributes:
        takes_predictions: Whether the environment has got predictions, as it defines
            `Environment.apply_prediction`; then it draws them itself.
        compared: Number of rows that were simulated again, and are equal to the stored ones.
    """

    def __init__(
        self,
        dataset: Dataset,
        mode: str,
        *,
        trust: bool = False,
        predict: Predict | None = None,
        patience: float | None = 60.0,
    ) -> None:
        """Find out what generated the rows.

        Args:
            dataset: The dataset.
            mode: The mode of the rows.
            trust: Whether to import whatever code the dataset names.
            predict: Answers the environment that asks a network; None: there is none.
            patience: How long the environment may take, in s; None: any time.

        Raises:
            UntrustedReferenceError: If the environment is code that is not trusted.
            ConfigError: If the dataset does not name its environment.
        """
        self._dataset, self._mode = dataset, mode
        self._predict, self._patience = predict, patience
        self._events: list[Event] = []
        self._instance: Instance | None = None
        self._episodes = dataset.recorded_episodes(mode)
        self._streams = Generation.find(dataset.info, STREAMS)
        described: Mapping[str, Any] = dataset.info
        if self._episodes is None and self._streams is not None:
            known = self._streams.environment.items()
            described = {name: value for name, value in known if value is not None}
        self._config = from_plain(
            EnvironmentConfig, recorded_environment(dataset, trust=trust, info=described)
        )
        self.takes_predictions, self.compared = False, 0
        self._rows, self._at = range(0), 0  # of the episode or stream, and the next of them

    def frames(
        self, rows: Sequence[int], predict: Callable[[int], Sample | None] | None = None
    ) -> Iterator[list[Event]]:
        """Yield what the environment has drawn since the last of some rows, for each of them.

        Args:
            rows: Numbers of rows in the mode, ascending; of streams, those of one instance.
            predict: Returns the prediction for a row, in physical units, or None if there is none;
                the environment gets it if it defines `Environment.apply_prediction`.

        Raises:
            PhysxError: If the environment fails, takes too long, or makes other rows.
        """
        begin = time.monotonic()
        steps = self._numbers(rows) if self._is_numbered(rows) else self._stream(rows)
        wanted = set(rows)
        for row, sample in steps:
            if self._patience is not None and time.monotonic() - begin > self._patience:
                raise UsageError(
                    f"to simulate these rows again takes longer than {self._patience:g} s"
                )
            self.compare(row, sample)
            self.compared += 1
            if predict is not None:
                self._apply(predict(row))
            if row in wanted:
                yield self._take_events()

    def go_on(self, rows: int) -> Iterator[tuple[Sample, list[Event]]]:
        """Simulate rows after the last one of `frames`, as long as its episode lasts.

        Args:
            rows: Largest number of rows.

        Yields:
            The data of each row, which is compared with nothing, and what was drawn.

        Raises:
            PhysxError: If the environment fails.
        """
        instance = self.instance
        for _ in range(rows):
            if not (sample := self._step(instance)):
                return
            yield sample, self._take_events()

    @property
    def instance(self) -> Instance:
        """The environment at the last row of `frames`, or before the next one of `go_on`.

        Raises:
            UsageError: If no row was simulated.
        """
        if self._instance is None:
            raise UsageError("No row was simulated.")
        return self._instance

    def around(self, row: int) -> tuple[list[int], list[int]]:
        """Return the rows of a row's episode, or of its stream: to that row, and after it.

        Raises:
            DatasetError: If there is no such row.
        """
        stored = self._dataset.num_samples(self._mode)
        if not 0 <= row < stored:
            raise DatasetError(
                f"There is no row {row} in the mode {self._mode}: it has {stored:,} rows, from 0."
            )
        if self._is_numbered([row]):
            known, entry = self._episodes, self._entry(row)
            assert known is not None
            if known.numbers[entry] > 1:
                return [row], []
            begin, end, step = int(known.first[entry]), int(known.rows[entry]), 1
            end += begin
        else:
            begin, step = self._place(row)
            end = stored
        return list(range(begin, row + 1, step)), list(range(row + step, end, step))

    def shown(self, rows: Sequence[int], most: int) -> Sequence[int]:
        """Return the last ones of a row's episode or stream that `frames` simulates quickly.

        Args:
            rows: The rows to that row.
            most: Largest number.

        Returns:
            That many, but those after a state, if their stream has left one among them only.
        """
        last = rows[-most:]
        if not self._is_numbered(last) and not self._state_before(last[0])[1]:
            begin = self._state_before(rows[-1])[0]
            return [row for row in last if row >= begin]
        return last

    def _state_before(self, row: int) -> tuple[int, bytes]:
        """Return the row from which a stream can go on to a row, and the state there, if any."""
        begin, count = self._place(row)
        streams = self._streams
        assert streams is not None
        number, before = begin - streams.first + 1, (row - begin) // count
        files = states_of(streams, self._dataset.directory.parent)
        found = files.read(lambda of, past: of == number and past.rows <= before)
        past = found.get(number, Past())
        return begin + past.rows * count, past.state

    def _take_events(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        """Close the environment."""
        instance, self._instance = self._instance, None
        if instance is not None:
            instance.close()

    def _apply(self, prediction: Sample | None) -> None:
        instance = self._instance
        if prediction is not None and instance is not None and not instance.ignores_predictions:
            self.takes_predictions = True
            instance.apply(prediction)

    def _is_numbered(self, rows: Sequence[int]) -> bool:
        """Return whether rows are of independent episodes."""
        known = self._episodes
        return known is not None and known.episode[self._entry(rows[0])] >= 0

    def _entry(self, row: int) -> int:
        """Return the number of the record of a row's episode."""
        known = self._episodes
        assert known is not None
        return int(np.where((known.rows > 0) & (known.first <= row), known.first, -1).argmax())

    def _open(self, number: int, seed: Sequence[int]) -> Instance:
        """Return an instance that draws; the events are kept."""
        if self._instance is None:
            folder = self._dataset.directory
            arguments = instance_arguments(self._config, number, seed, False)
            arguments["hand"] = HAND in self._dataset[self._mode]
            instance = self._instance = Instance(**arguments)
            services = _Drawing(folder, self._show, self._predict, lambda _: self._done())
            instance.open(services, draw=True, with_states=self._episodes is None)
        return self._instance

    def _done(self) -> Sequence[float]:
        """Return what a person did before the next row; nothing if none is stored."""
        if self._at >= len(self._rows):
            return ()
        done = np.asarray(self._dataset[self._mode][HAND][self._rows[self._at]])
        told: list[float] = done.tolist()
        return told

    def _show(self, instance_id: int, step: int, events: list[Event]) -> None:
        self._events += events

    def _numbers(self, rows: Sequence[int]) -> Iterator[tuple[int, Sample]]:
        """Simulate the episodes of rows; yield all rows up to the last of each, and their data."""
        known, last = self._episodes, -1
        assert known is not None
        campaigns = [each for each in recorded_campaigns(self._dataset) if each.mode == self._mode]
        for row in rows:
            if row <= last:
                continue
            entry = self._entry(row)
            of = int(known.campaign[entry])
            if of >= len(campaigns):
                raise DatasetError(f"{self._dataset.directory} does not say what made row {row}.")
            instance = self._open(1, campaigns[of].seed)
            first, number = int(known.first[entry]), int(known.episode[entry])
            if known.numbers[entry] > 1:
                first, number = row, number + row - first
            names = [parameter.name for parameter in instance.parameters]
            values = {n: self._dataset.episode_values(self._mode, n, first)[0] for n in names}
            instance.begin(number, values)
            end = max(each for each in rows if self._entry(each) == entry)
            end = row if known.numbers[entry] > 1 else end
            count = 1 if known.numbers[entry] > 1 else int(known.rows[entry])
            self._rows, self._at = range(first, first + count), 0
            for last in range(first, end + 1):
                yield last, self._step(instance)

    def _stream(self, rows: Sequence[int]) -> Iterator[tuple[int, Sample]]:
        """Simulate the stream of rows; yield all of them up to the last, and their data."""
        begin, count = self._place(rows[0])
        streams = self._streams
        assert streams is not None
        seed = derive_seed(streams.seed, self._mode, streams.offset)
        instance = self._open(begin - streams.first + 1, seed)
        start, state = self._state_before(rows[0])
        if state:
            instance.set_state(decode(state)["instance"])
        self._rows, self._at = range(start, self._dataset.num_samples(self._mode), count), 0
        for row in range(start, rows[-1] + 1, count):
            yield row, self._step(instance)

    def _step(self, instance: Instance) -> Sample:
        sample = instance.step()
        self._at += 1
        return sample

    def _place(self, row: int) -> tuple[int, int]:
        """Return the first row of a row's stream, and the number of rows from one to the next."""
        streams = self._streams
        if streams is None or streams.mode != self._mode or row < streams.first:
            raise UsageError("the dataset does not say how these rows were generated")
        count = self._config.num_clients
        return streams.first + (row - streams.first) % count, count

    def compare(self, row: int, sample: Sample) -> None:
        """Check that what was simulated is a stored row.

        Raises:
            UsageError: If it is not, in any bit.
        """
        stored = self._dataset[self._mode]
        for name, value in sample.items():
            known = np.asarray(stored[name][row])
            if not np.array_equal(np.asarray(value, known.dtype).reshape(known.shape), known):
                raise UsageError(
                    f'simulated again, row {row} has another "{name}": the environment, its '
                    "engine or a library has changed, or it takes random numbers of its own"
                )


class _Drawing(RunServices):
    """Answers an environment that draws: what was saved in its run is there, nothing is stored."""

    def __init__(self, folder: Path, show: Show, predict: Predict | None, touch: Touch) -> None:
        super().__init__(folder, show, predict, touch=touch)
        self._saved: dict[int, dict[str, Any]] = {}

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep values."""
        self._saved[instance_id] = {**self._saved.get(instance_id, {}), **values}

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return what was saved, by the run that made the rows if it is not new."""
        with contextlib.suppress(KeyError):
            return dict(self._saved[instance_id])
        return super().load_parameters(instance_id)
