"""Record of the data that a network was trained on, as checkpoints keep and compare it."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import xxh3_64

from physx_core import files
from physx_core.checkpoint import Checkpoint
from physx_core.config import from_plain, read_toml
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, DatasetError
from physx_core.pipelines.storage import GENERATION
from physx_core.typing import Batch
from physx_core.views.batches import Batches
from physx_core.views.dataset_config import DatasetConfig
from physx_core.views.folds import Part
from physx_core.views.view import View

_NOTHING: dict[str, Any] = {"rows": 0, "digest": "none", "partitions": []}


def record_data(datasets: Mapping[str, Dataset], mode: str) -> dict[str, Any]:
    """Return what identifies the rows that a training reads, by mode, from manifests alone.

    Each mode has its number of ``rows``, a ``digest`` of their checksums, and its ``partitions``,
    each with session, number, rows and checksum; a partition that is still written has none.

    Args:
        datasets: The datasets, by the names of `View.sources`, with which theirs begin; a single
            one of the name "" is that of the run.
        mode: Mode of the training samples.
    """
    found = {}
    for source, dataset in datasets.items():
        for name in dict.fromkeys((mode, "validation")):
            if name not in dataset:
                continue
            partitions: list[list[Any]] = [list(each) for each in dataset.contents(name)]
            digest = blake2b(repr(partitions).encode(), digest_size=8).hexdigest()
            rows = sum(each[2] for each in partitions)
            key = f"{name} of {source}" if source else name
            found[key] = {"rows": rows, "digest": digest, "partitions": partitions}
    return found


def describe_batch(number: int, batch: Batch, names: Sequence[str]) -> dict[str, Any]:
    """Return what identifies a batch of stored samples: see `Progress.last_batch`."""
    content = xxh3_64()
    for name in names:
        values = np.ascontiguousarray(batch[name])
        content.update(repr((name, values.dtype.str, values.shape)).encode())
        content.update(files.as_bytes(values))
    return {"number": number, "fields": list(names), "digest": content.hexdigest()}


@contextlib.contextmanager
def open_data(session: Path) -> Iterator[tuple[dict[str, Dataset], DatasetConfig]]:
    """Open the data that a session's networks were trained on; yield them and their options.

    Raises:
        DatasetError: If they are not there.
    """
    file = session / "config.toml"
    recorded = (read_toml(file) if file.is_file() else {}).get("training", {})
    config = from_plain(DatasetConfig, recorded.get("dataset", {}))
    places: dict[str, str | Path] = {each: each for each in config.view.sources}
    places = places or {"": config.existing_dir or session}
    with contextlib.ExitStack() as opened:
        datasets = {n: opened.enter_context(Dataset.open(place)) for n, place in places.items()}
        yield datasets, config


def read_last_batch(
    found: Checkpoint, datasets: Mapping[str, Dataset], config: DatasetConfig
) -> dict[str, Any]:
    """Read the last batch that a network learned from again, and return what identifies it.

    Args:
        found: The network's checkpoint.
        datasets: What it was trained on: see `record_data`.
        config: The options of that.

    Raises:
        DatasetError: If samples are missing.
        ConfigError: If the checkpoint has no such batch.
    """
    progress = found.progress
    if not progress.last_batch:
        raise ConfigError(f"{found.path} does not say which batch of stored samples was its last.")
    number, names = progress.last_batch["number"], progress.last_batch["fields"]
    info = next(iter(datasets.values())).info
    with Batches(
        training_view(config, info, has_validation="validation" in progress.snapshots),
        progress.options["batch_size"],
        progress.seed,
        data=datasets.get(""),
        mode=config.mode,
        snapshot=progress.snapshots[config.mode],
        fields=names,
        dtype=found.network["data_type"],
    ) as batches:
        return describe_batch(number, batches[number], names)


def training_view(
    config: DatasetConfig, info: Mapping[str, Any], *, has_validation: bool, generates: bool = False
) -> View:
    """Return the view of the samples to train on.

    None are held back of those that the training's environments generate, because each is learned
    from as it comes.

    Args:
        config: The options.
        info: The info of the dataset.
        has_validation: Whether the mode ``validation`` has samples; then none are held back.
        generates: Whether environments are about to generate the samples.
    """
    view, is_own = config.view, config.existing_dir is None and not config.view.sources
    is_generated = generates or (is_own and bool(info.get(GENERATION)))
    order = view.order if config.shuffle else "stored"
    holds_back = view.hold_back and not (has_validation or is_generated)
    return replace(view, order=order, hold_back=holds_back)


def unseen_parts(view: View, mode: str, *, has_mode: bool) -> dict[str, tuple[str, View, Part]]:
    """Return the mode, view and part of the samples that a training does not learn from, by name.

    Args:
        view: That of the samples to train on: see `training_view`.
        mode: Their mode.
        has_mode: Whether the mode ``validation`` has the samples for validation.
    """
    plain = replace(view, order="stored", weights=None, drop_last=False)
    found: dict[str, tuple[str, View, Part]] = {}
    if has_mode:
        alone = replace(plain, sources={}, hold_back=False)
        found["validation"] = "validation", alone, "training"
    elif view.hold_back:
        found["validation"] = mode, plain, "validation"
    if view.test_fold is not None:
        found["test"] = mode, plain, "test"
    return found


def describe_record(former: Mapping[str, Any]) -> str:
    """Return a recorded state of the data in words; empty if there is none."""
    parts = (f"{each['rows']:,} {mode} ({each['digest']})" for mode, each in former.items())
    return ", ".join(parts)


def describe_changes(
    former: Mapping[str, Any],
    datasets: Mapping[str, Dataset],
    mode: str,
    fixed: Container[str] = (),
) -> list[str]:
    """Return how the data differ from what a checkpoint recorded; empty if they do not.

    Args:
        former: What `record_data` returned then; empty if an older physx wrote the checkpoint.
        datasets: The datasets now: see `record_data`.
        mode: Mode of the training samples.
        fixed: Modes of which further rows are not read, and so are no difference.
    """
    if not former:
        return []
    try:
        now = record_data(datasets, mode)
        return [
            f"{name}: {text}"
            for name in dict.fromkeys([*former, *now])
            for text in _changes(
                former.get(name, _NOTHING),
                now.get(name, _NOTHING),
                grows=name.partition(" of ")[0] not in fixed,
            )
        ]
    except (DatasetError, LookupError, TypeError, ValueError) as error:
        return [f"they cannot be compared: {error}"]


def warn_of_changes(folder: Path, *data: Any) -> str:
    """Warn if the data are not those that a resumed training had, as then it is another one.

    Args:
        folder: The dataset's folder.
        data: The arguments of `describe_changes`.

    Returns:
        The warning; empty if nothing changed.
    """
    changes = describe_changes(*data)
    if not changes:
        return ""
    text = (
        f"The data in {folder} changed since the checkpoint was written: {'; '.join(changes)}. The "
        "training goes on with the data as they are, so their order, normalization and validation "
        "samples may differ, and the network will not be the one of an uninterrupted training."
    )
    warnings.warn(text, stacklevel=3)
    return text


def _changes(former: Mapping[str, Any], now: Mapping[str, Any], *, grows: bool) -> Iterator[str]:
    before = {(session, index): rest for session, index, *rest in former["partitions"]}
    after = {(session, index): rest for session, index, *rest in now["partitions"]}
    pairs = [(old, after.get(key)) for key, old in before.items()]
    kept = [(old, new) for old, new in pairs if new is not None and new[0] >= old[0]]
    if len(kept) < len(pairs):
        yield f"rows were removed ({former['rows']:,} then, {now['rows']:,} now)"
    elif grows and now["rows"] > former["rows"]:
        yield f"{now['rows'] - former['rows']:,} rows were appended to {former['rows']:,}"
    updated = [old for old, new in kept if old[0] == new[0] and old[1] and old[1] != new[1]]
    if updated:
        many = sum(rows for rows, _ in updated)
        yield f"rows were updated, in partitions of {many:,} rows"
