"""Contract checks for transformations."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components import Transformation
from physx_core.config import NetworkConfig
from physx_core.fields import Field
from physx_core.pipelines import Learner
from physx_core.typing import Batch, Tensors
from physx_testing.learning import TOLERANCE, Case, expect_rows_apart, find_case
from physx_testing.process_state import unchanged
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, plain_options, run_checks
from physx_testing.subject import (
    Check,
    Subject,
    expect,
    expect_close,
    expect_equal,
    refuses_unknown_options,
)

_LINEAR = "physx_testing.linear:LinearNetwork"


def check_transformation(
    component: str | type[Any] | Callable[..., Transformation],
    *,
    network: NetworkConfig | None = None,
    fields: Sequence[Field] = (),
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a transformation satisfies the contract of `Transformation`, on the CPU.

    Args:
        component: Its class, a function that returns it, or a reference.
        network: The network to use it with; None: a linear one in NumPy.
        fields: Fields of the network, inputs and targets; empty: several shapes are tried.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "transformation",
        component,
        kwargs,
        options=plain_options(fields=fields, network=network),
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _case(subject: Subject) -> Case:
    config = subject.network or NetworkConfig(_LINEAR)
    config = dataclasses.replace(
        config, transformation=subject.reference, transformation_kwargs=dict(subject.arguments)
    )
    try:
        return find_case(config, subject.fields)
    except NotApplicableError as error:
        if subject.network is not None:
            raise
        raise NotApplicableError(
            f"it needs a network from its own library: specify one ({error})"
        ) from error


def _arrays(learner: Learner, tensors: Tensors) -> Batch:
    return {n: np.array(v) for n, v in learner.network.tensor_to_numpy(dict(tensors)).items()}


def _tensors(learner: Learner, batch: Batch, names: Sequence[str]) -> Tensors:
    return learner.network.numpy_to_tensor({name: np.array(batch[name]) for name in names})


def _inverts_plain(subject: Subject) -> None:
    _invert(_case(subject), normalized=False)


def _inverts_normalized(subject: Subject) -> None:
    _invert(_case(subject), normalized=True)


def _invert(case: Case, *, normalized: bool) -> None:
    """Compare a prediction with itself in physical units as target; the two must match."""
    learner = case.learner(normalized=normalized)
    network, transformation = learner.network, learner.transformation
    inputs = _tensors(learner, case.batch(), network.net_fields)
    raw = network.predict(transformation.transform_before_prediction(inputs))
    kept = network.numpy_to_tensor(_arrays(learner, raw))
    physical = _arrays(learner, transformation.transform_before_apply(kept))
    pairs = list(zip(network.pred_fields, network.opt_fields, strict=False))
    targets = network.numpy_to_tensor({opt: physical[pred] for pred, opt in pairs})
    compared = transformation.transform_before_loss(raw, targets)
    predicted, wanted = (_arrays(learner, one) for one in compared)
    for pred, opt in pairs:
        expect_close(
            predicted[pred],
            wanted[opt],
            TOLERANCE,
            f'a target that equals the prediction "{pred}" in physical units compares as '
            "different: transform_before_apply() does not undo transform_before_loss()",
        )


def _normalizes(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(normalized=True)
    normalization = learner.transformation.normalization
    mine = {*learner.network.net_fields, *learner.network.opt_fields}
    expect(
        set(normalization) == mine,
        f"after set_normalization() its normalization has {sorted(normalization)}, not "
        f"{sorted(mine)}, so checkpoints would lose it: call super().set_normalization()",
    )
    for name, item in normalization.items():
        given = case.normalization[name]
        expect(
            np.array_equal(item.mean, given.mean) and np.array_equal(item.std, given.std),
            f'after set_normalization() its normalization of "{name}" is a different one',
        )


def _again(subject: Subject) -> None:
    case = _case(subject)
    first = case.learner(normalized=True)
    second = case.learner(normalized=False)
    second.normalize(case.normalization)
    second.normalize(case.normalization)
    batch = case.batch()
    found, wanted = (
        {n: np.array(v) for n, v in learner.predict(batch).items()} for learner in (second, first)
    )
    expect_equal(found, wanted, "predictions differ after a second call of set_normalization()")


def _keeps(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner(normalized=True)
    network, transformation = learner.network, learner.transformation
    batch = case.batch()
    inputs = _tensors(learner, batch, network.net_fields)
    targets = _tensors(learner, batch, network.opt_fields)
    before = _arrays(learner, inputs), _arrays(learner, targets)
    raw = network.predict(transformation.transform_before_prediction(inputs))
    predicted = _arrays(learner, raw)
    transformation.transform_before_loss(raw, targets)
    transformation.transform_before_apply(raw)
    for tensors, wanted, method in (
        (inputs, before[0], "transform_before_prediction() changed its data"),
        (targets, before[1], "transform_before_loss() changed the targets"),
        (raw, predicted, "transform_before_loss() or _apply() changed the prediction"),
    ):
        expect_equal(_arrays(learner, tensors), wanted, method)


def _rows(subject: Subject) -> None:
    case = _case(subject)
    expect_rows_apart(case.learner(normalized=True), case.batch())


def _quiet(subject: Subject) -> None:
    case = _case(subject)
    case.learner(normalized=True).predict(case.batch())
    with unchanged(subject.before):
        case.learner(normalized=True).predict(case.batch())


CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    "converts predictions back to physical units": _inverts_plain,
    "converts normalized predictions back to physical units": _inverts_normalized,
    "keeps its normalization for checkpoints": _normalizes,
    "accepts a second normalization": _again,
    "does not change what it transforms": _keeps,
    "transforms a sample the same alone and in a batch": _rows,
    "leaves its process as it was": _quiet,
}
