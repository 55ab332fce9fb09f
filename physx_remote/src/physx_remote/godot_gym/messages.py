"""Messages: the protobuf messages of godot-gym, given by the user or made from fields.

An answer is a message ``Message`` with the parts ``agent_data`` (1) and ``world_data`` (2), whose
types are the project's own. Two more parts are ours: ``error`` (1000), what went wrong, and
``description`` (1001), what the messages and spaces are, as JSON. Programs that do not know them
skip them, as they do with every part that they do not know.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from physx_core import Field
from physx_core.errors import ConfigError, MissingLibraryError, RemoteError, RemoteProtocolError
from physx_core.fields import FieldLike, as_fields
from physx_core.typing import Array

AGENT, WORLD = "agent_data", "world_data"
ERROR, DESCRIPTION = 1000, 1001

MessageField: TypeAlias = FieldLike
"""A field as in `physx_core.fields.as_fields`, or ``(name, str)`` or ``(name, bytes)``."""

_Readers: TypeAlias = "list[tuple[str, Callable[[Any], Any]]]"

_LENGTH_DELIMITED = 2
_MANY = 32

_NUMBERS = {
    "b1": "bool", "f2": "float", "f4": "float", "f8": "double",
    "i1": "int32", "i2": "int32", "i4": "int32", "i8": "int64",
    "u1": "uint32", "u2": "uint32", "u4": "uint32", "u8": "uint64",
}  # fmt: skip
_ARRAYS = {
    "bool": "?", "float": "<f4", "double": "<f8", "int32": "<i4", "int64": "<i8",
    "uint32": "<u4", "uint64": "<u8", "sint32": "<i4", "sint64": "<i8", "fixed32": "<u4",
    "fixed64": "<u8", "sfixed32": "<i4", "sfixed64": "<i8", "enum": "<i4",
}  # fmt: skip
_TYPES = (
    "", "double", "float", "int64", "uint64", "int32", "fixed64", "fixed32", "bool", "string",
    "group", "message", "bytes", "uint32", "enum", "sfixed32", "sfixed64", "sint32", "sint64",
)  # fmt: skip


class Messages:
    """The messages of one project.

    Attributes:
        Message: Class of the whole answer.
        agent: Fields of the agent's data by name, where they were made from fields.
        world: Fields of the world's data by name, likewise.
        proto: The definition as text, for other programs; empty where it was given.
    """

    def __init__(self, given: Any) -> None:
        """Take messages that exist.

        Args:
            given: A module that was made by ``protoc``, its class ``Message``, or `Messages`.

        Raises:
            ConfigError: There is no ``Message`` with ``agent_data`` and ``world_data``.
        """
        found = given if isinstance(given, type) else getattr(given, "Message", None)
        names = getattr(getattr(found, "DESCRIPTOR", None), "fields_by_name", {})
        if not (isinstance(found, type) and AGENT in names and WORLD in names):
            place = given.__name__ if isinstance(given, ModuleType) else repr(given)
            raise ConfigError(
                f"{place} has no message Message with the fields {AGENT} and {WORLD}. Give the "
                "module that protoc made, its class Message, or Messages.of_fields(...)."
            )
        self.Message: Any = found
        self.agent: Mapping[str, Field | type] = getattr(given, "agent", {})
        self.world: Mapping[str, Field | type] = getattr(given, "world", {})
        self.proto: str = getattr(given, "proto", "")

    @classmethod
    def of_fields(
        cls, agent: Iterable[MessageField] = (), world: Iterable[MessageField] = ()
    ) -> Messages:
        """Make messages: each field gets the number of its place, counted from 1.

        A field of shape () becomes a single value, every other a repeated one; an array of uint8
        becomes bytes.

        Args:
            agent: Fields of the agent's data.
            world: Fields of the world's data.

        Raises:
            ConfigError: A name is given twice, or a type is none that protobuf has.
            MissingLibraryError: protobuf is not installed.
        """
        parts = {"AgentData": _by_name(agent), "WorldData": _by_name(world)}
        typed = {
            part: {name: _proto_type(name, field) for name, field in fields.items()}
            for part, fields in parts.items()
        }
        messages = cls(_message_class(typed))
        messages.agent, messages.world = parts["AgentData"], parts["WorldData"]
        messages.proto = _proto_text(typed)
        return messages

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain data for JSON; empty lists where messages were given."""
        return {
            part: [_plain(name, field) for name, field in fields.items()]
            for part, fields in (("agent", self.agent), ("world", self.world))
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Messages:
        """Make the messages that `to_dict` described."""
        parts = {part: [_declared(field) for field in plain[part]] for part in ("agent", "world")}
        return cls.of_fields(**parts)

    def read(self, body: bytes) -> dict[str, dict[str, Any] | None]:
        """Return the parts ``agent`` and ``world`` of an answer, each by field name.

        A part that is not in the answer is None. Repeated numbers are arrays, of the declared
        shape where one is declared; those that did not come with the answer are left out.

        Raises:
            RemoteError: The other side says what went wrong.
            RemoteProtocolError: The body is no message of this kind.
        """
        from google.protobuf.message import DecodeError

        message = self.Message()
        try:
            message.ParseFromString(body)
        except DecodeError as error:
            raise RemoteProtocolError(
                f"An answer of {len(body)} bytes is none of the messages that were given: {error}."
            ) from error
        has_agent, has_world = message.HasField(AGENT), message.HasField(WORLD)
        if body and not has_agent and not has_world:
            error_text = extension(body, ERROR)
            if error_text is not None:
                raise RemoteError(f"The other side reports: {error_text}")
        agent, world = self._readers
        return {
            "agent": _values(message.agent_data, agent) if has_agent else None,
            "world": _values(message.world_data, world) if has_world else None,
        }

    @cached_property
    def _readers(self) -> tuple[_Readers, _Readers]:
        """How to read the fields of the agent's and the world's data."""
        parts = self.Message.DESCRIPTOR.fields_by_name
        return (
            _readers_of(parts[AGENT].message_type, self.agent),
            _readers_of(parts[WORLD].message_type, self.world),
        )


def fill(storage: Any, **values: Any) -> None:
    """Write values into a message: arrays, numbers, texts or bytes, by field name.

    Raises:
        ConfigError: The message has no such field, or the field does not take such a value.
    """
    for name, value in values.items():
        try:
            present = getattr(storage, name)
        except AttributeError:
            known = ", ".join(storage.DESCRIPTOR.fields_by_name)
            raise ConfigError(
                f'The message {storage.DESCRIPTOR.name} has no field "{name}". It has: {known}.'
            ) from None
        try:
            if not isinstance(present, (bool, int, float, str, bytes)):
                _extend(storage, name, present, value)
            elif isinstance(present, bytes) and not isinstance(value, bytes):
                setattr(storage, name, np.ascontiguousarray(value, np.uint8).tobytes())
            elif isinstance(value, (np.ndarray, np.generic)):
                setattr(storage, name, value.item())
            else:
                setattr(storage, name, value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ConfigError(
                f'The field "{name}" of {storage.DESCRIPTOR.name} does not take {value!r:.100}: '
                f"{error}."
            ) from error


def encoded_extension(number: int, text: str) -> bytes:
    """Return a message with one text under a number of ours."""
    content = text.encode()
    return _varint(number << 3 | _LENGTH_DELIMITED) + _varint(len(content)) + content


def extension(body: bytes, number: int) -> str | None:
    """Return the text under a number of ours where it is the first thing in a message."""
    tag = _varint(number << 3 | _LENGTH_DELIMITED)
    if not body.startswith(tag):
        return None
    start = len(tag)
    while start < len(body) and body[start] & 0x80:
        start += 1
    return body[start + 1 :].decode(errors="replace")


def _varint(number: int) -> bytes:
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)


def _extend(storage: Any, name: str, repeated: Any, value: Any) -> None:
    """Set a repeated field; many floating numbers go as the bytes that they are on the wire."""
    if len(repeated):
        storage.ClearField(name)
    if isinstance(value, list) and value and type(value[0]) in (float, int):
        try:
            repeated.extend(value)
            return
        except TypeError:  # it is nested further on, or holds numbers of numpy
            storage.ClearField(name)
    if not isinstance(value, np.ndarray):
        value = np.asarray(value)
    if value.size > _MANY:
        field = storage.DESCRIPTOR.fields_by_name[name]
        kind = _TYPES[field.type]
        if kind in ("float", "double"):
            content = value.astype(_ARRAYS[kind]).tobytes()
            tag = _varint(field.number << 3 | _LENGTH_DELIMITED)
            storage.MergeFromString(tag + _varint(len(content)) + content)
            return
    repeated.extend(value.ravel().tolist())


def _values(part: Any, readers: _Readers) -> dict[str, Any]:
    """Return the values of a message; those that did not come with it are left out."""
    read = ((name, reader(getattr(part, name))) for name, reader in readers)
    return {name: value for name, value in read if value is not None}


def _readers_of(descriptor: Any, declared: Mapping[str, Field | type]) -> _Readers:
    return [(field.name, _reader(field, declared.get(field.name))) for field in descriptor.fields]


def _reader(field: Any, declared: Field | type | None) -> Callable[[Any], Any]:
    """Return what makes a value of what a field of a message holds, None of what is not there."""
    kind, repeated = _TYPES[field.type], _is_repeated(field)
    if isinstance(declared, Field):
        return _declared_reader(declared, np.dtype(declared.dtype), kind, repeated)
    if kind == "message":

        def nested(value: Any) -> Any:
            readers = _readers_of(field.message_type, {})
            return [_values(v, readers) for v in value] if repeated else _values(value, readers)

        return nested
    if repeated and kind in _ARRAYS:
        return lambda value: np.fromiter(value, _ARRAYS[kind], len(value))
    return list if repeated else lambda value: value


def _declared_reader(
    declared: Field, dtype: np.dtype[Any], kind: str, repeated: bool
) -> Callable[[Any], Any]:
    """Return what makes an array of the declared shape."""
    if kind != "bytes" and not repeated:
        return dtype.type
    shape = declared.shape
    size = math.prod(shape) if shape is not None else None

    def array(value: Any) -> Array | None:
        if size and not len(value):
            return None
        if kind == "bytes":
            found: Array = np.frombuffer(value, dtype).copy()
        else:
            found = np.fromiter(value, dtype, len(value))
        if size is None or found.size == size:
            return found if shape is None or len(shape) == 1 else found.reshape(shape)
        raise RemoteProtocolError(
            f'"{declared.name}" arrived with {found.size} values and has the shape {shape}: the '
            "other side has another declaration."
        )

    return array


def _is_repeated(field: Any) -> bool:
    """Return whether a field of a message is repeated; protobuf changed how to ask."""
    if hasattr(field, "is_repeated"):
        return bool(field.is_repeated)
    return bool(field.label == field.LABEL_REPEATED)


def _by_name(fields: Iterable[MessageField]) -> dict[str, Field | type]:
    found: dict[str, Field | type] = {}
    if isinstance(fields, str):
        raise ConfigError(f'Fields are a list, such as ["{fields}"], not a text.')
    for item in fields:
        field: Field | type
        if isinstance(item, tuple) and len(item) == 2 and item[1] in (str, bytes):
            name, field = item
        else:
            field = as_fields(item, "training")[0]
            name = field.name
        if name in found:
            raise ConfigError(f'The field "{name}" is declared twice.')
        found[name] = field
    return found


def _proto_type(name: str, field: Field | type) -> tuple[bool, str]:
    """Return whether a field is repeated, and its type."""
    if isinstance(field, type):
        return False, "string" if field is str else "bytes"
    kind = np.dtype(field.dtype).str[1:]
    if kind not in _NUMBERS:
        raise ConfigError(f'Field "{name}": protobuf has no numbers of type {field.dtype}.')
    if kind == "u1" and field.shape != ():
        return False, "bytes"
    return field.shape != (), _NUMBERS[kind]


def _plain(name: str, field: Field | type) -> dict[str, Any]:
    return field.to_dict() if isinstance(field, Field) else {"name": name, "text": field is str}


def _declared(plain: Mapping[str, Any]) -> MessageField:
    if "text" in plain:
        return plain["name"], str if plain["text"] else bytes
    return Field.from_dict(plain)


def _proto_text(parts: Mapping[str, Mapping[str, tuple[bool, str]]]) -> str:
    """Return the definition in the language of protobuf."""
    lines = ['syntax = "proto3";']
    for part, fields in parts.items():
        lines += ["", f"message {part} {{"]
        for number, (name, (repeated, kind)) in enumerate(fields.items(), start=1):
            lines.append(f"  {'repeated ' * repeated}{kind} {name} = {number};")
        lines.append("}")
    lines += ["", "message Message {", f"  AgentData {AGENT} = 1;", f"  WorldData {WORLD} = 2;"]
    return "\n".join([*lines, "}", ""])


def _message_class(parts: Mapping[str, Mapping[str, tuple[bool, str]]]) -> Any:
    """Return the class of the whole answer, made without a compiler."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingLibraryError(
            "The protocol godot-gym", "protobuf", "godot", "physx-remote"
        ) from None
    file = descriptor_pb2.FileDescriptorProto(
        name="physx_remote.proto", package="physx", syntax="proto3"
    )
    for part, fields in parts.items():
        message = file.message_type.add(name=part)
        for number, (name, (repeated, proto)) in enumerate(fields.items(), start=1):
            label, code = (3 if repeated else 1), _TYPES.index(proto)
            message.field.add(name=name, number=number, label=label, type=code)
    whole = file.message_type.add(name="Message")
    kind = _TYPES.index("message")
    whole.field.add(name=AGENT, number=1, label=1, type=kind, type_name=".physx.AgentData")
    whole.field.add(name=WORLD, number=2, label=1, type=kind, type_name=".physx.WorldData")
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("physx.Message"))
