"""Taking the lock of a dataset and getting it ready for its writer."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.dataset.repair import recovery
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.manifest import Manifest, plain_info
from physx_core.dataset.store.manifest_parsing import SESSION
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.virtual_index import write_index
from physx_core.dataset.write.writer import Writer
from physx_core.errors import ConfigError, DatasetError


@dataclass(frozen=True)
class WriterOptions:
    """How a dataset is written: see `Dataset.create`."""

    session: str | None
    max_file_size: float
    durable: bool
    shared: bool = False

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ConfigError: The session's name cannot begin file names, or the size is not positive.
        """
        if self.session is not None and not SESSION.fullmatch(self.session):
            raise ConfigError(
                f"{self.session!r} cannot begin file names: use letters, digits, '_', '-', '.'."
            )
        if not self.max_file_size > 0:
            raise ConfigError(f"max_file_size is {self.max_file_size} GB but must be positive.")

    def writer(self, store: ManifestStore) -> Writer:
        """Return the writer; without a session's name, it goes on in the last session."""
        session = self.session or next(reversed(store.manifest.sessions), "run")
        return Writer(store, session, self.max_file_size, self.durable)


def create(folder: Path, options: WriterOptions, info: Mapping[str, Any]) -> tuple[Writer, int]:
    """Make a dataset; return its writer and the lock's descriptor.

    Raises:
        DatasetError: There is one already, or the folder cannot be written.
        DatasetLockedError: Another process is making one there.
        ConfigError: The info cannot be stored.
    """
    manifest = Manifest(info=plain_info(info))
    with files.storing(f"A dataset in {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        with files.turn(folder) if options.shared else contextlib.nullcontext():
            lock = files.lock(folder)
            try:
                if recovery.holds_dataset(folder):
                    raise DatasetError(
                        f"There is a dataset in {folder} already. Extend it with "
                        "Dataset.open(directory, writable=True), or choose another folder."
                    )
                manifest_file.save(folder, manifest)
                if options.shared:
                    files.share(folder, lock)
            except BaseException:
                os.close(lock)
                raise
    return options.writer(ManifestStore(folder, manifest, options.shared)), lock


def extend(folder: Path, options: WriterOptions) -> tuple[Writer, int]:
    """Lock a dataset that exists and repair what its last writer left open.

    Returns:
        Its writer and the lock's descriptor.

    Raises:
        DatasetLockedError: Another process writes to it.
        DatasetError: It is damaged, or the folder cannot be written.
    """
    with files.storing(f"Rows in {folder}"):
        if not options.shared:
            lock = files.lock(folder)
            return _extended(folder, options, lock, alone=True), lock
        with files.turn(folder):
            lock, alone = files.lock_shared(folder)
            return _extended(folder, options, lock, alone), lock


def _extended(folder: Path, options: WriterOptions, lock: int, alone: bool) -> Writer:
    try:
        manifest = recovery.load(folder)
        writer = options.writer(ManifestStore(folder, manifest, options.shared))
        if alone:
            if recovery.repair(folder, manifest):
                write_index(folder, writer.session, manifest)
            manifest_file.save(folder, manifest)
            if options.shared:
                files.share(folder, lock)
    except BaseException:
        os.close(lock)
        raise
    return writer
