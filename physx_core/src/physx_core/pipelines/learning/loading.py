"""Loads a session's trained network, with what its checkpoint and the user say of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physx_core import checkpoint
from physx_core.components.network import Network
from physx_core.config import NetworkConfig, merge_arguments
from physx_core.errors import CheckpointError, ConfigError, PhysxError
from physx_core.pipelines.learning.learner import Learner
from physx_core.plugins import create_network
from physx_core.plugins.networks import resolve_network
from physx_core.plugins.references import check_recorded, is_of_plugin, is_recorded_as


def load_learner(
    folder: str | Path, config: NetworkConfig | None = None, *, trust: bool = False
) -> Learner:
    """Return a session's trained network, ready to predict.

    A checkpoint may only name components of installed plugins. Name any other network, such as your
    own class, in `config`. If it is the checkpoint's network, it gets the checkpoint's arguments,
    except those given in `config`, which may be some of those in a nested table. The same applies
    to the transformation.

    Args:
        folder: The folder of the session, of its checkpoints, or of one checkpoint.
        config: The checkpoint to load, and options that replace its own; None: the last one.
        trust: Whether to import whatever code the checkpoint names.

    Raises:
        CheckpointError: If there is no checkpoint, or it is damaged or belongs to another network.
        UntrustedReferenceError: If it names other code that is neither trusted nor named in
            `config`.
        FieldsMismatchError: If the network reads other fields.
    """
    config = config or NetworkConfig()
    place = Path(config.network_dir or folder)
    found = checkpoint.find(place, config.network_name, config.which_network)
    chosen = {"data_type": found.network.get("data_type", config.data_type)}
    for kind in ("network", "transformation"):
        chosen |= _choose(kind, found, config, trust)
    try:
        merged = dataclasses.replace(config, **chosen)
    except ConfigError as error:  # not from the user's options, which are valid
        raise CheckpointError(
            f"{found.path / checkpoint.DESCRIPTION} is invalid: {error}"
        ) from error
    network = None if config.network else _create_recorded(merged, found, config.network_kwargs)
    learner = Learner(merged, trains=False, network=network)
    used, recorded = learner.config.transformation, found.network.get("transformation")
    if config.transformation is None and recorded and not is_recorded_as(used, recorded):
        _check("transformation", found, recorded, {}, trust)
    learner.bind(found.fields, found.normalization)
    learner.load_parameters(found)
    learner.network.set_eval()
    return learner


def _create_recorded(
    config: NetworkConfig, found: checkpoint.Checkpoint, given: Mapping[str, Any]
) -> Network:
    """Create the network that a checkpoint names, with its arguments and those given."""
    try:
        make, arguments = resolve_network(config.network, config.network_kwargs)
        if isinstance(make, type) and issubclass(make, Network):
            make.check_arguments(arguments, found.path / make.parameters_file)
        return create_network(config)
    except Exception as error:  # a component may raise anything for arguments of a damaged file
        if isinstance(error, PhysxError) and (given or not isinstance(error, ConfigError)):
            raise
        raise CheckpointError(
            f'{found.path / checkpoint.DESCRIPTION} describes a "{config.network}" that cannot be '
            f"created: {str(error).removesuffix('.')}."
        ) from error


def _choose(
    kind: str, found: checkpoint.Checkpoint, config: NetworkConfig, trust: bool
) -> dict[str, Any]:
    """Return a component's reference and arguments: the user's, else the checkpoint's."""
    given, own = getattr(config, kind), getattr(config, f"{kind}_kwargs")
    reference = found.network.get(kind)
    arguments = found.network.get(f"{kind}_kwargs", {})
    if given is not None and not is_recorded_as(given, reference):
        return {kind: given, f"{kind}_kwargs": own}
    arguments = _without(arguments, own)
    is_code = ":" in str(reference) and not is_of_plugin(kind, reference)
    if kind == "transformation" and is_code and not trust:
        reference = None  # it may be the network's default
    _check(kind, found, reference if given is None else None, arguments, trust)
    return {kind: given or reference, f"{kind}_kwargs": merge_arguments(arguments, own)}


def _without(arguments: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a checkpoint that the user does not replace."""
    kept = {}
    for name, value in arguments.items():
        own = given.get(name)
        if isinstance(own, Mapping) and isinstance(value, Mapping):
            kept[name] = _without(value, own)
        elif name not in given:
            kept[name] = value
    return kept


def _check(
    kind: str, found: checkpoint.Checkpoint, reference: Any, arguments: Any, trust: bool
) -> None:
    advice = f"--network.{kind} REFERENCE (in Python NetworkConfig({kind}=...)), with its arguments"
    file = found.path / checkpoint.DESCRIPTION
    check_recorded(kind, file, reference, arguments, advice, trust=trust)
