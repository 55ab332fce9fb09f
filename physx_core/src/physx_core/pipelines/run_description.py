"""What a run is made of, in words, for the session's ``info.txt``."""

from __future__ import annotations

from collections.abc import Mapping

from physx_core.config import EnvironmentConfig, to_plain
from physx_core.dataset import Dataset
from physx_core.pipelines.learner import Learner


def described(component: object) -> str:
    """Return what a component says of itself, or its class's name where it says nothing."""
    cls = type(component)
    silent = cls.__str__ is object.__str__ and cls.__repr__ is object.__repr__
    return cls.__name__ if silent else str(component)


def describe_training(
    learner: Learner, environment: EnvironmentConfig | None, dataset: Dataset
) -> Mapping[str, str]:
    """Return the components of a training by name."""
    return {
        **describe_learner(learner),
        "environment": describe_environment_config(environment),
        "dataset": describe_dataset(dataset),
    }


def describe_learner(learner: Learner) -> Mapping[str, str]:
    """Return network, transformation, and, where there is one, optimization by name."""
    network = learner.network
    reads, predicts = ", ".join(network.net_fields), ", ".join(network.pred_fields)
    counted = f"{reads} -> {predicts}, {network.nb_parameters():,} parameters"
    found = {
        "network": f"{described(network)}\n{counted}",
        "transformation": described(learner.transformation),
    }
    if learner.optimization is not None:
        found["optimization"] = described(learner.optimization)
    return found


def describe_environment_config(config: EnvironmentConfig | None) -> str:
    """Return the environment's reference and arguments."""
    if config is None:
        return "none"
    plain = to_plain(config)
    arguments = "".join(f"\n{name} = {value}" for name, value in plain["env_kwargs"].items())
    return f"{plain['environment']}{arguments}"


def describe_dataset(dataset: Dataset) -> str:
    """Return where a dataset is, and what it holds now."""
    lines = [str(dataset.directory)]
    for mode in dataset.modes:
        lines.append(f"{mode}: {dataset.num_samples(mode):,} samples")
        for field in dataset.fields(mode).values():
            unit = f" in {field.unit}" if field.unit else ""
            lines.append(f"  {field.name} {field.shape} {field.dtype}{unit}")
    return "\n".join(lines)
