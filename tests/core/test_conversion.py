"""One rule decides which values fit a field, on every way into a dataset."""

import runpy
import tempfile
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sizes import size

from physx_core import DataGeneration, Dataset, Environment, EnvironmentConfig, Field
from physx_core.errors import (
    FieldShapeError,
    FieldTypeError,
    NotFiniteError,
    PhysxError,
    SampleError,
)
from physx_core.sources import LocalSource
from physx_formats import import_file

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parent / "programs" / "value_envs.py"
VALUES = f"{PROGRAM}:Values"
program = runpy.run_path(str(PROGRAM))
INTEGERS, DTYPES, LIMITS, ACCEPTED = (
    program[name] for name in ("INTEGERS", "DTYPES", "LIMITS", "ACCEPTED")
)
ORDER = {"b": 0, "u": 1, "i": 1, "f": 2, "c": 3}
EDGES = sorted({n + d for i in LIMITS.values() for n in (i.min, i.max) for d in (-1, 0, 1)})

integers = st.integers(-(2**66), 2**66) | st.sampled_from([*EDGES, 2**53 + 1, 2**24 + 1, -(2**70)])
scalars = st.one_of(
    st.booleans(),
    integers,
    st.floats(),
    st.sampled_from([3.4028236e38, 1e300, 65520.0, 5e-324, -0.0]),
    st.complex_numbers(),
    st.sampled_from(["a", b"1", None, (), {"a": 1}, {1}, np.datetime64(3, "s"), object()]),
)


@st.composite
def given_arrays(draw):
    """Arrays of every plain type, of either byte order, and with gaps."""
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    shape = draw(st.sampled_from([(), (1,), (3,), (0,), (2, 3), (2, 0)]))
    elements = None
    if dtype.kind in "iu":
        limits = LIMITS[dtype.name]
        edges = st.sampled_from([n for n in EDGES if limits.min <= n <= limits.max])
        elements = edges | st.integers(limits.min, limits.max)
    array = draw(arrays.arrays(dtype, shape, elements=elements))
    if draw(st.booleans()):
        array = array.astype(dtype.newbyteorder(">"))
    if array.ndim and draw(st.booleans()):
        spaced = np.zeros((*shape[:-1], 2 * shape[-1]), array.dtype)[..., ::2]
        spaced[...] = array
        array = spaced
    return array


values = scalars | given_arrays() | st.lists(scalars, max_size=3)


def expected(dtype, shape, value):
    """Return what reading must give, as Python's numbers, or the error; by Python's own numbers."""
    try:
        array = np.asarray(value)
    except ValueError:
        return FieldShapeError
    if array.shape != shape:
        return FieldShapeError
    if not array.size and isinstance(value, list | tuple):
        return []
    kind, given_kind = np.dtype(dtype).kind, array.dtype.kind
    if given_kind not in ORDER or ORDER[given_kind] > ORDER[kind]:
        return FieldTypeError
    numbers = array.ravel().tolist()
    if kind in "iu":
        limits = LIMITS[dtype]
        if not all(limits.min <= number <= limits.max for number in numbers):
            return FieldTypeError
        return [int(number) for number in numbers]
    if kind == "b":
        return numbers
    parts = [part for n in numbers for part in (complex(n).real, complex(n).imag)]
    real = np.dtype(dtype).type(0).real.dtype
    with np.errstate(over="ignore"):
        finite = np.isfinite(np.array(parts, np.float64).astype(real)).all()
    return numbers if finite else NotFiniteError


def agrees(dtype, numbers, stored):
    """Check that stored values are the nearest ones of the type, which are equal if possible."""
    kind = np.dtype(dtype).kind
    assert stored.dtype == dtype
    for number, found in zip(numbers, stored.ravel(), strict=True):
        if kind in "biu":
            assert found.item() == number
            continue
        parts = (number.real, number.imag) if isinstance(number, complex) else (number, 0)
        for part, got in zip(parts, (found.real, found.imag), strict=True):
            away = abs(Fraction(float(got)) - Fraction(part))
            for neighbor in (np.nextafter(got, -np.inf), np.nextafter(got, np.inf)):
                if np.isfinite(neighbor):
                    assert away <= abs(Fraction(float(neighbor)) - Fraction(part))


class Giving(Environment):
    """Gives one value for the field x."""

    def __init__(self, *, field, value, **kwargs):
        super().__init__(**kwargs)
        self.field, self.value = field, value

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(self.field)

    def step(self):
        self.set_training_data(x=self.value)


class Ways:
    """Ways into a dataset; each stores a value in the field x and returns what is read then."""

    NAMES = ("environment", "append", "append_sample", "update", "update_rows")

    def __init__(self, dataset, field):
        self.dataset, self.field = dataset, field
        self.mode = f"{field.dtype[1:]}_{'_'.join(map(str, field.shape))}"
        if self.mode not in dataset:
            dataset.define_fields(self.mode, [field])
            dataset.append(self.mode, {"x": np.zeros((1, *field.shape), field.dtype)})

    def environment(self, value):
        config = EnvironmentConfig(Giving, env_kwargs={"field": self.field, "value": value})
        with LocalSource(config, None, [0]) as source:
            rows = source.batch(1)
            rows.pop("env_id"), rows.pop("episode"), rows.pop("step")
            self.dataset.append(self.mode, rows, checked=True)

    def append(self, value):
        self.dataset.append(self.mode, {"x": in_rows(value)})

    def append_sample(self, value):
        self.dataset.append_sample(self.mode, {"x": value})
        self.dataset.flush()

    def update(self, value):
        self.dataset.update(self.mode, -1, {"x": value})

    def update_rows(self, value):
        self.dataset.update(self.mode, [-1], {"x": in_rows(value)})

    def read(self):
        return self.dataset[self.mode]["x"][:]


def in_rows(value):
    return value[None] if isinstance(value, np.ndarray) else [value]


def outcome(way, value):
    try:
        way(value)
    except SampleError as error:
        assert error.field == "x"
        return type(error)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("conversion") / "data"
    with Dataset.create(folder) as dataset:
        yield dataset
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        for mode in dataset.modes:
            assert np.isfinite(dataset[mode]["x"][:]).all()


@pytest.mark.slow
@settings(max_examples=size(200, 25), deadline=None)
@given(dtype=st.sampled_from(DTYPES), value=values, other=st.booleans())
@example("int32", 3_000_000_000, False)
@example("uint8", -1, False)
@example("uint8", np.array([3, -1]), False)
@example("int64", np.array([2**63], "uint64"), False)
@example("float32", 1e300, False)
@example("float64", 2**53 + 1, False)
@example("float64", 2**64, False)
@example("float16", 65520, False)
@example("int32", True, False)
@example("bool", 1, False)
@example("float64", 1j, False)
@example("float64", [[1, 2], [3]], False)
@example("bool", (), False)
def test_every_way_in_has_the_same_rule(store, dtype, value, other):
    try:
        shape = np.asarray(value).shape
    except ValueError:
        shape = (2,)
    shape = (*shape, 2) if other else shape
    wanted = expected(dtype, shape, value)
    ways = Ways(store, Field("x", shape, dtype))
    for name in Ways.NAMES:
        before = ways.read()
        found, after = outcome(getattr(ways, name), value), ways.read()
        if isinstance(wanted, type):
            assert found is wanted, name
            assert after.tobytes() == before.tobytes()
        else:
            assert found is None, name
            assert len(after) == len(before) + (not name.startswith("update"))
            agrees(dtype, wanted, after[-1])


@pytest.mark.slow
@settings(max_examples=size(30, 4), deadline=None)
@given(dtype=st.sampled_from(DTYPES), value=given_arrays())
@example("int32", np.array(3_000_000_000))
@example("uint16", np.array([-1], "int8"))
@example("float32", np.array([1e300]))
def test_an_import_has_the_rule_too(dtype, value):
    wanted = expected(dtype, value.shape, value)
    with tempfile.TemporaryDirectory() as folder:
        path, directory = Path(folder) / "rows.npz", Path(folder) / "d"
        np.savez(path, x=value[None])
        with Dataset.create(directory) as dataset:
            dataset.define_fields("training", [Field("x", value.shape, dtype)])
        try:
            import_file(path, directory)
            found = None
        except SampleError as error:
            found = type(error)
        except PhysxError:
            found = FieldTypeError  # the file's fields are not those of the dataset
        with Dataset.open(directory) as dataset:
            assert dataset.num_samples("training") == (found is None)
            if found is None:
                agrees(dtype, wanted, dataset["training"]["x"][:])


@pytest.mark.parametrize("over_tcp", [False, True])
def test_generated_values_are_read_back(over_tcp, nothing_stays_behind):
    config = EnvironmentConfig(
        VALUES, env_kwargs={"rejects": True}, as_tcp_ip_client=over_tcp, record_wrong_samples=True
    )
    DataGeneration(config, batch_nb=1, batch_size=len(ACCEPTED)).execute()
    with Dataset.open("sessions/data_generation") as dataset:
        assert dataset.modes == ["training"]
        for name in DTYPES:
            for sample, row in zip(ACCEPTED, dataset["training"][name][:], strict=True):
                agrees(name, expected(name, (), sample[name]), np.asarray(row))


@pytest.mark.parametrize("over_tcp", [False, True])
@pytest.mark.parametrize(
    ("name", "error"), [("int32", FieldTypeError), ("float32", NotFiniteError)]
)
def test_a_generated_value_that_does_not_fit_is_rejected(
    over_tcp, name, error, nothing_stays_behind
):
    config = EnvironmentConfig(VALUES, env_kwargs={"wrong": name}, as_tcp_ip_client=over_tcp)
    with pytest.raises(error, match=f'Instance 1, step {len(ACCEPTED)}: field "{name}"'):
        DataGeneration(config, batch_nb=len(ACCEPTED) + 1, batch_size=1).execute()
    with Dataset.open("sessions/data_generation") as dataset:
        assert dataset.num_samples("training") == len(ACCEPTED)


def test_what_is_no_array_is_named():
    class Stubborn:
        def __array__(self, *args, **kwargs):
            raise RuntimeError("a tensor that requires grad")

    with pytest.raises(FieldTypeError, match='"x" is not convertible .* requires grad'):
        Field("x").convert(Stubborn())


@pytest.mark.parametrize("dtype", ["?", "i4", "f8"])
def test_an_empty_list_has_no_type_and_fits_all(tmp_path, dtype):
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.define_fields("training", [Field("n", (), dtype)])
        dataset.append("training", {"n": []})
        assert dataset["training"]["n"][:].dtype == dtype
