"""How the fields of a network are normalized: by component, channel or field, or like another."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import (
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Normalization,
    PhysxError,
    Training,
    View,
)
from physx_core.array_file import pack, unpack
from physx_core.dataset import EpisodeRecord
from physx_core.errors import ConfigError, DatasetError, FieldShapeError, FieldsMismatchError

PICTURE = ("channel", "y", "x")
RANDOM = np.random.default_rng(0)
U = RANDOM.normal([[[3.0]], [[-50.0]]], [[[1.0]], [[20.0]]], (40, 2, 4, 6))
ROWS = {
    "u": U,
    "next_u": U + 1,
    "p": np.exp(RANDOM.normal(size=(40, 4, 6))),
    "state": RANDOM.normal(7, 2, (40, 3)),
    "grid": RANDOM.normal(size=(40, 2, 3)),
    "label": RANDOM.integers(0, 3, 40),
}
FIELDS = (
    Field("u", (2, 4, 6), unit="m/s", axes=PICTURE),
    Field("next_u", (2, 4, 6), unit="m/s", axes=PICTURE, like="u"),
    Field("p", (4, 6), axes=("y", "x")),
    Field("state", (3,)),
    Field("grid", (2, 3)),
    Field("label", (), "int64"),
)


@pytest.fixture(params=["plain", "episodes"])
def folder(tmp_path, request):
    """40 rows, in a plain mode, or in four episodes."""
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", FIELDS)
        for start in range(0, 40, 10):
            rows = {name: values[start : start + 10] for name, values in ROWS.items()}
            if request.param == "plain":
                dataset.append("training", rows)
            else:
                record = EpisodeRecord(episode=start // 10, rows=10)
                dataset.append_episodes("training", rows, [record])
    return tmp_path


def check(found, values, axes, shape):
    assert found.mean.shape == found.std.shape == found.minimum.shape == shape
    for name, function in (
        ("mean", np.mean),
        ("std", np.std),
        ("minimum", np.min),
        ("maximum", np.max),
    ):
        expected = function(values, axis=axes).reshape(shape)
        assert_allclose(getattr(found, name), expected, rtol=1e-12)


@pytest.mark.reported(
    "careamics#679",
    "careamics#777",
    "n2v#32",
    "neuraloperator#47",
    about="fields on grids are normalized by channel, or together",
)
def test_by_default_channels_are_apart_and_other_named_axes_are_pooled(folder):
    with Dataset.open(folder) as dataset:
        found = dataset.normalization
        assert found.keys() == {"u", "next_u", "p", "state", "grid"}
        check(found["u"], U, (0, 2, 3), (2, 1, 1))
        check(found["next_u"], U, (0, 2, 3), (2, 1, 1))  # of the field that it is like
        check(found["p"], ROWS["p"], None, ())
        check(found["state"], ROWS["state"], 0, (3,))
        check(found["grid"], ROWS["grid"], 0, (2, 3))
        again = dataset.recompute_normalization()
        assert all((again[name].mean == found[name].mean).all() for name in found)


def test_a_table_says_how_each_field_is_normalized(folder):
    table = {"u": "component", "p": "log-field", "state": "field", "grid": "none"}
    with Dataset.open(folder) as dataset:
        found = dataset.normalization_of("training", table)
    assert found.keys() == {"u", "next_u", "p", "state"}
    check(found["u"], U, 0, (2, 4, 6))
    check(found["next_u"], U, 0, (2, 4, 6))
    check(found["p"], np.log(ROWS["p"]), None, ())
    assert found["p"].log and not found["u"].log
    check(found["state"], ROWS["state"], None, ())
    back = Normalization.from_arrays(unpack(pack(found["p"].arrays())), (4, 6))
    assert back.log and back.mean == found["p"].mean


def test_normalized_batches_of_a_dataset_broadcast(folder):
    with Dataset.open(folder) as dataset:
        known = dataset.normalization_of("training", {"p": "log-field"})
        batches = dataset.batches("training", 40, normalize=known)
        batch = next(batches)
    for name in ("u", "p"):
        values = np.log(ROWS[name]) if name == "p" else ROWS[name]
        assert_allclose(batch[name], (values - known[name].mean) / known[name].std)


@pytest.mark.parametrize("folder", ["episodes"], indirect=True)
def test_windows_have_the_statistics_of_their_field(folder):
    view = View(window={"past": ("next_u", [-1, 0]), "p": ("p", [0, 1]), "v": ("state", 1)})
    with Dataset.open(folder) as dataset:
        expected = dataset.normalization
    with view.open(8, data=folder, part="all") as batches:
        found = batches.normalization()
        assert batches.fields["past"].axes == ("time", *PICTURE)
        assert batches.fields["past"].like == "next_u"
        for window, stored in {"past": "u", "p": "p", "v": "state"}.items():
            for name, array in expected[stored].arrays().items():
                assert_array_equal(getattr(found[window], name), array)
        by_window = batches.normalization({"past": "none", "state": "field"})
        assert by_window.keys() == {"p", "v"} and by_window["v"].mean.shape == ()
        by_root = batches.normalization({"u": "field"})
        assert by_root["past"].mean.shape == ()


@pytest.mark.parametrize("kind", ["component", "channel", "field", "log-component"])
def test_statistics_of_a_fold_are_those_of_its_rows(folder, kind):
    rows = {"component": 0, "log-component": 0, "channel": (0, 2, 3), "field": None}
    with View(folds=4, fold=1).open(8, data=folder) as batches:
        name = "p" if kind == "log-component" else "u"
        values = ROWS[name][batches.all_rows()]
        values = np.log(values) if name == "p" else values
        found = batches.normalization({name: kind})[name]
        check(found, values, rows[kind], found.mean.shape)


def test_channels_may_be_anywhere_and_of_other_resolutions(tmp_path):
    coarse, fine = RANDOM.normal(size=(9, 4, 2)), RANDOM.normal(size=(9, 2, 8, 8))
    with Dataset.create(tmp_path) as dataset:
        fields = [
            Field("coarse", (4, 2), axes=("node", "channel")),
            Field("fine", (2, 8, 8), axes=PICTURE, like="coarse"),
        ]
        dataset.define_fields("training", fields)
        dataset.append("training", {"coarse": coarse, "fine": fine})
        found = dataset.normalization
        check(found["coarse"], coarse, (0, 1), (2,))
        check(found["fine"], coarse, (0, 1), (2, 1, 1))
        with pytest.raises(ConfigError, match="cannot have the statistics of each component"):
            dataset.normalization_of("training", {"coarse": "component"})


@pytest.mark.parametrize(
    ("table", "error", "text"),
    [
        ({"w": "field"}, ConfigError, 'the field "w", which does not exist'),
        ({"u": "pixel"}, ConfigError, "must be one of"),
        ({"label": "field"}, ConfigError, "values of type int64"),
        ({"state": "channel"}, ConfigError, "name its axes"),
        ({"u": "log-channel"}, DatasetError, 'field "u" has the value -'),
    ],
)
def test_a_table_that_fits_no_field_is_refused(folder, table, error, text):
    with Dataset.open(folder) as dataset, pytest.raises(error, match=text):
        dataset.normalization_of("training", table)


def test_an_unknown_method_is_refused_at_once():
    with pytest.raises(
        ConfigError, match="DatasetConfig.normalize: u is 'chanel' but must be one of"
    ):
        DatasetConfig(normalize={"u": "chanel"})
    assert DatasetConfig(normalize={"u": "channel"}).normalize == {"u": "channel"}
    assert DatasetConfig(normalize=np.True_).normalize is True


# Axes and quantities ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axes", "text"),
    [
        (("y",), "name each of its axes"),
        (("y", "y"), "twice"),
        (("y", "x 1"), "identifiers"),
        (("y", 1), "identifiers"),
        (3, "identifiers"),
    ],
)
def test_axes_are_named_once_each(axes, text):
    with pytest.raises(ConfigError, match=text):
        Field("u", (4, 6), axes=axes)


def test_axes_and_quantities_survive_the_trip_through_plain_data_and_a_dataset(folder):
    for field in FIELDS:
        assert Field.from_dict(field.to_dict()) == field
    with Dataset.open(folder) as dataset:
        assert tuple(dataset.fields("training").values())[:6] == FIELDS
        described = {row["field"]: row for row in dataset.describe()}
        assert described["next_u"]["axes"] == PICTURE and described["next_u"]["like"] == "u"


def test_rows_of_an_open_shape_have_as_many_axes_as_are_named(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", [Field("u", axes=PICTURE)])
        with pytest.raises(FieldShapeError, match="has shape \\(4, 6\\) but the axes"):
            dataset.append("training", {"u": np.zeros((5, 4, 6))})
        dataset.append("training", {"u": np.ones((5, 2, 4, 6))})
        assert dataset.normalization["u"].mean.shape == (2, 1, 1)


@pytest.mark.parametrize(
    ("field", "text"),
    [
        (Field("v", (3,), like="w"), "there is no such field"),
        (Field("v", (3,), like="v"), "name the first of them"),
        (Field("v", (3,), like="next"), 'is like "state": name the first'),
        (Field("v", (3,), unit="m", like="state"), "has the unit 'm', not ''"),
        (Field("v", (2,), like="state"), "neither ends with"),
        (Field("v", (), like="state"), "neither ends with"),
    ],
)
def test_a_field_is_like_one_of_the_same_unit_and_shape(tmp_path, field, text):
    others = [Field("state", (3,)), Field("next", (8, 3), like="state")]
    with Dataset.create(tmp_path) as dataset:
        with pytest.raises(ConfigError, match=text):
            dataset.define_fields("training", [*others, field])
        dataset.define_fields("training", others)


def test_other_axes_are_other_fields_when_datasets_are_merged(tmp_path):
    for name, axes in (("a", PICTURE), ("b", PICTURE), ("c", ())):
        with Dataset.create(tmp_path / name) as dataset:
            dataset.define_fields("training", [Field("u", (2, 4, 6), axes=axes)])
            dataset.append("training", {"u": U})
    with Dataset.open(tmp_path / "a", writable=True) as dataset:
        dataset.merge(tmp_path / "b")
        assert dataset.num_samples("training") == 80
        check(dataset.normalization["u"], U, (0, 2, 3), (2, 1, 1))
        with pytest.raises(FieldsMismatchError, match="axes"):
            dataset.merge(tmp_path / "c")


# While environments generate ---------------------------------------------------------------------


class Growth(Environment):
    """Sizes of many magnitudes, and the next ones."""

    like = "size"

    def create(self):
        self.size = np.ones(3)

    def init_database(self):
        later = Field("later", (3,), unit="m", like=self.like)
        self.define_training_fields([Field("size", (3,), unit="m"), later])

    def step(self):
        size, self.size = self.size, self.size * self.rng.lognormal(size=3)
        self.set_training_data(size=size, later=self.size)


class Lost(Growth):
    like = "other"


def grow(tmp_path, environment, normalize):
    network = NetworkConfig("toy/linear", {"net_fields": "size", "opt_fields": "later"})
    training = Training(
        network, DatasetConfig(normalize=normalize),
        EnvironmentConfig(environment, as_tcp_ip_client=False, seed=0),
        session_dir=str(tmp_path), epoch_nb=1, batch_nb=3, batch_size=4, seed=0, quiet=True,
    )  # fmt: skip
    training.execute()
    return training


@pytest.mark.parametrize(
    ("method", "axes"), [("log-field", None), ("field", None), ("component", 0)]
)
def test_generated_samples_are_normalized_by_field(tmp_path, method, axes):
    training = grow(tmp_path, Growth, {"size": method})
    found = training.learner.transformation.normalization
    with Dataset.open(training.session.path) as dataset:
        rows = dataset["training"]["size"][:]
        assert len(rows) == 12
    rows = np.log(rows) if method == "log-field" else rows
    for name in ("size", "later"):
        check(found[name], rows, axes, () if axes is None else (3,))
        assert found[name].log == (method == "log-field")


def test_a_quantity_that_an_environment_does_not_define_is_named(tmp_path):
    with pytest.raises(PhysxError, match='Field "later" is like "other", but there is no such'):
        grow(tmp_path, Lost, False)
