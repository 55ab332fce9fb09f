"""Validation of client messages.

A client knows the token, but it may be broken or a different implementation: its messages are
accepted only if they are consistent with the earlier ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypedDict, cast

from physx_core.components.parameter import Parameter
from physx_core.components.scene.event import ACTIONS, Event
from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.fields import RESERVED, ROLES, Field, first_not_finite, is_utf8
from physx_core.net.frames import MAX_PAYLOAD
from physx_core.net.values import decode
from physx_core.packing import check_sizes
from physx_core.rows import ROW_FIELDS
from physx_core.typing import Array, Batch

_DTYPE = re.compile(r"[<>|=]?[biufc]\d{1,2}|\|S[1-9]\d{0,4}")
_MOST_PARAMETERS = 4096
_MOST_EPISODES = 2**48


def parse_fields(payload: bytes | bytearray) -> list[Field]:
    """Return the fields that a message lists."""
    plain = decode(payload)
    try:
        if not isinstance(plain, list) or not all(map(_is_field, plain)):
            raise ConfigError("a description is malformed.")
        fields = [Field.from_dict(one) for one in plain]
    except ConfigError as error:
        raise ConnectionRefusedByPeerError(f"It does not list valid fields: {error}") from error
    if not fields or len({field.name for field in fields}) < len(fields):
        raise ConnectionRefusedByPeerError("It does not list any fields, or lists one twice.")
    return fields


def parse_parameters(payload: bytes | bytearray) -> list[Parameter]:
    """Return the parameters that a message lists."""
    plain = decode(payload)
    is_list = isinstance(plain, list) and 0 < len(plain) <= _MOST_PARAMETERS
    if not is_list or not all(
        isinstance(one, dict) and {*map(type, one)} == {str} for one in plain
    ):
        raise ConnectionRefusedByPeerError("It does not list parameters.")
    try:
        parameters = [Parameter.from_dict(one) for one in plain]
    except ConfigError as error:
        raise ConnectionRefusedByPeerError(f"It does not list parameters: {error}") from error
    if len({parameter.name for parameter in parameters}) < len(parameters):
        raise ConnectionRefusedByPeerError("It defined a parameter twice.")
    return parameters


def parse_choice(payload: bytes | bytearray, last: int) -> int:
    """Return the episode whose parameters a message asks for.

    Args:
        payload: The message.
        last: Episode of the last such message, -1 if there was none.
    """
    episode = decode(payload)
    if type(episode) is not int or not last < episode < _MOST_EPISODES:
        raise ConnectionRefusedByPeerError("It asked for the parameters of an impossible episode.")
    return episode


class ClientState(TypedDict):
    """A state of an instance, with what its client has counted."""

    orders: int
    """How many orders other than credit it had obeyed."""
    shown: int
    """How many messages with drawing events there had been."""
    rejected: int
    """How many rejected rows there had been."""
    state: bytes
    """The state, for a client."""


def parse_state(payload: bytes | bytearray) -> ClientState:
    """Return the state that a message holds."""
    plain = decode(payload)
    kinds = {"orders": int, "shown": int, "rejected": int, "state": bytes}
    if not isinstance(plain, dict) or {n: type(value) for n, value in plain.items()} != kinds:
        raise ConnectionRefusedByPeerError("It sent a state that is none.")
    state = cast(ClientState, plain)
    if min(state["orders"], state["shown"], state["rejected"]) < 0:
        raise ConnectionRefusedByPeerError("It sent a state with a negative count.")
    return state


def _is_field(plain: Any) -> bool:
    if not isinstance(plain, dict) or not {"name", "dtype"} <= plain.keys():
        return False
    dtype, shape = plain["dtype"], plain.get("shape", [])
    return (
        isinstance(dtype, str)
        and _DTYPE.fullmatch(dtype) is not None
        and isinstance(shape, list)
        and all(type(size) is int for size in shape[1:])
        and {*map(type, shape[:1])} <= {int, str}
        and isinstance(plain.get("indexes", ""), str)
        and isinstance(plain.get("unit", ""), str)
        and plain.get("role", "training") in ROLES
    )


def check_environment_fields(fields: Sequence[Field]) -> None:
    """Check the fields that an environment defines, according to its client."""
    reserved = [field.name for field in fields if field.name in RESERVED]
    if reserved:
        raise ConnectionRefusedByPeerError(f'It defined the reserved field "{reserved[0]}".')
    of_episodes = [field for field in fields if field.role == "episode"]
    if len(of_episodes) == len(fields) or any(field.shape is None for field in of_episodes):
        raise ConnectionRefusedByPeerError("It defined only fields of episodes, or without shape.")
    if (size := sum(field.nbytes for field in of_episodes)) > MAX_PAYLOAD // 2:
        raise ConnectionRefusedByPeerError(
            f"The fields of an episode have {size} bytes; the limit is {MAX_PAYLOAD // 2}."
        )


def check_row_fields(fields: Sequence[Field], environment: Sequence[Field]) -> None:
    """Check the fields of rows.

    Args:
        fields: Fields of the rows.
        environment: Fields that the environment defined before, whose shapes may have been open.
    """
    expected = [*environment, *ROW_FIELDS]
    if len(fields) != len(expected):
        raise ConnectionRefusedByPeerError(
            f"Its rows have {len(fields)} fields, but it defined {len(expected)}."
        )
    for field, known in zip(fields, expected, strict=True):
        shape = field.shape if known.shape is None else known.shape
        if field.shape is None or field != replace(known, shape=shape):
            raise ConnectionRefusedByPeerError(f"Its rows have {field}, but it defined {known}.")
    size = sum(field.nbytes for field in fields)
    if size > MAX_PAYLOAD:
        raise ConnectionRefusedByPeerError(
            f"Its rows have {size} bytes; the limit is {MAX_PAYLOAD}."
        )


def parse_values(payload: bytes | bytearray) -> dict[str, Any]:
    """Return the values of a request, by name."""
    values = decode(payload)
    if not isinstance(values, dict) or not {*map(type, values)} <= {str}:
        raise ConnectionRefusedByPeerError("It sent a request that is not a dictionary of names.")
    return values


def parse_saved(payload: bytes | bytearray) -> tuple[bool, dict[str, Any]]:
    """Return whether saved values are those of all instances, under no name, and the values."""
    values = parse_values(payload)
    of_all = values.get("")
    if not isinstance(of_all, dict):
        return False, values
    if not {*map(type, of_all)} <= {str}:
        raise ConnectionRefusedByPeerError("It saved values without names.")
    return True, of_all


def parse_events(payload: bytes | bytearray) -> list[Event]:
    """Return the drawing events of a message."""
    plain = decode(payload)
    if not isinstance(plain, list) or not all(map(_is_event, plain)):
        raise ConnectionRefusedByPeerError("It sent malformed drawing events.")
    return [Event(*parts) for parts in plain]


def _is_event(parts: Any) -> bool:
    return (
        isinstance(parts, tuple)
        and [type(part) for part in parts] == [str, str, tuple, dict]
        and parts[0] in ACTIONS
        and {*map(type, parts[2])} == {str}
        and all(type(name) is str for name in parts[3])
    )


def check_rows(block: Batch, fields: Sequence[Field], instance_id: int, last_step: int) -> int:
    """Check received rows, as the client should have done before sending them.

    Args:
        block: Rows of a client, at least one.
        fields: Fields of the rows.
        instance_id: The client's instance.
        last_step: Step of its last row before these, -1 if there is none.

    Returns:
        Step of the last row.
    """
    steps, numbers = block["step"], block["env_id"]
    several = len(steps) > 1
    if numbers[0] != instance_id or (several and (numbers != instance_id).any()):
        raise ConnectionRefusedByPeerError("It sent rows of another instance.")
    if steps[0] <= last_step or (several and (steps[1:] <= steps[:-1]).any()):
        raise ConnectionRefusedByPeerError("It sent rows whose steps do not increase.")
    check_values(block, fields, instance_id)
    return int(steps[-1])


def _raw(values: Array) -> bytes:
    """Return the bytes of values."""
    return b"".join(each.tobytes() for each in (values if values.dtype.hasobject else [values]))


def check_values(block: Batch, fields: Sequence[Field], instance_id: int) -> None:
    """Check the values of received rows, as the client should have done before sending them.

    Raises:
        NotFiniteError: If one is NaN or infinity.
    """
    free = {field.name: field for field in fields if field.free_axis or field.indexes}
    for row in range(len(block["step"])) if free else ():
        check_sizes(free, {name: block[name][row] for name in free}, instance_id)
    for field in fields:
        values = block[field.name]
        kind = values.dtype.kind
        if field.is_text and not is_utf8(values):
            raise ConnectionRefusedByPeerError(
                f'It sent rows whose field "{field.name}" is no text in UTF-8.'
            )
        if field.numpy_dtype.kind == "b" and _raw(values).translate(None, b"\0\1"):
            raise ConnectionRefusedByPeerError(
                f'It sent rows whose field "{field.name}" is neither true nor false.'
            )
        bad = first_not_finite(values) if kind in "fcO" else None
        if bad is not None:
            raise field.not_finite(instance_id=instance_id, step=int(block["step"][bad]))
