"""RunServices: answers the requests that environments make to their pipeline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from physx_core import files
from physx_core.components.scene.event import Event
from physx_core.errors import ConnectionRefusedByPeerError, DatasetError, UsageError
from physx_core.net.values import decode, encode
from physx_core.pipelines.saved_parameters import LARGEST_PARAMETERS, PARAMETERS
from physx_core.typing import Batch, Sample

Predict: TypeAlias = Callable[[Batch], Batch]
"""The network's prediction for a batch, both in physical units."""
Touch: TypeAlias = Callable[[int], Sequence[float]]
"""What a person does to an instance: see `Observer.touch`."""
Show: TypeAlias = Callable[[int, int, list[Event]], None]
"""Receives an instance, its step, and its drawing events."""


class RunServices:
    """Serves requests from environments; clients send theirs through the server."""

    def __init__(
        self,
        dataset_dir: Path,
        show: Show,
        predict: Predict | None,
        source_dir: Path | None = None,
        touch: Touch | None = None,
    ) -> None:
        """Keep the receivers of the requests.

        Args:
            dataset_dir: Folder for the instances' parameters.
            show: Receives drawing events.
            predict: The network's prediction; None: the pipeline has no network.
            source_dir: Folder of a read-only dataset, searched for parameters that are not in
                `dataset_dir`.
            touch: What a person does to an instance; None: there is nobody.
        """
        self._touch = touch
        self._dir, self._source_dir = dataset_dir, source_dir
        self._show = show
        self._predict = predict

    def predict(self, fields: Sample) -> Sample:
        """Return the prediction for one sample."""
        batch = {name: np.asarray(value)[np.newaxis] for name, value in fields.items()}
        return {name: values[0] for name, values in self.predict_batch(batch).items()}

    def predict_batch(self, batch: Batch) -> Batch:
        """Return the prediction for several samples."""
        if self._predict is None:
            raise UsageError(
                "get_prediction() needs a network, but this run has none. "
                "It works in training and prediction."
            )
        return self._predict(batch)

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does to an instance."""
        return () if self._touch is None else self._touch(instance_id)

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Save an instance's values next to the dataset; earlier values of other names are kept.

        Raises:
            UsageError: If the values are those of all instances (0), and there are other ones.
        """
        path = self._dir / PARAMETERS.format(instance_id)
        known = self.load_parameters(instance_id)
        for name in known.keys() & values.keys() if not instance_id else ():
            if encode(known[name]) != encode(values[name]):
                raise UsageError(
                    f'save_parameters() got another value of "{name}" than an instance saved '
                    "before, but independent episodes may be simulated by any of them: save what "
                    "is the same in all."
                )
        content = encode({**known, **values})
        with files.storing(str(path)):
            path.parent.mkdir(parents=True, exist_ok=True)
            files.replace(path, content)

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that an instance saved."""
        values: dict[str, Any] = {}
        for place in (self._source_dir, self._dir):
            path = place / PARAMETERS.format(instance_id) if place is not None else None
            if path is not None and path.exists():
                values |= _read_parameters(path)
        return values

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Pass drawing events to the observers."""
        self._show(instance_id, step, events)


def _read_parameters(path: Path) -> dict[str, Any]:
    """Return the values in a file, which may belong to an untrusted dataset."""
    try:
        values = decode(files.read_content(path, LARGEST_PARAMETERS))
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error}.") from error
    except ConnectionRefusedByPeerError as error:
        raise DatasetError(f"{path} is damaged: {error}") from error
    if not isinstance(values, dict):
        raise DatasetError(f"{path} is damaged: it does not hold parameters by name.")
    return values
