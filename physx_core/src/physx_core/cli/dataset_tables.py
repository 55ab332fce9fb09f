"""Prints the contents of a dataset as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.cli.output import show, show_table
from physx_core.config import read_toml
from physx_core.dataset import EPISODES, Dataset, Progress
from physx_core.dataset.read.episodes import episode_lengths
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import CHANNEL, Field
from physx_core.normalization import Normalization
from physx_core.typing import Array

_SMALL = 9
"""Largest number of components that are shown on separate lines."""


def print_dataset(place: Path, *, verify: bool) -> None:
    """Print the origin, the fields, trajectories, and normalization of each mode, and integrity.

    Args:
        place: A session's or a dataset's folder.
        verify: Whether to check every byte, not only sizes and headers.
    """
    with Dataset.open(place) as dataset:
        rows = dataset.describe()
        total = sum(row["bytes"] for row in rows)
        show(f"dataset {dataset.directory}: {size(total)}")
        for line in _origin(dataset):
            show(line)
        for mode in dict.fromkeys(row["mode"] for row in rows):
            show()
            _print_mode(dataset, mode, [row for row in rows if row["mode"] == mode])
        if not rows:
            show("  no samples")
        show()
        _print_integrity(dataset, content=verify)


def size(nbytes: float) -> str:
    """Return a number of bytes as human-readable text."""
    for unit in ("B", "kB", "MB", "GB"):
        if nbytes < 1000:
            return f"{nbytes:.3g} {unit}"
        nbytes /= 1000
    return f"{nbytes:.3g} TB"


def count(number: int, what: str) -> str:
    """Return a number and a noun as human-readable text."""
    return f"{number:,} {what}" + ("" if number == 1 else "s")


def _origin(dataset: Dataset) -> list[str]:
    shown = ("environment", "env_kwargs", "num_clients", "seed", "imported_from")
    lines = [
        f"  {key}: {dataset.info[key]}" for key in shown if dataset.info.get(key) not in (None, {})
    ]
    versions = ", ".join(f"{name} {version}" for name, version in dataset.versions.items())
    return [*lines, f"  created with: {versions}"]


def _print_mode(dataset: Dataset, mode: str, rows: Sequence[dict[str, Any]]) -> None:
    nbytes, partitions = sum(row["bytes"] for row in rows), rows[0]["partitions"]
    what = "record" if mode == EPISODES and dataset.has_episodes else "sample"
    samples, files = count(rows[0]["samples"], what), count(partitions, "partition")
    show(f"{mode}: {samples}, {size(nbytes)} in {files}")
    try:
        stored = dataset.num_samples(mode)
        _print_progress(dataset, mode)
        if stored:
            show(f"  shuffled by default: {dataset.default_order(mode)}")
            _print_episodes(dataset, mode)
    except DatasetError as error:
        show(f"  damaged: {error}")
        stored = 0
    likes = ["like"] if any(row["like"] for row in rows) else []
    show_table(
        ["field", "role", "type", "shape", "size", "unit", *likes],
        [
            [
                row["field"],
                row["role"],
                row["dtype"],
                _shape(row["shape"], row["axes"]),
                size(row["bytes"]),
                row["unit"],
                *(row[name] for name in likes),
            ]
            for row in rows
        ],
        indent=2,
    )
    if stored and mode != EPISODES:
        _print_normalization(dataset, mode)


def _print_episodes(dataset: Dataset, mode: str) -> None:
    view = dataset[mode]
    if mode == EPISODES or ("step" not in view and "episode" not in view):
        return
    lengths, instances = episode_lengths(view.rows)
    least, most = lengths.min(), lengths.max()
    steps = f"{least:,}" if least == most else f"{least:,} to {most:,}"
    of = count(instances, "instance")
    show(f"  trajectories: {len(lengths):,} of {of}, {steps} samples each")


def _print_progress(dataset: Dataset, mode: str) -> None:
    """Print how many episodes of each campaign have ended, and when the last one will have."""
    config = _generation(dataset.directory.parent / "config.toml", mode)
    campaigns = dataset.progress(mode)
    for each in campaigns:
        now = config if each is campaigns[-1] else {}
        wanted = now.get("episodes") or 0
        of = f" of {wanted:,}" if wanted else ""
        ends = ((name, getattr(each, name)) for name in ("failed", "cut", "unfinished"))
        others = "".join(f", {number:,} {name}" for name, number in ends if number)
        counts = f"{each.finished:,}{of} finished{others}"
        show(f"  independent episodes of campaign {each.campaign}: {counts}")
        if each.ended:
            missing = max(0, wanted - each.finished - each.failed)
            show(f"    {_rate(each, now, missing, dataset.is_written)}")


def _rate(progress: Progress, config: Mapping[str, Any], missing: int, is_running: bool) -> str:
    """Return what an episode costs, and how long the missing ones will take or that they are."""
    mean, text = progress.mean, f"{duration(progress.mean)} each"
    environment = config.get("environment", {})
    clients = environment.get("num_clients", 1) if environment.get("as_tcp_ip_client") else 1
    if mean and clients > 1:
        text += f", {60 * clients / mean:.3g} per min by {clients} clients"
    if missing and is_running:
        text += f"; about {duration(missing * mean / clients)} left at the rate so far"
    elif missing:
        text += f"; {missing:,} missing: go on with physx generate SESSION --resume"
    return text


def _generation(path: Path, mode: str) -> dict[str, Any]:
    """Return how a session's last generation was configured, if it was one of this mode."""
    try:
        config = read_toml(path).get("data_generation", {})
    except (OSError, ConfigError):
        return {}
    return config if config.get("dataset", {}).get("mode", "training") == mode else {}


def duration(seconds: float) -> str:
    """Return a time as human-readable text."""
    for limit, divisor, unit in ((1, 1e-3, "ms"), (100, 1, "s"), (6000, 60, "min")):
        if seconds < limit:
            return f"{seconds / divisor:.3g} {unit}"
    return f"{seconds / 3600:.3g} h"


def _shape(shape: tuple[int, ...] | None, axes: tuple[str, ...]) -> str:
    """Return a shape as text, with the names of its axes."""
    if shape is None:
        return f"open: {', '.join(axes)}" if axes else "open"
    if not axes:
        return str(shape)
    return ", ".join(f"{name} {size}" for name, size in zip(axes, shape, strict=True))


def _print_normalization(dataset: Dataset, mode: str) -> None:
    try:
        found = dataset.normalization_of(mode)
    except DatasetError as error:
        show(f"  normalization: {error}")
        return
    fields = dataset.fields(mode)
    lines = [line for name, item in found.items() for line in _components(fields[name], item)]
    if lines:
        show()
        numbers = ("mean", "std", "min", "max")
        show_table(["normalization", "component", *numbers], lines, numbers=numbers, indent=2)


def _components(field: Field, item: Normalization) -> list[list[str]]:
    """Return a field's table rows: one for each component, or one with ranges over all."""
    name, columns = field.name, [item.mean, item.std, item.minimum, item.maximum]
    if item.mean.size > _SMALL:
        return [[name, f"all {item.mean.size}", *(_range(column) for column in columns)]]
    return [
        [name, _place(field, place), *(_number(column, place) for column in columns)]
        for place in np.ndindex(item.mean.shape)
    ]


def _place(field: Field, place: tuple[int, ...]) -> str:
    """Return which components of a field have some statistics."""
    if not field.pooled:
        return ", ".join(str(index) for index in place)
    return f"{CHANNEL} {place[0]}" if place else "all"


def _number(values: Array | None, place: tuple[int, ...]) -> str:
    return "?" if values is None else f"{values[place]:.4g}"


def _range(values: Array | None) -> str:
    return "?" if values is None else f"{values.min():.3g} … {values.max():.3g}"


def _print_integrity(dataset: Dataset, *, content: bool) -> None:
    problems = dataset.verify(content=content)
    what = "every byte was checked" if content else "sizes and headers; --verify checks every byte"
    found = count(len(problems), "problem") if problems else "sound"
    show(f"integrity: {found} ({what})")
    for text in problems:
        show(f"  {text}")
