"""ServiceRequests: requests of environments in workers, answered by the run's services."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from physx_core.components.services import Services
from physx_core.errors import ConnectionRefusedByPeerError, PhysxError, UsageError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.remote_errors import encode_error
from physx_core.net.values import decode, pack_value
from physx_core.typing import Batch, Sample
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.validation import (
    parse_choice,
    parse_events,
    parse_saved,
    parse_values,
)

_MOST_UNREAD = 1 << 26
_KEPT = "the saved parameters"
_PREDICTION = "the prediction"
_TOUCH = "what a person does"

Signature: TypeAlias = tuple[tuple[str, tuple[int, ...], str], ...]
Request: TypeAlias = tuple[Peer, int, Sample]
"""A request for a prediction: the client, the number of the request, and the sample."""


class ServiceRequests:
    """Answers the requests of clients; those for predictions are collected and answered together.

    A request for a prediction is *due* when the run waits for the row that its environment is
    generating. Until then it is held, so the network's answers do not depend on how far clients run
    ahead.

    If the services have a method ``predict_batch(batch) -> batch``, simultaneous requests with the
    same fields go through it as one batch. Otherwise each goes through `predict`.

    Attributes:
        batches: Whether requests for predictions are answered as one batch.
    """

    def __init__(self, services: Services, sets: ParameterSets) -> None:
        """Store the services.

        Args:
            services: The services of the run.
            sets: Chooses the instances' parameters.
        """
        self._services = services
        self._sets = sets
        self._predict_batch: Callable[[Batch], Batch] | None = getattr(
            services, "predict_batch", None
        )
        self.batches = self._predict_batch is not None
        self._waiting: list[Request] = []

    @property
    def count(self) -> int:
        """How many instances wait for a prediction that is due."""
        return len(self._waiting) - sum(peer.is_ahead for peer, _, _ in self._waiting)

    @property
    def asking(self) -> set[int]:
        """The instances that wait for a prediction, due or held."""
        return {peer.instance_id for peer, _, _ in self._waiting}

    def take(self, peer: Peer, frame: Frame) -> None:
        """Answer a request, or keep it for `predict`.

        Physx errors that the services raise are sent to the environment, others are raised. A
        request that this client's predecessor made gets the same answer.
        """
        if frame.kind is not Kind.SHOW and self._repeat(peer, frame):
            return
        if frame.kind in (Kind.PREDICT, Kind.TOUCH):
            told = None if peer.journal is None else peer.journal.tell()
            if told is not None:
                kind = Kind.ANSWER if told[0] else Kind.REFUSAL
                peer.send(pack(kind, told[1], frame.number), is_prediction=True)
                peer.pace.go_on()
                return
            if frame.kind is Kind.PREDICT:
                self._keep(peer, frame)
            else:
                who, touch = peer.instance_id, self._services.touch
                self._answer(peer, frame.number, _TOUCH, touch, who)
        elif frame.kind is Kind.SAVE:
            of_all, values = parse_saved(frame.payload)
            who = 0 if of_all else peer.instance_id
            self._answer(peer, frame.number, _KEPT, self._services.save_parameters, who, values)
        elif frame.kind is Kind.LOAD:
            load = self._services.load_parameters
            who = 0 if decode(frame.payload) is True else peer.instance_id
            self._answer(peer, frame.number, _KEPT, load, who)
        elif frame.kind is Kind.CHOOSE:
            self._choose(peer, frame)
        else:
            events = parse_events(frame.payload)
            peer.shown += 1
            self._services.show(peer.instance_id, frame.number, events)

    def _repeat(self, peer: Peer, frame: Frame) -> bool:
        """Answer a request that this client's predecessor made; return whether it was one."""
        peer.pace.rest()
        if len(peer.outgoing) > _MOST_UNREAD:
            raise ConnectionRefusedByPeerError("It asks, but does not read the answers.")
        peer.requests += 1
        if frame.number != peer.requests:
            raise ConnectionRefusedByPeerError("It numbered its requests wrongly.")
        recorded = peer.journal.answer(frame.number) if peer.journal is not None else None
        if recorded is None:
            return False
        peer.send_once(recorded)
        peer.pace.go_on()
        return True

    def _choose(self, peer: Peer, frame: Frame) -> None:
        if not peer.parameters:
            raise ConnectionRefusedByPeerError("It asked for parameters, but defined none.")
        episode, choose = parse_choice(frame.payload, peer.episode), self._sets.choose
        self._answer(peer, frame.number, "the parameters", choose, peer.instance_id, episode)
        peer.episode = episode

    def _keep(self, peer: Peer, frame: Frame) -> None:
        """Keep a request for `predict`; it replaces one that its environment abandoned."""
        sample = parse_values(frame.payload)
        for name, value in sample.items():
            try:
                if isinstance(value, (list, tuple)):
                    np.asarray(value)
            except ValueError:
                refusal = UsageError(f'get_prediction() got "{name}", which is not an array.')
                message = pack(Kind.REFUSAL, encode_error(refusal), frame.number)
                peer.send(message, is_prediction=True)
                return
        if self._waiting:
            self.forget(peer)
        self._waiting.append((peer, frame.number, sample))

    def forget(self, peer: Peer) -> None:
        """Forget the requests of a lost client."""
        self._waiting = [request for request in self._waiting if request[0] is not peer]

    def predict(self) -> bool:
        """Answer the due requests for predictions; return whether all answers are sent."""
        waiting = [request for request in self._waiting if not request[0].is_ahead]
        self._waiting = [request for request in self._waiting if request[0].is_ahead]
        if len(waiting) == 1:
            ((peer, number, sample),) = waiting
            self._answer(peer, number, _PREDICTION, self._services.predict, sample)
            return not peer.outgoing
        groups: dict[Signature | int, list[Request]] = {}
        for place, request in enumerate(sorted(waiting, key=lambda one: one[0].instance_id)):
            key = place if self._predict_batch is None else _signature(request[2])
            groups.setdefault(key, []).append(request)
        for requests in groups.values():
            self._predict_group(requests)
        return not any(peer.outgoing for peer, _, _ in waiting)

    def _predict_group(self, requests: list[Request]) -> None:
        try:
            messages = [
                pack_value(Kind.ANSWER, prediction, _PREDICTION, number)
                for (_, number, _), prediction in zip(
                    requests, self._predictions(requests), strict=True
                )
            ]
        except PhysxError as error:
            for peer, number, _ in requests:
                message = pack(Kind.REFUSAL, encode_error(error), number)
                peer.send(message, is_prediction=True)
                peer.pace.go_on()
            return
        except Exception as error:
            numbers = ", ".join(str(peer.instance_id) for peer, _, _ in requests)
            error.add_note(f"while handling the prediction for instance {numbers}")
            raise
        for (peer, _, _), message in zip(requests, messages, strict=True):
            peer.send(message, is_prediction=True)
            peer.pace.go_on()

    def _predictions(self, requests: list[Request]) -> list[Sample]:
        if self._predict_batch is None or len(requests) == 1:
            return [self._services.predict(sample) for _, _, sample in requests]
        samples = [sample for _, _, sample in requests]
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

    def _answer(
        self, peer: Peer, number: int, what: str, act: Callable[..., Any], *args: Any
    ) -> None:
        """Answer a request with what `act` returns for some arguments."""
        try:
            message = pack_value(Kind.ANSWER, act(*args), what, number)
        except PhysxError as error:
            message = pack(Kind.REFUSAL, encode_error(error), number)
        except Exception as error:
            error.add_note(f"while handling {what} for instance {peer.instance_id}")
            raise
        peer.send(message, is_prediction=what in (_PREDICTION, _TOUCH))
        peer.pace.go_on()


def _signature(sample: Sample) -> Signature:
    arrays = ((name, np.asarray(value)) for name, value in sorted(sample.items()))
    return tuple((name, array.shape, array.dtype.str) for name, array in arrays)
