"""Finds checkpoints, checks that they are unchanged, and reads them."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.array_file import unpack
from physx_core.checkpoint.description import (
    ADVICE,
    BEST,
    BUFFER,
    DESCRIPTION,
    END,
    FORMAT_VERSION,
    KEPT,
    LARGEST,
    LARGEST_STREAMS,
    NAME,
    NORMALIZATION,
    NUMBER,
    REAL,
    SAMPLER,
    STREAMS,
    WHOLE,
    Checkpoint,
    Progress,
    UnreadableError,
    former_path,
    measure,
)
from physx_core.errors import CheckpointError, PhysxError, found_at, listed
from physx_core.fields import Field
from physx_core.normalization import Normalization
from physx_core.origin import install_hint
from physx_core.parsing import parse_toml
from physx_core.typing import Array, Index

_END_PATTERN = re.compile(rb'\n\[checksum\]\ncrc32 = "([0-9a-f]{8})"\n')
_EDITED = "edited"
_INVALID = (
    ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, MemoryError,
    PhysxError,
)  # fmt: skip
"""Exceptions raised when parsing text that does not describe a checkpoint."""


def list_numbers(network_dir: Path, name: str) -> list[int]:
    """Return the sorted numbers of the checkpoints of one name in a folder, readable or not."""
    pattern = re.compile(f"{re.escape(name)}_{NUMBER}")
    if not network_dir.is_dir():
        return []
    found = (pattern.fullmatch(p.name) for p in network_dir.iterdir())
    return sorted(int(match[1]) for match in found if match)


def list_within_epochs(network_dir: Path, name: str) -> list[Path]:
    """Return the folders of the checkpoints written within epochs, by number."""
    found = []
    for number in list_numbers(network_dir, name):
        path = network_dir / f"{name}_{number}"
        with contextlib.suppress(UnreadableError):
            found += [path] if _read(path, content=False).progress.batch else []
    return found


def is_one(path: Path) -> bool:
    """Return whether a folder is a checkpoint."""
    return (path / DESCRIPTION).exists() or former_path(path).is_dir()


def list_all(network_dir: Path) -> list[Path]:
    """Return the folders of all checkpoints, readable or not, by name and number."""
    pattern = re.compile(rf"([^.].*)_(?:{NUMBER}|{BEST})")
    found = []
    for path in network_dir.iterdir() if network_dir.is_dir() else ():
        match = pattern.fullmatch(re.sub(r"^\.(.*)\.former$", r"\1", path.name))
        if match and path.is_dir():
            number = int(match[2]) if match[2] else float("inf")
            found.append((match[1], number, network_dir / match[0]))
    return [path for *_, path in sorted(set(found))]


def find(place: Path, name: str | None, which: int | str) -> Checkpoint:
    """Return the description of a checkpoint whose files are all intact.

    If the last one is requested but cannot be read, the last readable one is returned, with a
    warning that explains why.

    Args:
        place: A session's folder, its network folder, or a checkpoint's own folder.
        name: Name of the network; None: the only one there, otherwise ``"network"``.
        which: Number of the checkpoint; -1: the last; ``"best"``: the one with the smallest loss.

    Raises:
        CheckpointError: If there is no such checkpoint, or it is damaged; the message lists the
            existing ones.
    """
    if is_one(place):
        return read(place)
    folder = place / "network" if (place / "network").is_dir() else place
    known = list_all(folder)
    if not known or (folder == place and not any(map(is_one, known))):  # sessions with numbers
        raise CheckpointError(
            f"There is no network in {folder}: name a training's session (physx train). "
            f"{found_at(place)}"
        )
    if name is None:
        names = {path.name.rpartition("_")[0] for path in known}
        name = names.pop() if len(names) == 1 else NAME
    numbers = list_numbers(folder, name)
    if which == -1 and numbers:
        return _find_last(folder, name, numbers)
    path = folder / f"{name}_{which}"
    others = listed(p.name for p in known if p != path)
    if which in numbers or (which == BEST and (path.is_dir() or former_path(path).is_dir())):
        try:
            return read(path)
        except CheckpointError as error:
            raise CheckpointError(f"{error} Other checkpoints: {others}.") from error
    wanted = f"{name}_<number>" if which == -1 else path.name
    raise CheckpointError(f'There is no checkpoint "{wanted}" in {folder}. Available: {others}.')


def _find_last(folder: Path, name: str, numbers: list[int]) -> Checkpoint:
    """Return the last readable checkpoint, and warn about later ones that are unreadable."""
    problems = []
    for number in reversed(numbers):
        path = folder / f"{name}_{number}"
        try:
            found = _read(path)
        except UnreadableError as error:
            problems.append(f"{path.name}: {error}")
            continue
        if not problems:
            return found
        lines = "\n  ".join(problems)
        notice = f"Using {path}, because later checkpoints cannot be read:\n  {lines}"
        warnings.warn(notice, stacklevel=4)
        return dataclasses.replace(found, notice=notice)
    lines = "\n  ".join(problems)
    best = ""
    if (folder / f"{name}_{BEST}").is_dir():
        best = f' or use {name}_{BEST} (which_network="{BEST}"), which cannot be resumed,'
    raise CheckpointError(
        f"None of the checkpoints in {folder} can be read:\n  {lines}\n"
        f"Restore one from a backup,{best} or train again."
    )


def read(path: Path, *, content: bool = True) -> Checkpoint:
    """Return the description of a checkpoint.

    Args:
        path: The checkpoint's folder.
        content: Whether to read its files: to check every byte, not only their sizes, and to
            return the normalization.

    Raises:
        CheckpointError: If one of its files is missing or damaged, or its format is too new.
    """
    former = former_path(path)
    problem = UnreadableError(f"there is no {DESCRIPTION}")
    for place in (path, former, path):  # it moves between them while it is being replaced
        if place is former and (path.is_dir() or not former.is_dir()):
            continue
        try:
            return _read(place, content=content)
        except UnreadableError as error:
            problem = error
    text = f"{path} cannot be read: {problem}. {problem.advice}"
    raise CheckpointError(text) from problem


def read_buffer(found: Checkpoint) -> Index:
    """Return the state of the buffer that draws a training's batches, from its checkpoint.

    Raises:
        CheckpointError: If the checkpoint has none, or was replaced in the meantime.
    """
    return np.frombuffer(_read_numbers(found, BUFFER), WHOLE).astype(np.int64)


def read_sampler(found: Checkpoint) -> Array:
    """Return the state of the sampler that learns from a training, from its checkpoint.

    Raises:
        CheckpointError: If the checkpoint has none, or was replaced in the meantime.
    """
    return np.frombuffer(_read_numbers(found, SAMPLER), REAL).astype(np.float64)


def has_streams(found: Checkpoint) -> bool:
    """Return whether a checkpoint has what streams of environments need to go on from states."""
    return (found.path / STREAMS).is_file()


def read_streams(found: Checkpoint) -> bytes:
    """Return what streams of environments need to go on from states, from a checkpoint.

    Raises:
        CheckpointError: If the checkpoint has none, or was replaced in the meantime.
    """
    return _read_state(found, STREAMS, LARGEST_STREAMS)


def _read_numbers(found: Checkpoint, name: str) -> bytes:
    content = _read_state(found, name, LARGEST)
    return content[: len(content) // 8 * 8]


def _read_state(found: Checkpoint, name: str, largest: int) -> bytes:
    try:
        content = files.read_content(found.path / name, largest)
    except OSError as error:
        raise CheckpointError(
            f"{found.path / name} cannot be read: {error.strerror or error}. The training cannot "
            "be resumed there. Use another checkpoint."
        ) from error
    check_unchanged(found)
    return content


def check_unchanged(found: Checkpoint) -> None:
    """Check that a checkpoint was not replaced while its files were read.

    Raises:
        CheckpointError: If it was.
    """
    try:
        content = files.read_content(found.path / DESCRIPTION, LARGEST)
    except OSError:
        content = b""
    if crc32(content) != found.crc:
        raise CheckpointError(f"{found.path} was replaced while it was being read. Try again.")


def _read(path: Path, *, content: bool = True) -> Checkpoint:
    try:
        text = files.read_content(path / DESCRIPTION, LARGEST)
    except OSError as error:
        raise _unopened(DESCRIPTION, error) from error
    try:
        plain = _parse(text)
        for name, written in plain["files"].items():
            _check_file(path, name, written, content and name != NORMALIZATION)
        fields = {item["name"]: Field.from_dict(item) for item in plain["fields"]}
        found = Checkpoint(
            path=path,
            network={key: plain[key] for key in KEPT if key in plain},
            fields=fields,
            normalization=_read_normalization(path, plain["files"], fields) if content else {},
            progress=_parse_progress(plain["progress"]),
            crc=crc32(text),
        )
    except _INVALID as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        size = f" ({len(text)} bytes)"
        raise UnreadableError(
            f"{DESCRIPTION}{size} does not describe a checkpoint: {reason}"
        ) from error
    return found


def _parse_progress(plain: dict[str, Any]) -> Progress:
    found = Progress(**plain)
    for mode in found.data.values():
        types = [[type(part) for part in each] for each in mode["partitions"]]
        right = type(mode["rows"]) is int and type(mode["digest"]) is str
        if not right or any(each != [str, int, int, str] for each in types):
            raise ValueError("its record of the data is not one")
    if not isinstance(found.options, dict):
        raise TypeError("its options are not a table")
    return found


def _parse(content: bytes) -> dict[str, Any]:
    """Return the content of a description after checking that it is unchanged."""
    plain = parse_toml(content)
    version, checksum = plain["format_version"], plain.get("checksum")
    if type(version) is not int:
        raise ValueError(f"'format_version' is {version!r}")
    if version > FORMAT_VERSION and checksum is None:
        raise _unsupported(version)
    end = _END_PATTERN.fullmatch(content, max(0, len(content) - len(END.format(0))))
    is_whole = end is not None and int(end[1], 16) == crc32(content[: end.start()])
    if not is_whole and checksum != {"crc32": _EDITED}:
        raise UnreadableError(
            f"{DESCRIPTION} was damaged, cut, or edited by hand: its checksum does not match",
            f'{ADVICE} If it was edited on purpose, put crc32 = "{_EDITED}" under '
            "[checksum] at its end.",
        )
    if version != FORMAT_VERSION:
        raise _unsupported(version)
    return plain


def _unsupported(version: int) -> UnreadableError:
    later = version > FORMAT_VERSION
    return UnreadableError(
        f"it has format version {version}, but this physx reads version {FORMAT_VERSION}",
        install_hint("physx-core", update=True) if later else "Train the network again.",
    )


def _read_normalization(
    path: Path, listed_files: Mapping[str, Any], fields: Mapping[str, Field]
) -> dict[str, Normalization]:
    """Return the normalization in a checkpoint's file, if one is listed."""
    written = listed_files.get(NORMALIZATION)
    if written is None:
        return {}
    try:
        content = files.read_content(path / NORMALIZATION, written["nbytes"])
    except OSError as error:
        raise _unopened(NORMALIZATION, error) from error
    if f"{crc32(content):08x}" != written["crc32"]:
        raise UnreadableError(f"{NORMALIZATION} is damaged: its checksum does not match")
    arrays: dict[str, dict[str, Array]] = {}
    for place, array in unpack(content).items():
        name, part = place.split("/")
        arrays.setdefault(name, {})[part] = array
    return {n: Normalization.from_arrays(own, fields[n].entry_shape) for n, own in arrays.items()}


def _check_file(path: Path, name: str, written: Mapping[str, Any], content: bool) -> None:
    """Check that a file listed in the description is unchanged."""
    if Path(name).name != name:
        raise ValueError(f"{name!r} is not the name of a file")
    try:
        nbytes = (path / name).stat().st_size
        if nbytes != written["nbytes"]:
            raise UnreadableError(
                f"{name} is damaged: it has {nbytes} bytes, but {written['nbytes']} were written"
            )
        if content and measure(path / name) != written:
            raise UnreadableError(f"{name} is damaged: its checksum does not match")
    except OSError as error:
        raise _unopened(name, error) from error


def _unopened(name: str, error: OSError) -> UnreadableError:
    if isinstance(error, FileNotFoundError):
        return UnreadableError(f"{name} is missing")
    return UnreadableError(f"{name} cannot be opened: {error.strerror or error}")
