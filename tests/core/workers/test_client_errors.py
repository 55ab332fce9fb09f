"""ClientSource: errors of an environment are those of LocalSource."""

from __future__ import annotations

import re

import numpy as np
import pytest

from physx_core.errors import (
    EnvironmentFailedError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    NotFiniteError,
    UnknownFieldError,
    UnknownOptionError,
    WrongSamplesError,
)


@pytest.fixture
def errors_of(local, simulated):
    """Return the errors of both sources, and how many rows each gave before."""

    def run(make, environment, sizes, options):
        rows = 0
        with pytest.raises(Exception) as caught, make(environment, **options) as source:
            for size in sizes:
                rows += len(source.batch(size)["step"])
        return caught.value, rows

    def errors(environment, sizes, **options):
        return [run(make, environment, sizes, options) for make in (local, simulated)]

    return errors


@pytest.mark.parametrize("method", ["__init__", "create", "init_database", "step", "close"])
def test_client_exception_has_location_and_traceback(errors_of, method):
    kwargs = {"what": "fail", "method": method, "who": 2}
    (local, rows), (error, client_rows) = errors_of(
        "Trouble", [4, 4], num_clients=2, env_kwargs=kwargs
    )
    assert type(error) is type(local) is EnvironmentFailedError
    assert str(error) == str(local)
    assert (error.instance_id, error.method) == (2, method)
    assert error.step == local.step
    assert 'raise RuntimeError("no more beans")' in error.remote_traceback
    assert rows == client_rows


@pytest.mark.parametrize("method", ["__init__", "create", "step"])
def test_physx_error_of_client_keeps_its_type(errors_of, method):
    kwargs = {"what": "fail_known", "method": method}
    (local, _), (error, _) = errors_of("Trouble", [8], env_kwargs=kwargs)
    assert type(error) is type(local) is FieldShapeError
    assert str(error) == str(local)
    assert vars(error) == vars(local)
    note, where = error.__notes__
    assert note == "a note"
    line = r"worker_envs\.py:\d+: raise error"
    assert re.fullmatch(rf"in {method}\(\) of instance 1, at {line}", where)


@pytest.mark.parametrize(
    ("value", "field", "expected"),
    [
        (np.zeros(3), "x", FieldShapeError),
        (np.array([1, np.nan]), "x", NotFiniteError),
        (np.array([1, -np.inf]), "x", NotFiniteError),
        (np.array([1j, 2]), "x", FieldTypeError),
        ([[1, 2], [3]], "x", FieldShapeError),
        (1.0, "velocity", UnknownFieldError),
    ],
)
def test_client_rejects_invalid_data_as_in_process(errors_of, value, field, expected):
    kwargs = {"value": value, "field": field, "at": 7, "who": 2}
    (local, rows), (error, client_rows) = errors_of(
        "Bad", [5, 5, 5, 5], num_clients=2, env_kwargs=kwargs
    )
    assert type(error) is type(local) is expected
    assert str(error) == str(local)
    assert (error.field, error.instance_id, error.step) == (field, 2, 7)
    assert rows == client_rows == 15


def test_rows_before_an_invalid_row_arrive(simulated):
    kwargs = {"value": np.full(2, np.nan), "at": 50}
    with simulated("Bad", run_ahead=1000, env_kwargs=kwargs) as source:
        assert source.batch(49)["step"][-1] == 48
        assert source.batch(1)["step"] == [49]
        with pytest.raises(NotFiniteError, match="Instance 1, step 50"):
            source.batch(1)


def test_error_in_an_unrequested_row_is_ignored(simulated, simulation):
    kwargs = {"value": np.full(2, np.nan), "at": 5}
    with simulated("Bad", run_ahead=1000, env_kwargs=kwargs) as source:
        assert len(source.batch(5)["x"]) == 5
        simulation.sleep(0.1)


@pytest.mark.parametrize("goes_on", [True, False])
def test_error_of_run_ahead_row_waits_until_requested(simulated, simulation, goes_on):
    kwargs = {"value": np.full(2, np.nan), "at": 30_000}
    with simulated("Bad", run_ahead=40_000, env_kwargs=kwargs) as source:
        assert len(source.batch(5)["x"]) == 5
        simulation.sleep(1.0)  # for all rows, and the error
        if goes_on:
            assert source.batch(29_995)["step"][-1] == 29_999
            with pytest.raises(NotFiniteError, match="Instance 1, step 30000"):
                source.batch(1)


def test_a_missing_field_and_wrong_samples_are_as_in_process(errors_of):
    (local, _), (error, _) = errors_of(
        "Walk", [3], env_kwargs={"refuse": 1}, max_wrong_samples_per_step=4
    )
    assert type(error) is WrongSamplesError
    assert str(error) == str(local)
    (local, _), (error, _) = errors_of("Walk", [3], env_kwargs={"speed": 1})
    assert type(error) is type(local) is UnknownOptionError
    assert str(error) == str(local)
    assert vars(error) == vars(local)


def test_open_shapes_must_be_the_same_in_all_instances(errors_of):
    (local, _), (error, _) = errors_of("Shapes", [1, 1], num_clients=2)
    assert type(error) is type(local) is FieldShapeError
    assert str(error) == str(local)
    assert vars(error) == vars(local)


def test_instances_define_the_same_fields(simulated):
    with (
        pytest.raises(FieldsMismatchError, match="Instances 1 and 2") as caught,
        simulated("Names", num_clients=2),
    ):
        pass
    assert set(caught.value.differences) == {"x1", "x2"}


def test_an_environment_cannot_hide_a_row_that_is_not_finite(simulated):
    with (
        pytest.raises(NotFiniteError, match="Instance 1, step 1"),
        simulated("Stubborn") as source,
    ):
        source.batch(1)
        source.batch(9)
