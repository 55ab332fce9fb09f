"""Checkpoint: a folder with a network's parameters and everything that is needed to use them.

``checkpoint.toml`` names the network, its transformation, its fields and their normalization; the
network's library writes the parameters beside it. Nothing in it is code. It lists the size and the
CRC-32 of each file in the folder and ends with a CRC-32 of everything before that, so that a file
that was cut, damaged or edited by hand is noticed before it is used.

The checkpoints of a training are numbered in the order of writing; it can be resumed from the last.
Beside them is ``<name>_best``, the network of the epoch with the smallest loss. A checkpoint gets
its name when everything in it is on the disk. The best one is moved aside for the next one, which
cannot replace it in one step; in between, and after a crash there, the one moved aside is read.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import re
import tempfile
import warnings
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.config import NetworkConfig, to_plain
from physx_core.errors import CheckpointError, PhysxError, SessionError, listed
from physx_core.fields import Field
from physx_core.origin import install_hint
from physx_core.parsing import parse_toml
from physx_core.statistics import Normalization
from physx_core.typing import Array, Index

FORMAT_VERSION = 2
"""Version of the description; version 1 has no checksums."""
NAME = "network"
"""Name of the checkpoints unless another one is given."""
BEST = "best"
DESCRIPTION = "checkpoint.toml"
BUFFER = "buffer.bin"
"""File with the state of the buffer that draws the batches: whole numbers of 8 bytes."""
_WHOLE = np.dtype("<i8")
SAMPLER = "sampler.bin"
"""File with the state of the sampler that learns from the training: numbers of 8 bytes."""
_REAL = np.dtype("<f8")
_KEPT = (
    "network",
    "network_kwargs",
    "transformation",
    "transformation_kwargs",
    "data_type",
)
_LARGEST = 2**28
_END = '\n[checksum]\ncrc32 = "{:08x}"\n'
_END_PATTERN = re.compile(rb'\n\[checksum\]\ncrc32 = "([0-9a-f]{8})"\n')
_EDITED = "edited"
_NUMBER = "(0|[1-9][0-9]*)"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_ADVICE = "Restore it from a copy, or use another checkpoint."
_INVALID = (
    ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, MemoryError,
    PhysxError,
)  # fmt: skip
"""What parsing raises for text that does not describe a checkpoint."""


@dataclass(frozen=True)
class Progress:
    """Progress of a training when its checkpoint was written.

    Attributes:
        epoch: Number of finished epochs.
        batch: Number of finished batches of the next epoch.
        batches_read: Number of batches read from the dataset, in all epochs.
        seed: Seed of the training.
        blocks: Number of batches whose rows environments generated.
        best: State of `BestEpoch`.
        record: State of `TrainingRecord`.
    """

    epoch: int
    batch: int
    batches_read: int
    seed: int
    blocks: int = 0
    best: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Checkpoint:
    """Description of a checkpoint.

    Attributes:
        path: The checkpoint's folder.
        network: References and arguments of network and transformation, as in `NetworkConfig`.
        fields: The network's input and target fields by name.
        normalization: Their normalization by name; empty if nothing was normalized.
        progress: Progress of the training.
        crc: CRC-32 of the description.
        notice: Which later checkpoints it stands in for, and why; empty if it is what was asked
            for.
    """

    path: Path
    network: dict[str, Any]
    fields: dict[str, Field]
    normalization: dict[str, Normalization]
    progress: Progress
    crc: int
    notice: str = ""


class _UnreadableError(Exception):
    """A checkpoint cannot be read, for the given reason, which is a sentence without its end."""

    def __init__(self, reason: str, advice: str = _ADVICE) -> None:
        super().__init__(reason)
        self.advice = advice


# Writing ----------------------------------------------------------------------------------------


def save(
    network_dir: Path,
    config: NetworkConfig,
    network: Network,
    optimization: Optimization,
    fields: Mapping[str, Field],
    normalization: Mapping[str, Normalization],
    progress: Progress,
    buffer: Index | None = None,
    sampler: Array | None = None,
    *,
    best: bool = False,
) -> Path:
    """Write the next checkpoint ``<network_name>_<number>`` and return its folder.

    It appears under its name only when it is complete, and is on the disk when this returns.

    Args:
        network_dir: Folder of the checkpoints; it is created in the session's folder.
        config: Configuration of network and transformation.
        network: The network, whose parameters are written.
        optimization: The optimization, whose state is written so that training can resume.
        fields: The dataset's fields.
        normalization: Normalization of the transformation.
        progress: Progress of the training.
        buffer: State of the buffer that draws its batches, if there is one.
        sampler: State of the sampler that learns from it, if there is one.
        best: Replace ``<network_name>_best``, to predict with or to start from, without the state
            that a resumed training needs.

    Raises:
        CheckpointError: If it cannot be stored; the others are intact.
        SessionError: If the session's folder was deleted.
    """
    name = config.network_name or NAME
    numbers = list_numbers(network_dir, name)
    path = network_dir / f"{name}_{BEST if best else max(numbers, default=-1) + 1}"
    partial = _partial(path)
    description = _describe(config, network, fields, normalization, progress)
    try:
        check_session(network_dir)
        if not network_dir.is_dir():
            files.make_folder(network_dir)
        elif not numbers and not path.is_dir():  # whoever made it may not have waited for the disk
            files.sync_folder(network_dir.parent)
        _clear(network_dir, name)
        if best:
            _write(partial, description, network)
        else:
            _write(partial, description, network, optimization, buffer, sampler)
        _publish(partial, path)
    except BaseException as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        with contextlib.suppress(OSError):
            files.remove_folder(partial)
            _settle(path, finish=not isinstance(cause, OSError))
        if isinstance(error, Exception):
            check_session(network_dir)
        if isinstance(cause, OSError):
            others = [f"{name}_{number}" for number in numbers]
            safe = f"The checkpoints {listed(others)}" if others else "The session's samples"
            what, advice = f"Checkpoint {path}", "resume the training"
            raise files.storage_error(what, cause, safe, CheckpointError, advice) from error
        raise
    return path


def _describe(
    config: NetworkConfig,
    network: Network,
    fields: Mapping[str, Field],
    normalization: Mapping[str, Normalization],
    progress: Progress,
) -> dict[str, Any]:
    plain = to_plain(config)
    used = [name for name in (*network.net_fields, *network.opt_fields) if name in fields]
    return {
        "format_version": FORMAT_VERSION,
        "progress": dataclasses.asdict(progress),
        **{key: plain[key] for key in _KEPT if key in plain},
        "fields": [fields[name].to_dict() for name in dict.fromkeys(used)],
        "normalization": {
            name: normalization[name].to_dict() for name in used if name in normalization
        },
    }


def _write(
    partial: Path,
    description: Mapping[str, Any],
    network: Network,
    optimization: Optimization | None = None,
    buffer: Index | None = None,
    sampler: Array | None = None,
) -> None:
    """Write the files of a checkpoint to a new folder, and wait until they are on the disk."""
    files.create_folder(partial, sync=False)
    network.save_parameters(partial / network.parameters_file)
    described = _describe_files(partial)
    if optimization is not None and optimization.state_file:
        optimization.save_state(partial / optimization.state_file)
        described |= _describe_files(partial, described)
    if buffer is not None:
        _write_new(partial / BUFFER, np.asarray(buffer, _WHOLE).tobytes())
        described |= _describe_files(partial, described)
    if sampler is not None:
        _write_new(partial / SAMPLER, np.asarray(sampler, _REAL).tobytes())
        described |= _describe_files(partial, described)
    _write_description(partial / DESCRIPTION, {**description, "files": described})
    for file in (*described, DESCRIPTION):
        files.sync_file(partial / file)


def rehearse(place: Path, network: Network, optimization: Optimization) -> None:
    """Check that a network and its optimization can be saved, in a folder that is then removed.

    Args:
        place: Folder to make that folder in.
        network: The network.
        optimization: The optimization, after its first step.

    Raises:
        CheckpointError: If they cannot.
    """
    writers: list[tuple[Any, str, str]] = [(network, "save_parameters", network.parameters_file)]
    if optimization.state_file:
        writers.append((optimization, "save_state", optimization.state_file))
    with tempfile.TemporaryDirectory(prefix=".rehearsal-", dir=place) as name:
        for owner, write, file in writers:
            method = f"{type(owner).__name__}.{write}()"
            try:
                getattr(owner, write)(Path(name, file))
            except Exception as error:
                cause = error if isinstance(error, OSError) else error.__cause__
                if isinstance(cause, OSError) and cause.errno in _FULL:
                    return  # there may be space when it is needed
                if isinstance(error, PhysxError):
                    raise
                raise CheckpointError(
                    f"{method} fails, so the network could not be saved after the training: "
                    f"{type(error).__name__}: {error}."
                ) from error
            if not Path(name, file).is_file():
                others = listed(path.name for path in Path(name).iterdir())
                raise CheckpointError(
                    f"{method} does not write the file whose path it is given, {file}, so the "
                    f"network could not be saved after the training. It writes: {others}."
                )


def remove(path: Path) -> None:
    """Remove a checkpoint; if that is cut short, it is as one whose writing was.

    Raises:
        CheckpointError: If it cannot be removed.
    """
    hidden = _partial(path)
    try:
        files.rename(path, hidden)
        files.remove_folder(hidden)
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be removed: {error.strerror or error}. Remove it, and resume the "
            "training."
        ) from error


def check_session(network_dir: Path) -> None:
    """Check that a session's folder, in which checkpoints are or will be stored, is still there.

    Raises:
        SessionError: If it is not.
    """
    if not network_dir.parent.is_dir():
        raise SessionError(
            f"The session's folder {network_dir.parent} is gone: it was deleted or renamed during "
            "the run. Checkpoints cannot be stored; no new folder is created in its place."
        )


def _clear(network_dir: Path, name: str) -> None:
    """Remove what a killed process left."""
    pattern = re.compile(rf"\.{re.escape(name)}_({_NUMBER}|{BEST})\.partial")
    for path in list(network_dir.iterdir()):
        if pattern.fullmatch(path.name):
            files.remove_folder(path)
    _settle(network_dir / f"{name}_{BEST}")


def _publish(partial: Path, path: Path) -> None:
    """Give a complete checkpoint its name."""
    files.sync_folder(partial)
    former = _former(path)
    if path.is_dir():
        files.rename(path, former)
    files.rename(partial, path)
    files.sync_folder(path.parent)
    files.remove_folder(former)


def _settle(path: Path, *, finish: bool = True) -> None:
    """Undo or finish a replacement that was cut short.

    Args:
        path: The checkpoint that was to be replaced.
        finish: Whether the one moved aside is removed if the new one has its name.
    """
    former = _former(path)
    if not former.is_dir():
        return
    if not path.is_dir():
        files.rename(former, path)
    elif finish:
        files.sync_folder(path.parent)
        files.remove_folder(former)


def _partial(path: Path) -> Path:
    """Return where a checkpoint is while it is written or removed."""
    return path.parent / f".{path.name}.partial"


def _former(path: Path) -> Path:
    """Return where a checkpoint is while another one takes its name."""
    return path.parent / f".{path.name}.former"


def _describe_files(folder: Path, known: Container[str] = ()) -> dict[str, Any]:
    """Return the sizes and checksums of files, which the disk begins to write."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            files.start_sync(path)
            found[path.name] = _measure(path)
    return found


def _measure(path: Path) -> dict[str, Any]:
    """Return the size and the checksum of a file, as they are described."""
    nbytes = crc = 0
    for block in files.read_blocks(path):
        nbytes, crc = nbytes + len(block), crc32(block, crc)
    return {"nbytes": nbytes, "crc32": f"{crc:08x}"}


def _write_description(path: Path, plain: Mapping[str, Any]) -> None:
    import tomli_w

    body = tomli_w.dumps(plain).encode()
    _write_new(path, body + _END.format(crc32(body)).encode())
    files.start_sync(path)


def _write_new(path: Path, content: bytes) -> None:
    descriptor = files.create_new(path)
    try:
        files.write_at(descriptor, content, 0)
    finally:
        files.close(descriptor)


# Finding ----------------------------------------------------------------------------------------


def list_numbers(network_dir: Path, name: str) -> list[int]:
    """Return the sorted numbers of the checkpoints of one name in a folder, readable or not."""
    pattern = re.compile(f"{re.escape(name)}_{_NUMBER}")
    if not network_dir.is_dir():
        return []
    found = (pattern.fullmatch(p.name) for p in network_dir.iterdir())
    return sorted(int(match[1]) for match in found if match)


def list_within_epochs(network_dir: Path, name: str) -> list[Path]:
    """Return the folders of the checkpoints that were written within epochs, by number."""
    found = []
    for number in list_numbers(network_dir, name):
        path = network_dir / f"{name}_{number}"
        with contextlib.suppress(_UnreadableError):
            found += [path] if _read(path, content=False).progress.batch else []
    return found


def list_all(network_dir: Path) -> list[Path]:
    """Return the folders of all checkpoints, readable or not, by name and number."""
    pattern = re.compile(rf"([^.].*)_(?:{_NUMBER}|{BEST})")
    found = []
    for path in network_dir.iterdir() if network_dir.is_dir() else ():
        match = pattern.fullmatch(re.sub(r"^\.(.*)\.former$", r"\1", path.name))
        if match and path.is_dir():
            number = int(match[2]) if match[2] else float("inf")
            found.append((match[1], number, network_dir / match[0]))
    return [path for *_, path in sorted(set(found))]


def find(place: Path, name: str | None, which: int | str) -> Checkpoint:
    """Return the description of a checkpoint, all of whose files are intact.

    If the last one is asked for and cannot be read, the last one that can be is returned, with a
    warning that says why.

    Args:
        place: A session's folder, its network folder, or a checkpoint's own folder.
        name: Name of the network; None: the only one there, or else ``"network"``.
        which: Number of the checkpoint; -1: the last; ``"best"``: the one with the smallest loss.

    Raises:
        CheckpointError: If there is no such checkpoint, or it is damaged; the message lists the
            existing ones.
    """
    if (place / DESCRIPTION).exists() or _former(place).is_dir():
        return read(place)
    folder = place / "network" if (place / "network").is_dir() else place
    if name is None:
        names = {path.name.rpartition("_")[0] for path in list_all(folder)}
        name = names.pop() if len(names) == 1 else NAME
    numbers = list_numbers(folder, name)
    if which == -1 and numbers:
        return _find_last(folder, name, numbers)
    path = folder / f"{name}_{which}"
    others = listed(p.name for p in list_all(folder) if p != path)
    if which in numbers or (which == BEST and (path.is_dir() or _former(path).is_dir())):
        try:
            return read(path)
        except CheckpointError as error:
            raise CheckpointError(f"{error} Other checkpoints: {others}.") from error
    wanted = f"{name}_<number>" if which == -1 else path.name
    raise CheckpointError(f'There is no checkpoint "{wanted}" in {folder}. There are: {others}.')


def _find_last(folder: Path, name: str, numbers: list[int]) -> Checkpoint:
    """Return the last readable checkpoint and warn of those that are not."""
    problems = []
    for number in reversed(numbers):
        path = folder / f"{name}_{number}"
        try:
            found = _read(path)
        except _UnreadableError as error:
            problems.append(f"{path.name}: {error}")
            continue
        if not problems:
            return found
        lines = "\n  ".join(problems)
        notice = f"{path} is used, because later checkpoints cannot be read:\n  {lines}"
        warnings.warn(notice, stacklevel=4)
        return dataclasses.replace(found, notice=notice)
    lines = "\n  ".join(problems)
    best = ""
    if (folder / f"{name}_{BEST}").is_dir():
        best = f' or try {name}_{BEST} (which_network="{BEST}"), from which none can be resumed,'
    raise CheckpointError(
        f"None of the checkpoints in {folder} can be read:\n  {lines}\n"
        f"Restore one from a copy,{best} or train again."
    )


# Reading ----------------------------------------------------------------------------------------


def read(path: Path, *, content: bool = True) -> Checkpoint:
    """Return the description of a checkpoint.

    Args:
        path: The checkpoint's folder.
        content: Whether to check every byte of its files, not only their sizes.

    Raises:
        CheckpointError: If a file of it is missing or damaged, or it is of a later format.
    """
    former = _former(path)
    problem = _UnreadableError(f"there is no {DESCRIPTION}")
    for place in (path, former, path):  # while it is replaced it moves from one to the other
        if place is former and (path.is_dir() or not former.is_dir()):
            continue
        try:
            return _read(place, content=content)
        except _UnreadableError as error:
            problem = error
    text = f"{path} cannot be read: {problem}. {problem.advice}"
    raise CheckpointError(text) from problem


def read_buffer(found: Checkpoint) -> Index:
    """Return the state of the buffer that draws a training's batches, from its checkpoint.

    Raises:
        CheckpointError: If the checkpoint has none, or was replaced meanwhile.
    """
    return np.frombuffer(_read_numbers(found, BUFFER), _WHOLE).astype(np.int64)


def read_sampler(found: Checkpoint) -> Array:
    """Return the state of the sampler that learns from a training, from its checkpoint.

    Raises:
        CheckpointError: If the checkpoint has none, or was replaced meanwhile.
    """
    return np.frombuffer(_read_numbers(found, SAMPLER), _REAL).astype(np.float64)


def _read_numbers(found: Checkpoint, name: str) -> bytes:
    try:
        content = files.read_content(found.path / name, _LARGEST)
    except OSError as error:
        raise CheckpointError(
            f"{found.path / name} cannot be read: {error.strerror or error}. The training cannot "
            "be resumed there. Use another checkpoint."
        ) from error
    check_unchanged(found)
    return content[: len(content) // 8 * 8]


def check_unchanged(found: Checkpoint) -> None:
    """Check that a checkpoint was not replaced while its files were read.

    Raises:
        CheckpointError: If it was.
    """
    try:
        content = files.read_content(found.path / DESCRIPTION, _LARGEST)
    except OSError:
        content = b""
    if crc32(content) != found.crc:
        raise CheckpointError(f"{found.path} was replaced while it was read. Try again.")


def _read(path: Path, *, content: bool = True) -> Checkpoint:
    try:
        text = files.read_content(path / DESCRIPTION, _LARGEST)
    except OSError as error:
        raise _unopened(DESCRIPTION, error) from error
    try:
        plain = _parse(text)
        listed_files = plain["files"] if plain["format_version"] > 1 else {}
        fields = [Field.from_dict(item) for item in plain["fields"]]
        normalization = plain.get("normalization", {})
        found = Checkpoint(
            path=path,
            network={key: plain[key] for key in _KEPT if key in plain},
            fields={item.name: item for item in fields},
            normalization={n: Normalization.from_dict(c) for n, c in normalization.items()},
            progress=Progress(**plain["progress"]),
            crc=crc32(text),
        )
        for name, written in listed_files.items():
            _check_file(path, name, written, content)
    except _INVALID as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        size = f" ({len(text)} bytes)"
        raise _UnreadableError(f"{DESCRIPTION}{size} describes no checkpoint: {reason}") from error
    return found


def _parse(content: bytes) -> dict[str, Any]:
    """Return the content of a description that is as it was written."""
    plain = parse_toml(content)
    version, checksum = plain["format_version"], plain.get("checksum")
    if type(version) is not int:
        raise ValueError(f"'format_version' is {version!r}")
    if version > FORMAT_VERSION and checksum is None:
        raise _later(version)
    if version > 1 or checksum is not None:
        end = _END_PATTERN.fullmatch(content, max(0, len(content) - len(_END.format(0))))
        is_whole = end is not None and int(end[1], 16) == crc32(content[: end.start()])
        if not is_whole and checksum != {"crc32": _EDITED}:
            raise _UnreadableError(
                f"{DESCRIPTION} was damaged, cut or edited by hand: its checksum does not match",
                f'{_ADVICE} If it was edited on purpose, put crc32 = "{_EDITED}" under '
                "[checksum] at its end.",
            )
    if version > FORMAT_VERSION:
        raise _later(version)
    return plain


def _later(version: int) -> _UnreadableError:
    return _UnreadableError(
        f"it has version {version} of the format, but this physx reads up to {FORMAT_VERSION}",
        install_hint("physx-core", update=True),
    )


def _check_file(path: Path, name: str, written: Mapping[str, Any], content: bool) -> None:
    """Check that a file beside the description is as it was written."""
    if Path(name).name != name:
        raise ValueError(f"{name!r} is not the name of a file")
    try:
        nbytes = (path / name).stat().st_size
        if nbytes != written["nbytes"]:
            raise _UnreadableError(
                f"{name} is damaged: it has {nbytes} bytes, but {written['nbytes']} were written"
            )
        if content and _measure(path / name) != written:
            raise _UnreadableError(f"{name} is damaged: its checksum does not match")
    except OSError as error:
        raise _unopened(name, error) from error


def _unopened(name: str, error: OSError) -> _UnreadableError:
    if isinstance(error, FileNotFoundError):
        return _UnreadableError(f"{name} is missing")
    return _UnreadableError(f"{name} cannot be opened: {error.strerror or error}")
