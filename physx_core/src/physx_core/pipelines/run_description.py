"""Describes a run's components for the session's ``info.txt``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from physx_core.config import EnvironmentConfig, to_plain
from physx_core.dataset import EPISODES, Dataset
from physx_core.errors import PhysxError
from physx_core.pipelines.learning.learner import Learner


def describe_component(component: object) -> str:
    """Return a component's text, or the name of its class if it defines none."""
    cls = type(component)
    has_text = cls.__str__ is not object.__str__ or cls.__repr__ is not object.__repr__
    return str(component) if has_text else cls.__name__


def describe_training(
    learner: Learner, environment: EnvironmentConfig | None, dataset: Dataset
) -> Mapping[str, str]:
    """Return descriptions of a training's components, by name."""
    return {
        **describe_learner(learner),
        "environment": describe_environment_config(environment),
        "dataset": describe_dataset(dataset),
    }


def describe_learner(learner: Learner) -> Mapping[str, str]:
    """Return descriptions of network, transformation, and any optimization, by name."""
    network = learner.network
    reads, predicts = ", ".join(network.net_fields), ", ".join(network.pred_fields)
    counted = f"{reads} -> {predicts}, {network.nb_parameters():,} parameters"
    found = {
        "network": f"{describe_component(network)}\n{counted}",
        "transformation": describe_component(learner.transformation),
    }
    if learner.optimization is not None:
        found["optimization"] = describe_component(learner.optimization)
    return found


def describe_environment_config(config: EnvironmentConfig | None) -> str:
    """Return the environment's reference and arguments."""
    if config is None:
        return "none"
    plain = to_plain(config)
    arguments = "".join(f"\n{name} = {value}" for name, value in plain["env_kwargs"].items())
    return f"{plain['environment']}{arguments}"


def describe_samples(directory: Path) -> str:
    """Return a line with the number of samples of each mode of a dataset."""
    try:
        with Dataset.open(directory) as dataset:
            modes = [mode for mode in dataset.modes if mode != EPISODES]
            counts = [f"{dataset.num_samples(mode):,} {mode}" for mode in modes]
    except PhysxError as error:  # the run's own error matters more
        return f"samples: {error}"
    return f"samples: {', '.join(counts) or 'none'} in {directory}"


def describe_dataset(dataset: Dataset) -> str:
    """Return a dataset's folder, and the samples and fields of its modes."""
    lines = [str(dataset.directory)]
    for mode in dataset.modes:
        lines.append(f"{mode}: {dataset.num_samples(mode):,} samples")
        for field in dataset.fields(mode).values():
            unit = f" in {field.unit}" if field.unit else ""
            lines.append(f"  {field.name} {field.shape} {field.dtype}{unit}")
    return "\n".join(lines)
