"""Options that a training keeps when it is resumed, and those that a resume may change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from physx_core.config import to_plain
from physx_core.errors import ConfigError
from physx_core.pipelines.storage import EPISODE_OPTIONS
from physx_core.plugins.references import is_recorded_as
from physx_core.views.dataset_config import DatasetConfig

_FREE = {
    "": {
        *("session_dir", "session_name", "new_session", "epoch_nb"),
        *("validation_every", "validation_batch_size", "patience", "min_improvement"),
        *("on_nan", "statistics", "statistics_kwargs", "histograms_every", "checkpoint_every"),
        *("max_failed", "rivals", "metrics"),
    },
    "network": {"network_name", "save_each_epoch", "save_best", "device"},
    "dataset": {"existing_dir", "max_file_size", "writers"},
}
"""Options that a resume may change, by table; new options are bound unless they are named here."""
_TABLES = ("network", "dataset", "dataset.view", "environment")
_REFERENCES = {
    *("network", "optimization", "transformation", "loss", "optimizer", "scheduler"),
    *("online", "environment", "sampler"),
}


def bound_options(training: Any, seed: int, processes: int) -> dict[str, Any]:
    """Return what a training's parameters and the order of its batches depend on, as plain data.

    Args:
        training: The pipeline.
        seed: Its seed.
        processes: Number of processes; `batch_size` is that of all of them together.
    """
    plain = to_plain(training)
    configs = {
        "network": training.network_config,
        "dataset": training.dataset_config or DatasetConfig(),
    }
    found = {name: value for name, value in plain.items() if not name.endswith("_config")}
    found = {name: value for name, value in found.items() if name not in _FREE[""]}
    found |= {"seed": seed, "batch_size": training.batch_size * processes}
    for table, config in configs.items():
        options = to_plain(config)
        found[table] = {n: value for n, value in options.items() if n not in _FREE[table]}
    if "environment_config" in plain:
        options = plain["environment_config"]
        found["environment"] = {n: options[n] for n in EPISODE_OPTIONS if n in options}
    return found


def check_bound(session: Path, former: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that a resumed training has the options that it was started with.

    Args:
        session: The training's session.
        former: What `bound_options` returned when the checkpoint was written; empty if an older
            physx wrote it.
        now: What it returns now.

    Raises:
        ConfigError: If options differ; it names all of them.
    """
    if not former:
        return
    now = {**now}
    if "environment" not in former or "environment" not in now:
        # An environment may be left out once it has generated all samples.
        former = {name: value for name, value in former.items() if name != "environment"}
        now.pop("environment", None)
    found = list(_differences(former, now))
    if found:
        raise ConfigError(
            f"The training in {session} cannot be resumed with other options: {'; '.join(found)}. "
            f"Leave them as they were (physx train {session} --resume takes all from the session), "
            f"or start a new training from its network: NetworkConfig.network_dir={str(session)!r} "
            f"(--network.network-dir {session})."
        )


def _differences(
    former: Mapping[str, Any], now: Mapping[str, Any], table: str = ""
) -> Iterator[str]:
    for name in dict.fromkeys([*former, *now]):
        before, after = former.get(name), now.get(name)
        is_table = f"{table}{name}" in _TABLES
        if is_table and isinstance(before, Mapping) and isinstance(after, Mapping):
            yield from _differences(before, after, f"{table}{name}.")
        elif not _is_same(name, before, after):
            yield f"{table}{name} was {before!r} and is now {after!r}"


def _is_same(name: str, before: Any, after: Any) -> bool:
    """Return whether two values of an option mean the same."""
    if before == after or name not in _REFERENCES or None in (before, after):
        return bool(before == after)
    if isinstance(before, Mapping) or isinstance(after, Mapping):  # losses by name
        both = isinstance(before, Mapping) and isinstance(after, Mapping)
        return (
            both
            and before.keys() == after.keys()
            and all(_is_same(name, each, after[key]) for key, each in before.items())
        )
    return is_recorded_as(after, before) or _last_name(before) == _last_name(after)


def _last_name(reference: Any) -> str:
    """Return the name of a class, which a library's class and its short name share."""
    return str(reference).rpartition(":")[2].rpartition(".")[2]
