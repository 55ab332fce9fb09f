"""Checkpoint: a folder with a network's parameters and everything that is needed to use them.

``checkpoint.toml`` names the network, its transformation, its fields and their normalization; the
network's library writes the parameters beside it. Nothing in it is code.

The checkpoints of a training are numbered in the order of writing; it can be resumed from the last.
Beside them is ``<name>_best``, the network of the epoch with the smallest loss.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.config import NetworkConfig, read_toml, to_plain, write_toml
from physx_core.errors import CheckpointError, ConfigFileError, listed
from physx_core.fields import Field
from physx_core.statistics import Normalization

FORMAT_VERSION = 1
BEST = "best"
DESCRIPTION = "checkpoint.toml"
_KEPT = (
    "network",
    "network_kwargs",
    "transformation",
    "transformation_kwargs",
    "data_type",
)


@dataclass(frozen=True)
class Progress:
    """Progress of a training when its checkpoint was written.

    Attributes:
        epoch: Number of finished epochs.
        batch: Number of finished batches of the next epoch.
        batches_read: Number of batches read from the dataset, in all epochs.
        seed: Seed of the training.
        best: State of `BestEpoch`.
        record: State of `TrainingRecord`.
    """

    epoch: int
    batch: int
    batches_read: int
    seed: int
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
    """

    path: Path
    network: dict[str, Any]
    fields: dict[str, Field]
    normalization: dict[str, Normalization]
    progress: Progress


def list_numbers(network_dir: Path, name: str) -> list[int]:
    """Return the sorted numbers of the checkpoints of one name in a folder."""
    pattern = re.compile(re.escape(name) + r"_(\d+)")
    if not network_dir.is_dir():
        return []
    found = (pattern.fullmatch(p.name) for p in network_dir.iterdir() if (p / DESCRIPTION).exists())
    return sorted(int(match[1]) for match in found if match)


def save(
    network_dir: Path,
    config: NetworkConfig,
    network: Network,
    optimization: Optimization,
    fields: Mapping[str, Field],
    normalization: Mapping[str, Normalization],
    progress: Progress,
    *,
    best: bool = False,
) -> Path:
    """Write the next checkpoint ``<network_name>_<number>`` and return its folder.

    It appears under its name only when it is complete.

    Args:
        network_dir: Folder of the checkpoints.
        config: Configuration of network and transformation.
        network: The network, whose parameters are written.
        optimization: The optimization, whose state is written so that training can resume.
        fields: The dataset's fields.
        normalization: Normalization of the transformation.
        progress: Progress of the training.
        best: Replace ``<network_name>_best``, to predict with or to start from, without the state
            that a resumed training needs.
    """
    number = max(list_numbers(network_dir, config.network_name), default=-1) + 1
    path = network_dir / f"{config.network_name}_{BEST if best else number}"
    partial = network_dir / f".{path.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    network.save_parameters(partial / network.parameters_file)
    if optimization.state_file and not best:
        optimization.save_state(partial / optimization.state_file)
    used = [name for name in (*network.net_fields, *network.opt_fields) if name in fields]
    plain = to_plain(config)
    write_toml(
        partial / DESCRIPTION,
        {
            "format_version": FORMAT_VERSION,
            "progress": dataclasses.asdict(progress),
            **{key: plain[key] for key in _KEPT if key in plain},
            "fields": [fields[name].to_dict() for name in dict.fromkeys(used)],
            "normalization": {
                name: normalization[name].to_dict() for name in used if name in normalization
            },
        },
    )
    _replace(partial, path)
    return path


def _replace(partial: Path, path: Path) -> None:
    former = path.with_name(f".{path.name}.former")
    shutil.rmtree(former, ignore_errors=True)
    if path.exists():
        path.rename(former)
    partial.rename(path)
    shutil.rmtree(former, ignore_errors=True)


def find(place: Path, name: str, which: int | str) -> Path:
    """Return the folder of a checkpoint.

    Args:
        place: A session's folder, its network folder, or a checkpoint's own folder.
        name: Name of the network.
        which: Number of the checkpoint; -1: the last; ``"best"``: the one with the smallest loss.

    Raises:
        CheckpointError: If there is no such checkpoint; the message lists the existing ones.
    """
    if (place / DESCRIPTION).exists():
        return place
    folder = place / "network" if (place / "network").is_dir() else place
    known: list[int | str] = [*list_numbers(folder, name)]
    if which == BEST and (folder / f"{name}_{BEST}" / DESCRIPTION).exists():
        known.append(BEST)
    if not known or which not in (-1, *known):
        there = [p.name for p in folder.iterdir() if p.is_dir()] if folder.is_dir() else []
        wanted = f"{name}_<number>" if which == -1 else f"{name}_{which}"
        raise CheckpointError(
            f'There is no checkpoint "{wanted}" in {folder}. There are: {listed(there)}.'
        )
    return folder / f"{name}_{known[-1] if which == -1 else which}"


def read(path: Path) -> Checkpoint:
    """Return the description of a checkpoint.

    Raises:
        CheckpointError: If the description is missing, damaged or of a later format.
    """
    try:
        plain = read_toml(path / DESCRIPTION)
        if plain["format_version"] > FORMAT_VERSION:
            raise CheckpointError(
                f"{path} has format version {plain['format_version']}; this physx reads up to "
                f"{FORMAT_VERSION}. Install a newer physx-core."
            )
        fields = [Field.from_dict(item) for item in plain["fields"]]
        normalization = plain.get("normalization", {})
        return Checkpoint(
            path=path,
            network={key: plain[key] for key in _KEPT if key in plain},
            fields={item.name: item for item in fields},
            normalization={n: Normalization.from_dict(c) for n, c in normalization.items()},
            progress=Progress(**plain["progress"]),
        )
    except (ConfigFileError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} is not a readable checkpoint: {error}.") from error
