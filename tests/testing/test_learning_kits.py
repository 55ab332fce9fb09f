"""The kit names what is wrong with what learns, and finds nothing in what is right."""

import pytest

from physx_core import Field, NetworkConfig
from physx_testing import check_network, check_optimization, check_transformation

pytestmark = pytest.mark.processes

FIELDS = (Field("x", (4,)), Field("y", (3,)))
NETWORKS = [
    ("OtherName", "predicts each of its fields, in the shape of its target", "pred_fields"),
    ("FlatPrediction", "predicts each of its fields, in the shape of its target", "(8, 3)"),
    ("MixesRows", "predicts a sample the same alone and in a batch", "alone"),
    ("DropsInEvaluation", "predicts the same again", "evaluation mode"),
    ("ChangesInputs", "does not change its inputs", "predict() changed"),
    ("IgnoresSeed", "begins with the same parameters for the same seed", "first"),
    ("Pickles", "saves its parameters without code", "pickle"),
    ("ForgetsOffset", "saves and loads everything it predicts with", "not among them"),
    ("LoadsAnything", "refuses damaged and missing parameters", "half of a file"),
    ("BindsAnything", "refuses fields that it cannot read", "super().bind"),
    ("Swallows", "refuses unknown options", "misspelling"),
]
OPTIMIZATIONS = [
    ("Climbs", "lowers the loss", "linear problem"),
    ("StepsInLoss", "changes parameters in optimize() alone", "validation"),
    ("ForgetsMomentum", "resumes from a checkpoint bit for bit", "state_file"),
    ("RowLossesStep", "computes row losses without side effects", "compute_row_losses"),
    ("Noisy", "trains the same again", "second training"),
    ("HidesNaN", "stops at NaN with the previous parameters", "without a word"),
]
TRANSFORMATIONS = [
    ("ForgetsToUndo", "converts normalized predictions back to physical units", "does not undo"),
    ("UndoesAlways", "converts predictions back to physical units", "does not undo"),
    ("KeepsNothing", "keeps its normalization for checkpoints", "super().set_normalization"),
    ("InPlace", "does not change what it transforms", "the targets"),
    ("OfTheBatch", "transforms a sample the same alone and in a batch", "alone"),
]


def network(place, name):
    return check_network(place("wrong_networks", name), fields=FIELDS)


def optimization(place, name):
    learner = NetworkConfig(place("wrong_networks", "Right"), data_type="float64")
    return check_optimization(place("wrong_networks", name), network=learner, fields=FIELDS)


def transformation(place, name):
    return check_transformation(place("wrong_networks", name))


@pytest.mark.parametrize(("name", "check", "text"), NETWORKS)
def test_wrong_networks(name, check, text, place, expect_named):
    expect_named(network(place, name), check, text)


def test_a_network_that_no_fields_are_at_fault_for_is_not_skipped(place):
    report = check_network(place("wrong_networks", "ReturnsNothing"))
    assert not report.ok and report.counts()["failed"] == 12, str(report)
    assert "TypeError: 'NoneType' object is not" in str(report)


def test_a_class_that_is_not_complete_fails_once(place):
    report = check_network(place("wrong_networks", "TakesNothing"))
    (check,) = report.checks
    assert check.status == "failed" and "predict() where physx calls predict(data)" in check.reason


@pytest.mark.parametrize(("name", "check", "text"), OPTIMIZATIONS)
def test_wrong_optimizations(name, check, text, place, expect_named):
    expect_named(optimization(place, name), check, text)


@pytest.mark.parametrize(("name", "check", "text"), TRANSFORMATIONS)
def test_wrong_transformations(name, check, text, place, expect_named):
    expect_named(transformation(place, name), check, text)


@pytest.mark.parametrize(
    ("check", "name"),
    [(network, "Right"), (optimization, "Descends"), (transformation, "Scales")],
)
def test_nothing_is_found_in_right_ones(check, name, place, expect_right):
    expect_right(check(place, name))
