"""Parameters have distributions; what does not describe one is an error that names it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core import Parameter
from physx_core.errors import ConfigError


@pytest.mark.parametrize(
    ("parameter", "middle"),
    [
        (Parameter("a", 2.0, 4.0), 3.0),
        (Parameter("a", 0.01, 100.0, distribution="log_uniform"), 1.0),
        (Parameter("a", mean=5.0, deviation=2.0, distribution="normal"), 5.0),
        (Parameter("a", -1.0, 1.0, mean=0.0, deviation=9.0, distribution="normal"), 0.0),
        (Parameter("a", 1, 3, distribution="integer"), 2),
    ],
)
def test_the_median_of_a_distribution(parameter, middle):
    assert parameter.quantile(np.array([0.5])) == pytest.approx(middle)
    low, high = (parameter.quantile(np.array([share])) for share in (0.0, 1.0))
    assert low < middle < high
    assert parameter.contains(low)
    assert parameter.contains(high)
    assert isinstance(low, type(middle))
    assert parameter.quantile(parameter.share(middle)) == pytest.approx(middle)
    assert parameter.share(middle) == pytest.approx([0.5])


def test_integers_are_all_equally_likely_bounds_included():
    dice = Parameter("dice", 1, 6, distribution="integer")
    thrown = [dice.quantile(np.array([share])) for share in (np.arange(600) + 0.5) / 600]
    assert np.bincount(thrown).tolist() == [0, *[100] * 6]


def test_each_element_has_bounds_of_its_own():
    push = Parameter("push", [[0, 1], [2, 3]], [[1, 2], [3, 9]], shape=(2, 2))
    assert push.quantile(np.full(4, 0.5)).tolist() == [[0.5, 1.5], [2.5, 6.0]]
    assert push == Parameter.from_dict(push.to_dict())
    assert Parameter("push", 0, 1, shape=(3,)).low == (0.0, 0.0, 0.0)
    assert not push.contains([[0, 1], [2, 9.5]])


@given(st.floats(0, 1), st.floats(-50, 50), st.floats(1e-3, 50))
def test_a_cut_off_normal_distribution_stays_within_its_bounds(share, mean, deviation):
    parameter = Parameter("a", -1.0, 2.0, mean=mean, deviation=deviation, distribution="normal")
    assert -1.0 <= parameter.quantile(np.array([share])) <= 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, '"a" needs "low"'),
        ({"low": 1.0}, 'needs "high"'),
        ({"low": 2.0, "high": 1.0}, "low must be below high"),
        ({"low": 0.0, "high": 1.0, "distribution": "log_uniform"}, "above 0"),
        ({"low": 0.0, "high": 1.5, "distribution": "integer"}, "must be integers"),
        ({"distribution": "normal", "mean": 0.0}, 'needs "deviation"'),
        ({"distribution": "normal", "mean": 0.0, "deviation": 0.0}, "deviation above 0"),
        ({"low": 0.0, "high": 1.0, "mean": 0.5}, "only a normal distribution"),
        ({"low": 0.0, "high": np.inf}, "not finite"),
        ({"low": [0.0, 1.0], "high": 1.0, "shape": (3,)}, "neither a number nor of shape"),
        ({"low": 0.0, "high": 1.0, "shape": (0,)}, "0 elements"),
        ({"low": 0.0, "high": 1.0, "distribution": "gauss"}, "unknown distribution 'gauss'"),
    ],
)
def test_what_is_no_distribution_is_an_error_that_names_the_parameter(options, message):
    with pytest.raises(ConfigError, match=message.replace('"a"', "'a'")):
        Parameter("a", **options)


@pytest.mark.parametrize("name", ["set", "env_id", "episode", "step", "two words"])
def test_names_that_are_taken_or_no_identifiers_are_errors(name):
    with pytest.raises(ConfigError):
        Parameter(name, 0.0, 1.0)
