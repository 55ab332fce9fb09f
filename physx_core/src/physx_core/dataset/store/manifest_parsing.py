"""Parses and validates an untrusted manifest."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any

from physx_core.dataset.store.manifest import Manifest, Mode, Partition, Partitions
from physx_core.dataset.store.statistics_file import file_name
from physx_core.dataset.store.validation import (
    SESSION,
    checked,
    parse_field,
    parse_name,
    whole,
)
from physx_core.fields import Field, check_together


def parse_manifest(plain: Mapping[str, Any]) -> Manifest:
    """Return the manifest described by plain data."""
    modes = {
        parse_name(name, "a mode"): _mode(name, mode)
        for name, mode in checked(dict, plain["modes"], "'modes'").items()
    }
    versions = checked(dict, plain["versions"], "'versions'")
    for version in versions.values():
        checked(str, version, "a version")
    info = checked(dict, plain["info"], "'info'")
    if "statistics" in plain:
        return Manifest(modes, info, versions, _statistics_checksum(plain["statistics"]))
    for mode in modes.values():  # its rows are read again
        mode.forget_statistics()
    return Manifest(modes, info, versions)


def apply_change(manifest: Manifest, plain: Any) -> None:
    """Take over a change of the manifest, described by plain data."""
    for one in (plain, *checked(list, plain.get("also", []), "the other partitions")):
        name = checked(str, one["mode"], "a mode")
        mode = manifest.modes[name]
        partition = _partition(name, one["partition"], mode.files, set(mode.axes))
        if any(partition.key == each.key for each in mode.dropped):
            raise ValueError("a partition is listed twice")
        mode.put(partition)
        whole(mode.rows, "the number of rows")
    if "statistics" in plain:
        manifest.statistics_checksum = _statistics_checksum(plain["statistics"])
        for each in manifest.modes.values():
            each.statistics = None


def _statistics_checksum(plain: Any) -> int:
    checksum = int(checked(str, plain["crc32"], "the checksum of the statistics"), 16)
    if plain["file"] != file_name(checksum):
        raise ValueError(f"the file of the statistics cannot be {plain['file']!r:.60}")
    return checksum


def _mode(mode_name: str, plain: Any) -> Mode:
    fields: dict[str, Field] = {}
    for entry in plain["fields"]:
        field = parse_field(entry)
        if field.name in fields:
            raise ValueError(f"the field {field.name!r} is listed twice")
        fields[field.name] = field
    if not fields:
        raise ValueError("a mode has no fields")
    check_together(fields)
    mode = Mode(fields, statistics=None)
    known = mode.files, set(mode.axes)
    mode.partitions = Partitions(_partition(mode_name, e, *known) for e in plain["partitions"])
    mode.dropped = [_partition(mode_name, entry, *known) for entry in plain.get("dropped", ())]
    for session, index in checked(dict, plain.get("removed", {}), "'removed'").items():
        mode.removed[session] = whole(index, "the number of a partition", 2**31)
    keys = [partition.key for partition in (*mode.partitions, *mode.dropped)]
    if len(set(keys)) != len(keys):
        raise ValueError("a partition is listed twice")
    whole(mode.rows, "the number of rows")
    return mode


def _partition(
    mode_name: str, plain: Any, fields: Mapping[str, Field], axes: Set[str]
) -> Partition:
    session = checked(str, plain["session"], "a session")
    if not SESSION.fullmatch(session):
        raise ValueError(f"a session cannot be {session!r:.60}")
    sealed = checked(bool, plain["sealed"], "'sealed'")
    offsets = checked(dict, plain["offsets"], "'offsets'")
    crc32 = checked(dict, plain.get("crc32", {}), "'crc32'")
    if not (offsets.keys() <= fields.keys() and crc32.keys() <= fields.keys()):
        unknown = (offsets.keys() | crc32.keys()) - fields.keys()
        raise ValueError(f"there is no field {min(unknown)!r:.60}")
    if sealed and (len(offsets) != len(fields) or len(crc32) not in (0, len(fields))):
        raise ValueError("a sealed partition lacks offsets or checksums")
    if sealed and any(field.shape is None for field in fields.values()):
        raise ValueError("a sealed partition has fields of unknown shape")
    rows = whole(plain["rows"], "a number of rows") if sealed else 0
    sizes = checked(dict, plain.get("sizes", {}), "'sizes'") if sealed else {}
    if sealed and sizes.keys() != axes:
        raise ValueError("a sealed partition has the sizes of other axes")
    for size in sizes.values():
        whole(size, "a number of entries")
    follows = None if sealed else plain.get("follows")
    if follows is not None:
        index, count = checked(list, follows, "'follows'")
        follows = whole(index, "the number of a partition", 2**31), whole(count, "a row count")
    for name, offset in offsets.items():
        of = fields[name]
        count = sizes.get(of.free_axis, 0) if of.free_axis else rows
        whole(whole(offset, "an offset") + count * of.nbytes, "the end of the rows")
    return Partition(
        mode=mode_name,
        session=session,
        index=whole(plain["index"], "the number of a partition", 2**31),
        first_row=whole(plain["first_row"], "a first row"),
        rows=rows,
        sizes=sizes,
        sealed=sealed,
        offsets=offsets,
        checksums={n: int(checked(str, crc, "a checksum"), 16) for n, crc in crc32.items()},
        counted=sealed and bool(crc32) and plain.get("counted") is True,
        follows=follows,
    )
