"""Writes checkpoints so that each is complete or does not exist, whatever happens."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import re
import tempfile
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.array_file import pack
from physx_core.checkpoint.description import (
    BEST,
    BUFFER,
    DESCRIPTION,
    END,
    FORMAT_VERSION,
    KEPT,
    NAME,
    NORMALIZATION,
    NUMBER,
    REAL,
    SAMPLER,
    STREAMS,
    WHOLE,
    Progress,
    former_path,
    measure,
    partial_path,
)
from physx_core.checkpoint.reading import list_numbers
from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.config import NetworkConfig, to_plain
from physx_core.errors import CheckpointError, PhysxError, SessionError, listed
from physx_core.fields import Field
from physx_core.normalization import Normalization
from physx_core.typing import Array, Index

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


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
    streams: bytes | None = None,
    *,
    best: bool = False,
) -> Path:
    """Write the next checkpoint ``<network_name>_<number>`` and return its folder.

    It gets its name only when it is complete, and is on the disk when this returns.

    Args:
        network_dir: Folder of the checkpoints; it is created in the session's folder.
        config: Configuration of network and transformation.
        network: The network, whose parameters are written.
        optimization: The optimization, whose state is written so that training can resume.
        fields: The dataset's fields.
        normalization: Normalization of the transformation.
        progress: Progress of the training.
        buffer: State of the buffer that draws the batches, if any.
        sampler: State of the sampler that learns from the training, if any.
        streams: What streams of environments need to go on from states, if any.
        best: Replace ``<network_name>_best``, for prediction or as a starting point, without the
            state that a resumed training needs.

    Raises:
        CheckpointError: If it cannot be stored; the other checkpoints stay intact.
        SessionError: If the session's folder was deleted.
    """
    name = config.network_name or NAME
    numbers = list_numbers(network_dir, name)
    path = network_dir / f"{name}_{BEST if best else max(numbers, default=-1) + 1}"
    partial = partial_path(path)
    description = _describe(config, network, fields, progress)
    coefficients = _pack(normalization, {one["name"] for one in description["fields"]})
    try:
        check_session(network_dir)
        if not network_dir.is_dir():
            files.make_folder(network_dir)
        elif not numbers and not path.is_dir():  # its creator may not have waited for the disk
            files.sync_folder(network_dir.parent)
        _clear(network_dir, name)
        if best:
            _write(partial, description, network, coefficients)
        else:
            states = {
                BUFFER: None if buffer is None else np.asarray(buffer, WHOLE).tobytes(),
                SAMPLER: None if sampler is None else np.asarray(sampler, REAL).tobytes(),
                STREAMS: streams,
            }
            _write(partial, description, network, coefficients, optimization, states)
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
            raise _not_stored(path, cause, others) from error
        raise
    return path


def _not_stored(path: Path, cause: OSError, others: Sequence[str]) -> PhysxError:
    """Return the error for a checkpoint that could not be stored."""
    safe = f"The checkpoints {listed(others)}" if others else "The session's samples"
    what, advice = f"Checkpoint {path}", "resume the training"
    return files.storage_error(what, cause, safe, CheckpointError, advice)


def _describe(
    config: NetworkConfig, network: Network, fields: Mapping[str, Field], progress: Progress
) -> dict[str, Any]:
    plain = to_plain(config)
    used = [name for name in (*network.net_fields, *network.opt_fields) if name in fields]
    return {
        "format_version": FORMAT_VERSION,
        "progress": dataclasses.asdict(progress),
        **{key: plain[key] for key in KEPT if key in plain},
        "fields": [fields[name].to_dict() for name in dict.fromkeys(used)],
    }


def _pack(normalization: Mapping[str, Normalization], names: Container[str]) -> bytes | None:
    """Return the content of the file with the normalization of some fields; None if it is empty."""
    arrays = {
        f"{name}/{part}": array
        for name, one in normalization.items()
        if name in names
        for part, array in one.arrays().items()
    }
    return pack(arrays) if arrays else None


def _write(
    partial: Path,
    description: Mapping[str, Any],
    network: Network,
    normalization: bytes | None,
    optimization: Optimization | None = None,
    states: Mapping[str, bytes | None] | None = None,
) -> None:
    """Write a checkpoint's files to a new folder, and wait until they are on the disk."""
    files.create_folder(partial, sync=False)
    network.save_parameters(partial / network.parameters_file)
    if normalization is not None:
        _write_new(partial / NORMALIZATION, normalization)
    described = _describe_files(partial)
    if optimization is not None and optimization.state_file:
        optimization.save_state(partial / optimization.state_file)
        described |= _describe_files(partial, described)
    for name, content in (states or {}).items():
        if content is not None:
            _write_new(partial / name, content)
            described |= _describe_files(partial, described)
    _write_description(partial / DESCRIPTION, {**description, "files": described})
    for file in (*described, DESCRIPTION):
        files.sync_file(partial / file)


def dry_run_save(place: Path, network: Network, optimization: Optimization) -> None:
    """Check that a network and its optimization can be saved, using a temporary folder.

    Args:
        place: Parent of the temporary folder.
        network: The network.
        optimization: The optimization, after its first step.

    Raises:
        CheckpointError: If they cannot be saved.
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
                    return  # there may be space later, when it is needed
                if isinstance(error, PhysxError):
                    raise
                raise CheckpointError(
                    f"{method} fails, so the network could not be saved after the training: "
                    f"{type(error).__name__}: {error}."
                ) from error
            if not Path(name, file).is_file():
                others = listed(path.name for path in Path(name).iterdir())
                raise CheckpointError(
                    f"{method} does not write to the path that it is given, {file}, so the "
                    f"network could not be saved after the training. It writes: {others}."
                )


def remove(path: Path) -> None:
    """Remove a checkpoint; if interrupted, it is left like one whose writing was interrupted.

    Raises:
        CheckpointError: If it cannot be removed.
    """
    hidden = partial_path(path)
    try:
        files.rename(path, hidden)
        files.remove_folder(hidden)
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be removed: {error.strerror or error}. Remove it and resume the "
            "training."
        ) from error


def check_session(network_dir: Path) -> None:
    """Check that a session's folder, in which checkpoints are stored, still exists.

    Raises:
        SessionError: If it does not.
    """
    if not network_dir.parent.is_dir():
        raise SessionError(
            f"The session's folder {network_dir.parent} is gone: it was deleted or renamed during "
            "the run. Checkpoints cannot be stored, and no new folder is created in its place."
        )


def _clear(network_dir: Path, name: str) -> None:
    """Remove what a killed process left behind."""
    pattern = re.compile(rf"\.{re.escape(name)}_({NUMBER}|{BEST})\.partial")
    for path in list(network_dir.iterdir()):
        if pattern.fullmatch(path.name):
            files.remove_folder(path)
    _settle(network_dir / f"{name}_{BEST}")


def _publish(partial: Path, path: Path) -> None:
    """Give a complete checkpoint its name."""
    files.sync_folder(partial)
    former = former_path(path)
    if path.is_dir():
        files.rename(path, former)
    files.rename(partial, path)
    files.sync_folder(path.parent)
    files.remove_folder(former)


def _settle(path: Path, *, finish: bool = True) -> None:
    """Undo or finish an interrupted replacement.

    Args:
        path: The checkpoint to be replaced.
        finish: Whether to remove the one moved aside if the new one already has its name.
    """
    former = former_path(path)
    if not former.is_dir():
        return
    if not path.is_dir():
        files.rename(former, path)
    elif finish:
        files.sync_folder(path.parent)
        files.remove_folder(former)


def _describe_files(folder: Path, known: Container[str] = ()) -> dict[str, Any]:
    """Return the sizes and checksums of files, and start writing them to the disk."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            files.start_sync(path)
            found[path.name] = measure(path)
    return found


def _write_description(path: Path, plain: Mapping[str, Any]) -> None:
    import tomli_w

    body = tomli_w.dumps(plain).encode()
    _write_new(path, body + END.format(crc32(body)).encode())
    files.start_sync(path)


def _write_new(path: Path, content: bytes) -> None:
    descriptor = files.create_new(path)
    try:
        files.write_at(descriptor, content, 0)
    finally:
        files.close(descriptor)
