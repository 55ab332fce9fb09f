"""Answers: what environments in other processes ask of the run, handed to its services."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from physx_core.errors import PhysxError, UsageError
from physx_core.fields import Batch, Sample
from physx_core.interfaces.environment import Services
from physx_core.scene import Event
from physx_core.transport.failures import encode_error
from physx_core.transport.frames import Frame, Kind, pack
from physx_core.transport.peer import Peer
from physx_core.transport.values import decode, encode

Signature = tuple[tuple[str, tuple[int, ...], str], ...]


class Answers:
    """Answers requests; those for predictions are collected and answered together.

    Where the services have a method ``predict_batch(batch) -> batch``, requests of the same fields
    that wait at the same moment go through it as one batch. Otherwise each goes through `predict`.

    Attributes:
        batches: Whether requests for predictions go through the services as one batch.
    """

    def __init__(self, services: Services) -> None:
        """Keep the services.

        Args:
            services: What the environments may ask of the run.
        """
        self._services = services
        self._predict_batch: Callable[[Batch], Batch] | None = getattr(
            services, "predict_batch", None
        )
        self.batches = self._predict_batch is not None
        self._waiting: list[tuple[Peer, int, Sample]] = []

    @property
    def asking(self) -> set[int]:
        """The instances that wait for a prediction."""
        return {peer.instance_id for peer, _, _ in self._waiting}

    def take(self, peer: Peer, frame: Frame) -> None:
        """Answer a request, or keep it for `predict`.

        Whatever the services raise goes back to the environment if it is an error of physx, and on
        to the caller otherwise.
        """
        if frame.kind is Kind.PREDICT:
            self._waiting.append((peer, frame.number, decode(frame.payload)))
        elif frame.kind is Kind.SAVE:
            values = decode(frame.payload)
            self._answer(
                peer, frame, lambda: self._services.save_parameters(peer.instance_id, values)
            )
        elif frame.kind is Kind.LOAD:
            self._answer(peer, frame, lambda: self._services.load_parameters(peer.instance_id))
        else:
            events = [Event(*parts) for parts in decode(frame.payload)]
            self._services.show(peer.instance_id, frame.number, events)

    def predict(self) -> None:
        """Answer the requests for predictions that wait."""
        waiting, self._waiting = sorted(self._waiting, key=lambda one: one[0].instance_id), []
        groups: dict[Signature | int, list[tuple[Peer, int, Sample]]] = {}
        for place, request in enumerate(waiting):
            key = place if self._predict_batch is None else _signature(request[2])
            groups.setdefault(key, []).append(request)
        for requests in groups.values():
            self._predict_group(requests)

    def _predict_group(self, requests: list[tuple[Peer, int, Sample]]) -> None:
        try:
            predictions = self._predictions([sample for _, _, sample in requests])
            messages = [encode(one, "the prediction") for one in predictions]
        except PhysxError as error:
            for peer, number, _ in requests:
                peer.send(pack(Kind.REFUSAL, encode_error(error), number))
            return
        for (peer, number, _), message in zip(requests, messages, strict=True):
            peer.send(pack(Kind.ANSWER, message, number))

    def _predictions(self, samples: list[Sample]) -> list[Sample]:
        if self._predict_batch is None or len(samples) == 1:
            return [self._services.predict(sample) for sample in samples]
        batch = {name: np.stack([np.asarray(one[name]) for one in samples]) for name in samples[0]}
        predicted = {name: np.asarray(array) for name, array in self._predict_batch(batch).items()}
        for name, array in predicted.items():
            if array.shape[:1] != (len(samples),):
                raise UsageError(
                    f'The prediction of "{name}" for {len(samples)} samples has shape '
                    f"{array.shape}; its first axis must have that length."
                )
        return [
            {name: array[place] for name, array in predicted.items()}
            for place in range(len(samples))
        ]

    def _answer(self, peer: Peer, frame: Frame, act: Callable[[], Any]) -> None:
        try:
            message = encode(act(), "the kept parameters")
        except PhysxError as error:
            peer.send(pack(Kind.REFUSAL, encode_error(error), frame.number))
        else:
            peer.send(pack(Kind.ANSWER, message, frame.number))


def _signature(sample: Sample) -> Signature:
    arrays = ((name, np.asarray(value)) for name, value in sorted(sample.items()))
    return tuple((name, array.shape, array.dtype.str) for name, array in arrays)
