"""Locks a dataset and prepares it for writing."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.dataset.read.virtual_index import write_index
from physx_core.dataset.repair import recovery
from physx_core.dataset.store import locks, manifest_file, statistics_file
from physx_core.dataset.store.manifest import Manifest, to_plain_info
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.validation import SESSION
from physx_core.dataset.write.writer import Writer
from physx_core.errors import ConfigError, DatasetError


@dataclass(frozen=True)
class WriterOptions:
    """How a dataset is written: see `Dataset.create`."""

    session: str | None
    max_file_size: float
    durable: bool
    shared: bool

    def __post_init__(self) -> None:
        """Check the options."""
        if self.session is not None and not SESSION.fullmatch(self.session):
            raise ConfigError(
                f"File names cannot begin with {self.session!r}: "
                "use letters, digits, '_', '-', '.'."
            )
        if not self.max_file_size > 0:
            raise ConfigError(f"max_file_size is {self.max_file_size} GB but must be positive.")

    def writer(self, folder: Path, manifest: Manifest, lock: files.FileLock) -> Writer:
        """Return the writer; without a session name, it continues the last session."""
        session = self.session or next(reversed(manifest.sessions), "run")
        store = ManifestStore(folder, manifest, self.shared)
        return Writer(store, session, self.max_file_size, self.durable, lock)


def create(folder: Path, options: WriterOptions, info: Mapping[str, Any]) -> Writer:
    """Create a dataset and return its writer."""
    manifest = Manifest(info=to_plain_info(info))
    with files.storing(f"A dataset in {folder}"):
        files.make_folder(folder)
        with locks.lock_manifest(folder) if options.shared else contextlib.nullcontext():
            lock = locks.lock(folder)
            try:
                if recovery.holds_dataset(folder):
                    raise DatasetError(
                        f"There is already a dataset in {folder}. Extend it with "
                        "Dataset.open(directory, writable=True), or choose another folder."
                    )
                manifest_file.save(folder, manifest)
                files.sync_folder(folder.parent)  # the caller may have just created the folder
                if options.shared:
                    locks.share(folder, lock)
            except BaseException:
                lock.close()
                raise
    return options.writer(folder, manifest, lock)


def extend(folder: Path, options: WriterOptions) -> Writer:
    """Lock an existing dataset, recover what its last writer left open, and return its writer."""
    with (
        files.storing(f"Rows in {folder}"),
        locks.lock_manifest(folder) if options.shared else contextlib.nullcontext(),
    ):
        lock, alone = locks.lock_shared(folder) if options.shared else (locks.lock(folder), True)
        try:
            manifest = recovery.load(folder)
            writer = options.writer(folder, manifest, lock)
            if alone:
                if recovery.recover(folder, manifest):
                    write_index(writer.reader, writer.session)
                manifest_file.save(folder, manifest)
                statistics_file.clear(folder, manifest.statistics_checksum)
                if options.shared:
                    locks.share(folder, lock)
            writer.recorder.load()
        except BaseException:
            lock.close()
            raise
    return writer
