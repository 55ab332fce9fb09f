"""Contract checks for networks."""

from __future__ import annotations

import dataclasses
import pickletools
import zipfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core import files
from physx_core.components import Network
from physx_core.config import NetworkConfig
from physx_core.errors import CheckpointError, FieldsMismatchError
from physx_core.fields import Field
from physx_testing.learning import ROWS, Case, expect_rows_apart, find_case, parameters_of, predict
from physx_testing.process_state import unchanged
from physx_testing.report import NotApplicableError, Report
from physx_testing.running import TIMEOUT, plain_options, run_checks
from physx_testing.subject import (
    Check,
    Subject,
    expect,
    expect_equal,
    refuses_unknown_options,
)


def check_network(
    component: str | type[Any] | Callable[..., Network],
    *,
    fields: Sequence[Field] = (),
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
    **kwargs: Any,
) -> Report:
    """Check that a network satisfies the contract of `Network`, on the CPU.

    Args:
        component: Its class, a function that returns it, or a reference.
        fields: Its fields, inputs and targets; empty: several shapes are tried.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.
        kwargs: Arguments for its constructor.

    Raises:
        UsageError: If `expected_failures` names an unknown check, or another process cannot find
            the component or receive its arguments.
    """
    return run_checks(
        "network",
        component,
        kwargs,
        options=plain_options(fields=fields),
        expected_failures=expected_failures,
        timeout=timeout,
    )


def _case(subject: Subject) -> Case:
    config = NetworkConfig(subject.reference, network_kwargs=dict(subject.arguments))
    return find_case(config, subject.fields)


def _predicts(subject: Subject) -> None:
    case = _case(subject)
    learner = case.learner()
    network = learner.network
    found = predict(learner, case.batch())
    expect(
        set(found) == set(network.pred_fields),
        f"it predicts {sorted(found)}, but pred_fields are {list(network.pred_fields)}",
    )
    shapes = {field.name: field.shape or () for field in case.fields}
    for name, target in zip(network.pred_fields, network.opt_fields, strict=False):
        wanted = (ROWS, *shapes[target])
        expect(
            found[name].shape == wanted,
            f'"{name}" has the shape {found[name].shape}, but for {ROWS} samples of "{target}" it '
            f"must be {wanted}",
        )
        expect(np.isfinite(found[name]).all(), f'"{name}" holds NaN or infinity')


def _rows_apart(subject: Subject) -> None:
    case = _case(subject)
    expect_rows_apart(case.learner(), case.batch())


def _twice(subject: Subject) -> None:
    case = _case(subject)
    learner, batch = case.learner(), case.batch()
    first = predict(learner, batch)
    expect_equal(predict(learner, batch), first, "a second prediction in evaluation mode differs")
    learner.network.set_train()
    learner.network.set_eval()
    expect_equal(
        predict(learner, batch), first, "after set_train() and set_eval() a prediction differs"
    )


def _keeps_inputs(subject: Subject) -> None:
    case = _case(subject)
    learner, batch = case.learner(), case.batch()
    network = learner.network
    given = network.numpy_to_tensor({name: np.array(values) for name, values in batch.items()})
    read = learner.transformation.transform_before_prediction(given)
    before = {n: np.array(v) for n, v in network.tensor_to_numpy(dict(read)).items()}
    network.predict(read)
    expect_equal(network.tensor_to_numpy(dict(read)), before, "predict() changed its inputs")


def _seeded(subject: Subject) -> None:
    case = _case(subject)
    first = parameters_of(case.learner().network)
    again = parameters_of(case.learner().network)
    expect_equal(again, first, "with the same seed its first parameters differ")


def _stores(subject: Subject) -> None:
    case = _case(subject)
    learner, batch = case.learner(), case.batch()
    path = subject.folder / learner.network.parameters_file
    learner.network.save_parameters(path)
    expect(path.is_file(), "save_parameters() wrote no file")
    other = case.learner(seed=99)
    other.network.load_parameters(path)
    expect_equal(
        parameters_of(other.network),
        parameters_of(learner.network),
        "parameters that were saved and loaded differ",
    )
    expect_equal(
        predict(other, batch),
        predict(learner, batch),
        "with parameters that were saved and loaded it predicts differently: something that it "
        "needs is not among them",
    )


def _holds_no_code(subject: Subject) -> None:
    learner = _case(subject).learner()
    path = subject.folder / learner.network.parameters_file
    learner.network.save_parameters(path)
    expect(
        not _is_pickle(path.read_bytes()),
        "its parameters are pickled, and a pickle can run any code: write an npz or safetensors "
        "file",
    )
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                content = archive.read(name)
                is_objects = content.startswith(b"\x93NUMPY") and b"'|O'" in content[:256]
                expect(
                    not is_objects and not _is_pickle(content),
                    f'its parameters contain a pickle, "{name}", which can run any code',
                )


def _is_pickle(content: bytes) -> bool:
    if not content.startswith(b"\x80"):
        return False
    try:
        names = [opcode.name for opcode, _, _ in pickletools.genops(content)]
    except Exception:  # it is something else
        return False
    return names[-1] == "STOP"


def _refuses_damaged(subject: Subject) -> None:
    case = _case(subject)
    network = case.learner().network
    path = subject.folder / network.parameters_file
    network.save_parameters(path)
    half = path.read_bytes()[: path.stat().st_size // 2]
    damaged = subject.folder / "damaged"
    files.replace(damaged, half)
    for file, what in ((damaged, "half of a file"), (subject.folder / "none", "a missing file")):
        try:
            case.learner().network.load_parameters(file)
        except CheckpointError:
            continue
        except Exception as error:
            raise AssertionError(
                f"load_parameters() of {what} raised {type(error).__name__}: {error}; it must "
                "raise CheckpointError"
            ) from error
        raise AssertionError(f"load_parameters() accepted {what}")


def _needs_fields(subject: Subject) -> None:
    case = _case(subject)
    kept = [field for field in case.fields if field.name not in case.network_fields[:1]]
    try:
        dataclasses.replace(case, fields=kept).learner()
    except FieldsMismatchError:
        return
    raise AssertionError(
        f'bind() accepted fields without "{case.network_fields[0]}", which it reads: call '
        "super().bind(fields)"
    )


def _types(subject: Subject) -> None:
    case = _case(subject)
    config = dataclasses.replace(case.config, data_type="float64")
    learner = dataclasses.replace(case, config=config).learner()
    for name, values in predict(learner, case.batch()).items():
        if values.dtype.kind == "f":
            expect(
                values.dtype == np.float64,
                f'told to compute in float64, it predicts "{name}" in {values.dtype}',
            )


def _finite(subject: Subject) -> None:
    network = _case(subject).learner().network
    expect(not network.find_not_finite(), f"its {network.find_not_finite()} is not finite")
    total = sum(
        values.size * (2 if values.dtype.kind == "c" else 1)
        for values in parameters_of(network).values()
    )
    counted = network.nb_parameters()
    expect(counted == total, f"nb_parameters() says {counted}, but there are {total}")
    if not total:
        raise NotApplicableError("it has no parameters")


def _quiet(subject: Subject) -> None:
    case = _case(subject)
    predict(case.learner(), case.batch())
    with unchanged(subject.before):
        predict(case.learner(), case.batch())


CHECKS: dict[str, Check] = {
    "refuses unknown options": refuses_unknown_options,
    "predicts each of its fields, in the shape of its target": _predicts,
    "predicts a sample the same alone and in a batch": _rows_apart,
    "predicts the same again": _twice,
    "does not change its inputs": _keeps_inputs,
    "begins with the same parameters for the same seed": _seeded,
    "has finite parameters, and counts them": _finite,
    "saves and loads everything it predicts with": _stores,
    "saves its parameters without code": _holds_no_code,
    "refuses damaged and missing parameters": _refuses_damaged,
    "refuses fields that it cannot read": _needs_fields,
    "computes in the requested type": _types,
    "leaves its process as it was": _quiet,
}
