"""MCAP: recordings of ROS 2 and others, of which states of joints are imported, a table a topic.

A topic ``/joint_states`` has the columns ``joint_states/time``, ``joint_states/log_time`` and, for
each joint, ``joint_states/position.elbow``, ``velocity`` and ``effort``.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import PhysxError, listed
from physx_core.parsing import parse_json
from physx_core.typing import Array, Vector
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns, Format
from physx_formats.table import ArrayColumn, Notes, check_size, import_library

MAGIC = b"\x89MCAP0\r\n"
_STATES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
_KINDS = ("position", "velocity", "effort")


@dataclass
class _Series:
    """Messages of one topic about the same joints.

    Attributes:
        times: Those of header and log, in ns, of each message.
        values: Of each message, by kind: a number for each joint in alphabetical order, or none.
    """

    times: list[tuple[int, int]] = field(default_factory=list)
    values: list[tuple[Vector, ...]] = field(default_factory=list)


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[Columns, Notes]]:
    """Open a recording, or the folder of one; yield its states of joints by topic.

    Messages of one topic about different joints are tables of their own, ``joint_states/1``.
    """
    found: dict[tuple[str, tuple[str, ...]], _Series] = {}
    topics: dict[str, str] = {}
    for part in _files(path):
        _read(part, limit, found, topics)
    if not found:
        raise ExchangeError(
            f"{path} has no message of the type {_STATES[0]}. Topics: "
            f"{listed([f'{topic} ({kind})' for topic, kind in topics.items()])}."
        )
    starts = np.array([each for series in found.values() for each in series.times]).min(axis=0)
    columns: Columns = {}
    several = [topic for topic, _ in found]
    counts: dict[str, int] = {}
    for (topic, joints), series in found.items():
        counts[topic] = counts.get(topic, 0) + 1
        table = topic.strip("/") + (f"/{counts[topic]}" if several.count(topic) > 1 else "")
        for name, column in _columns(f"{topic} of {path}", joints, series, starts):
            columns[f"{table}/{name}"] = column
    yield columns, Notes()


def _files(path: Path) -> list[Path]:
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


def _read(
    path: Path,
    limit: int,
    found: dict[tuple[str, tuple[str, ...]], _Series],
    topics: dict[str, str],
) -> None:
    """Add the states of joints in a file to those found, and its topics with their types."""
    decoder = import_library("mcap_ros2.decoder", "Importing MCAP", "mcap").DecoderFactory()
    nbytes = 0
    try:
        with path.open("rb") as file:
            for schema, channel, message in _messages(path, file, limit, topics):
                state = _decoded(path, decoder, schema, channel, message.data)
                names = [str(name) for name in _part(state, "name")]
                if len(set(names)) < len(names):
                    raise ValueError(f"joints of {channel.topic} have the same name")
                stamp = _part(state, "header", "stamp")
                time = 10**9 * int(_part(stamp, "sec")) + int(_part(stamp, "nanosec"))
                values = [np.asarray(_part(state, each), np.float64) for each in _KINDS]
                if any(each.shape not in ((0,), (len(names),)) for each in values):
                    raise ValueError(f"{channel.topic} has more or fewer numbers than joints")
                order = sorted(range(len(names)), key=names.__getitem__)
                key = channel.topic, tuple(names[place] for place in order)
                series = found.setdefault(key, _Series())
                series.times.append((time, int(message.log_time)))
                series.values.append(tuple(each[order] if len(each) else each for each in values))
                nbytes += sum(each.nbytes for each in values)
                check_size(path, nbytes, limit)
    except PhysxError:
        raise
    except Exception as error:  # on damaged files, the library raises whatever happens to it
        raise ExchangeError(
            f"{path} is truncated or damaged: {error or type(error).__name__}. The program mcap "
            "keeps what can be read:  mcap recover IN -o OUT"
        ) from error


def _messages(path: Path, file: Any, limit: int, topics: dict[str, str]) -> Iterator[Any]:
    """Yield schema, channel and message of states of joints, in the order of the file."""
    kinds = import_library("mcap.records", "Importing MCAP", "mcap")
    reading = import_library("mcap.stream_reader", "Importing MCAP", "mcap")
    longest = path.stat().st_size
    stream = reading.StreamReader(
        file, emit_chunks=True, validate_crcs=True, record_size_limit=longest
    )
    schemas, channels = {0: None}, {}
    for outer in stream.records:
        is_chunk = isinstance(outer, kinds.Chunk)
        for record in _records(path, outer, reading, limit) if is_chunk else [outer]:
            if isinstance(record, kinds.Schema):
                schemas[record.id] = record
            elif isinstance(record, kinds.Channel):
                channels[record.id] = record
                schema = schemas[record.schema_id]
                topics[record.topic] = schema.name if schema else record.message_encoding
            elif isinstance(record, kinds.Message):
                channel = channels[record.channel_id]
                if topics[channel.topic] in _STATES:
                    yield schemas[channel.schema_id], channel, record


def _records(path: Path, chunk: Any, reading: Any, limit: int) -> Any:
    """Return the records of a chunk, which unpacks to no more than it says."""
    size, packed = chunk.uncompressed_size, chunk.data
    check_size(path, size, limit)
    if chunk.compression == "zstd":
        zstd = import_library("zstandard", "Importing MCAP", "mcap")
        packed = zstd.ZstdDecompressor().stream_reader(packed).read(size)
    elif chunk.compression == "lz4":
        lz4 = import_library("lz4.frame", "Importing MCAP", "mcap")
        packed = lz4.LZ4FrameDecompressor().decompress(packed, max_length=size)
    if len(packed) != size:
        raise ValueError("a chunk is shorter than it says")
    plain = dataclasses.replace(chunk, compression="", data=packed)
    return reading.breakup_chunk(plain, validate_crc=True)


def _decoded(path: Path, decoder: Any, schema: Any, channel: Any, data: bytes) -> Any:
    if channel.message_encoding == "json":
        return parse_json(data)
    decode = decoder.decoder_for(channel.message_encoding, schema)
    if decode is None:
        raise ExchangeError(
            f"{path}: {channel.topic} is encoded as {channel.message_encoding} with a schema as "
            f"{schema.encoding}. Those of ROS 2 (cdr, ros2msg) and JSON are read."
        )
    return decode(data)


def _part(value: Any, *names: str) -> Any:
    """Return a part of a message, by the names that lead to it."""
    for name in names:
        value = value[name] if isinstance(value, Mapping) else getattr(value, name)
    return value


def _columns(
    place: str, joints: Sequence[str], series: _Series, starts: Array
) -> Iterator[tuple[str, ArrayColumn]]:
    """Yield the columns of a table; times are from the first message of the recording, in s."""
    times = np.array(series.times)
    stamped = bool(times[:, 0].any())
    order = np.argsort(times[:, 0 if stamped else 1], kind="stable")
    since = (times[order] - starts) * 1e-9
    yield "time", ArrayColumn(since[:, 0 if stamped else 1], "s")
    yield "log_time", ArrayColumn(since[:, 1], "s")
    for kind, values in zip(_KINDS, zip(*series.values, strict=True), strict=True):
        empty = sum(not len(each) for each in values)
        if empty == len(values):
            continue
        if empty:
            raise ExchangeError(
                f"{place}: {empty} of {len(values)} messages have no {kind}. Record one with all."
            )
        table = np.array(values)[order]
        for number, joint in enumerate(joints):
            yield f"{kind}.{joint.replace('/', '.')}", ArrayColumn(table[:, number])


def _recognizes(path: Path, begin: bytes) -> bool:
    return begin == MAGIC or (path.is_dir() and bool(_files(path)))


FORMAT = Format(recognizes=_recognizes, open=open_columns)
"""Only the states of joints are read: ``sensor_msgs/msg/JointState``, of ROS 2 or in JSON."""
