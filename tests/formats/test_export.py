import shutil
import subprocess
import sys
import tracemalloc

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.errors import ComponentNotFoundError, ConfigError, DatasetError, MissingLibraryError
from physx_formats import ExchangeError, ExportOptions, export, import_file

pytestmark = pytest.mark.processes

ROWS = 60
DTYPES = ["?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16"]
SHAPES = [(), (3,), (2, 3)]


def values(dtype, shape, rows=ROWS, seed=0):
    """Random bits of a type, without NaN or infinity."""
    random, dtype = np.random.default_rng(seed), np.dtype(dtype)
    if dtype.kind == "b":
        return random.integers(0, 2, (rows, *shape)).astype("?")
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        return random.integers(info.min, info.max, (rows, *shape), dtype, endpoint=True)
    real = random.normal(0, 10, (rows, *shape))
    return (real + 1j * real[::-1] if dtype.kind == "c" else real).astype(dtype)


def table(dtypes=DTYPES, shapes=SHAPES):
    return {f"{d.strip('?') or 'b'}_{len(s)}": values(d, s) for d in dtypes for s in shapes}


def make(folder, modes, units=True):
    """Make a dataset of several partitions from arrays by mode and field."""
    with Dataset.create(folder, max_file_size=2.2e-5, info={"environment": "a/b"}) as dataset:
        for mode, arrays in modes.items():
            unit = "N m" if units else ""
            fields = [Field(n, a.shape[1:], a.dtype, unit) for n, a in arrays.items()]
            episode = np.repeat(np.arange(ROWS // 20), 20)
            rows = {"env_id": np.ones(ROWS, "i4"), "episode": episode, "step": np.arange(ROWS)}
            kept = [Field(n, (), a.dtype, role="additional") for n, a in rows.items()]
            dataset.define_fields(mode, [*fields, *kept])
            dataset.append(mode, {**arrays, **rows})
    return Dataset.open(folder)


@pytest.fixture
def everything(folder):
    """A dataset with fields of all types and shapes."""
    with make(folder, {"training": table()}) as dataset:
        yield dataset


def assert_same(dataset, other, mode="training"):
    assert other.fields(mode) == dataset.fields(mode)
    assert other.num_samples(mode) == dataset.num_samples(mode)
    for name, field in dataset[mode].items():
        assert field[:].tobytes() == other[mode][name][:].tobytes(), name


ARCHIVES = [("npz", "none"), ("npz", "deflate"), ("hdf5-single", "none"), ("hdf5-single", "gzip"),
            ("hdf5-single", "lzf")]  # fmt: skip


@pytest.mark.parametrize(("to", "compression"), ARCHIVES)
def test_a_round_trip_keeps_every_bit(everything, tmp_path, to, compression):
    out = tmp_path / ("out.npz" if to == "npz" else "out.h5")
    options = ExportOptions(compression=compression)
    assert export(everything, to, out, options=options) == {"training": ROWS}
    assert import_file(out, tmp_path / "back") == {"training": ROWS}
    with Dataset.open(tmp_path / "back") as back:
        assert_same(everything, back)
        assert back.info == {"environment": "a/b", "imported_from": out.name}
        assert back.verify() == []


@pytest.mark.parametrize("to", ["npz", "hdf5-single"])
def test_several_modes_round_trip(folder, tmp_path, to):
    modes = {"training": table(["f8"]), "test": table(["i4"]), "validation": table(["f4"])}
    out = tmp_path / ("out.npz" if to == "npz" else "out.h5")
    with make(folder, modes) as dataset:
        assert export(dataset, to, out) == dict.fromkeys(modes, ROWS)
        import_file(out, tmp_path / "all")
        import_file(out, tmp_path / "one", mode="test")
        export(dataset, to, out.with_stem("single"), modes=["test"])
        import_file(out.with_stem("single"), tmp_path / "single")
        import_file(out.with_stem("single"), tmp_path / "moved", mode="validation")
        with Dataset.open(tmp_path / "all") as back:
            for mode in modes:
                assert_same(dataset, back, mode)
        for name in ("one", "single"):
            with Dataset.open(tmp_path / name) as back:
                assert back.modes == ["test"]
                assert_same(dataset, back, "test")
        with Dataset.open(tmp_path / "moved") as back:
            assert back.modes == ["validation"]
            assert back.fields("validation") == dataset.fields("test")


def test_an_archive_is_what_numpy_loads(everything, tmp_path):
    export(everything, "npz", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz", allow_pickle=False) as archive:
        assert archive.files == everything["training"].keys()
        for name, field in everything["training"].items():
            assert archive[name].dtype == field.dtype
            assert_array_equal(archive[name], field[:])


def test_a_single_hdf5_file_has_units_and_can_be_mapped(everything, tmp_path):
    export(everything, "hdf5-single", tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5") as file:
        field = file["training/f8_1"]
        assert field.attrs["unit"] == "N m" and field.attrs["role"] == "training"
        assert field.chunks is None and field.id.get_offset()
        assert_array_equal(field[:], everything["training"]["f8_1"][:])


# Through the libraries that own the formats -----------------------------------------------------


@pytest.mark.parametrize("compression", ["none", "zstd", "snappy", "gzip", "lz4", "brotli"])
def test_parquet_holds_the_same(everything, tmp_path, compression):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out.parquet"
    export(everything, "parquet", out, options=ExportOptions(compression=compression))
    found = parquet.read_table(out)
    assert found.column_names == everything["training"].keys()
    for name, view in everything["training"].items():
        column = found[name].combine_chunks()
        metadata = found.schema.field(name).metadata
        assert metadata[b"unit"].decode() == view.field.unit
        assert metadata[b"role"].decode() == view.field.role
        assert metadata[b"dtype"].decode() == view.dtype.name
        while hasattr(column, "flatten"):
            column = column.flatten() if "list" in str(column.type) else column
            if "list" not in str(column.type):
                break
        flat = column.to_numpy(zero_copy_only=False)
        assert flat.dtype == np.empty(0, view.dtype).real.dtype
        assert np.ascontiguousarray(flat).tobytes() == view[:].tobytes(), name


def test_other_readers_see_nested_lists(everything, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    export(everything, "parquet", tmp_path / "out.parquet")
    column = parquet.read_table(tmp_path / "out.parquet", columns=["f8_2", "c16_0"])
    assert column["f8_2"].to_pylist() == everything["training"]["f8_2"][:].tolist()
    pairs = [[z.real, z.imag] for z in everything["training"]["c16_0"][:]]
    assert column["c16_0"].to_pylist() == pairs


@pytest.mark.parametrize("compression", ["none", "zstd", "gzip", "blosc"])
def test_zarr_holds_the_same(everything, tmp_path, compression):
    zarr = pytest.importorskip("zarr")
    out = tmp_path / "out.zarr"
    export(everything, "zarr", out, options=ExportOptions(compression=compression))
    root = zarr.open_group(str(out), mode="r")
    assert root.attrs["physx"]["info"] == {"environment": "a/b"}
    for name, view in everything["training"].items():
        found = root["training"][name]
        assert (found.dtype, found.shape) == (view.dtype, view.shape)
        assert found.attrs["unit"] == view.field.unit and found.attrs["role"] == view.field.role
        assert found[:].tobytes() == view[:].tobytes()
        names = found.metadata.dimension_names  # without which xarray does not open it
        assert names[0] == "sample" and len(set(names)) == len(names) == len(view.shape)


REAL = [d for d in DTYPES if not d.startswith("c")]


@pytest.fixture
def minari():
    pytest.importorskip("PIL")
    return pytest.importorskip("minari")


def test_minari_holds_the_same(folder, tmp_path, minari):
    with make(folder, {"training": table(REAL)}) as dataset:
        assert export(dataset, "minari", tmp_path / "arm-v0") == {"training": ROWS}
        found = minari.MinariDataset(tmp_path / "arm-v0" / "data")
        assert found.spec.dataset_id == "arm-v0"
        assert (found.total_episodes, found.total_steps) == (3, ROWS - 3)
        rows = {name: [] for name in dataset["training"]}
        for episode in found:
            assert found.observation_space.contains(
                {name: np.asarray(array[0]) for name, array in episode.observations.items()}
            )
            assert found.action_space.contains(episode.actions[0])
            assert len(episode.actions) == len(episode.rewards) == 19
            assert episode.truncations.tolist() == [False] * 18 + [True]
            for name in rows:
                rows[name].append({**episode.observations, **episode.infos}[name])
        for name, field in dataset["training"].items():
            stored = np.concatenate(rows[name])
            assert stored.dtype == field.dtype
            assert stored.tobytes() == field[:].tobytes(), name


def test_minari_with_actions_and_rewards_loses_nothing(folder, tmp_path, minari, monkeypatch):
    arrays = {"state": values("f8", (4,)), "force": values("f4", (2,)), "gain": values("f8", ())}
    options = ExportOptions(observations=["state"], actions=["force"], rewards="gain")
    with make(folder, {"training": arrays}) as dataset:
        export(dataset, "minari", tmp_path / "arm-v0", options=options)
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        found = minari.load_dataset("arm-v0")
        for number, episode in enumerate(found):
            rows = slice(20 * number, 20 * number + 20)
            last = episode.infos["last"]
            force = np.concatenate([episode.actions, last["force"]])
            gain = np.concatenate([episode.rewards, last["gain"]])
            assert_array_equal(episode.observations, arrays["state"][rows])
            assert_array_equal(force, arrays["force"][rows])
            assert_array_equal(gain, arrays["gain"][rows])
            assert episode.infos["env_id"].tolist() == [1] * 20
            assert episode.actions.dtype == "f4"


def test_minari_reports_rows_in_no_episode(folder, tmp_path, minari):
    with Dataset.create(folder) as dataset:
        dataset.append("training", {"x": np.zeros(6), "step": [0, 2, 3, 4, 8, 9]})
        assert export(dataset, "minari", tmp_path / "x-v0") == {"training": 5}
        dataset.append("validation", {"x": np.zeros(2), "step": [0, 2]})
        with pytest.raises(ExchangeError, match="No trajectory"):
            export(dataset, "minari", tmp_path / "y-v0", modes=["validation"])
    assert not (tmp_path / "y-v0").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ExportOptions(observations=["stat"]), 'Did you mean "state"'),
        (ExportOptions(actions=["state"], observations=["state"]), "more than once"),
        (ExportOptions(rewards="state"), "not a single number"),
        (ExportOptions(actions=["state"]), "No field is left"),
    ],
)
def test_invalid_roles_are_rejected(folder, tmp_path, minari, options, message):
    arrays = {"state": values("f8", (4,))}
    with make(folder, {"training": arrays}) as dataset, pytest.raises(ConfigError, match=message):
        export(dataset, "minari", tmp_path / "x-v0", options=options)


LIBRARIES = {
    "npz": "numpy",
    "hdf5-single": "h5py",
    "parquet": "pyarrow",
    "zarr": "zarr",
    "minari": "minari",
    "lerobot": "pyarrow",
}


def needed(to):
    """Return the options without which a format refuses to work."""
    return ExportOptions(fps=50) if to == "lerobot" else ExportOptions()


def test_lerobot_keeps_every_value_of_the_types_that_it_has(folder, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pytest.importorskip("pandas")
    arrays = table([dtype for dtype in DTYPES if not dtype.startswith("c")])
    options = ExportOptions(actions=["f8_1", "f8_0"], rewards="f4_0", fps=20, task="lift")
    with make(folder, {"training": arrays}) as dataset:
        assert export(dataset, "lerobot", tmp_path / "out", options=options) == {"training": ROWS}
    frames = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    episodes = parquet.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet")
    assert episodes["dataset_to_index"].to_pylist() == [20, 40, 60]
    action = np.array(frames["action"].to_pylist())
    assert_array_equal(action, np.column_stack([arrays["f8_1"], arrays["f8_0"]]))
    assert_array_equal(np.array(frames["next.reward"].to_pylist(), "f4"), arrays["f4_0"])
    for name in arrays.keys() - {"f8_1", "f8_0", "f4_0"}:
        found = np.array(frames[f"observation.{name}"].to_pylist(), arrays[name].dtype)
        assert_array_equal(found, arrays[name])


@pytest.mark.parametrize(
    ("arrays", "options", "message"),
    [
        ({"x": values("c8", (2,))}, {}, "no feature for the field"),
        ({"x": values("f8", (0,))}, {}, "no feature for the field"),
        ({"x": values("f8", (1,) * 6)}, {}, "1 to 5 axes"),
        (table(["f8", "f4"]), {"actions": ["f8_0", "f4_1"]}, "one vector"),
        (table(["f8"]), {"actions": ["f8_0", "f8_2"]}, "one vector"),
    ],
)
def test_what_lerobot_has_no_place_for_is_named(folder, tmp_path, arrays, options, message):
    pytest.importorskip("pandas")
    with make(folder, {"training": arrays}) as dataset, pytest.raises(ExchangeError, match=message):
        export(dataset, "lerobot", tmp_path / "out", options=ExportOptions(fps=50, **options))


# What is rejected --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("to", "library"),
    [("parquet", "pyarrow"), ("zarr", "zarr"), ("minari", "minari"), ("lerobot", "pandas")],
)
def test_a_missing_library_is_named_with_its_extra(everything, tmp_path, monkeypatch, to, library):
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(MissingLibraryError, match=rf'pip install .*physx.formats\[{to}\]"'):
        export(everything, to, tmp_path / "out", options=needed(to))
    assert [p.name for p in tmp_path.iterdir()] == ["data"]


def test_invalid_exports_are_rejected(everything, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ComponentNotFoundError, match='Did you mean "parquet"'):
        export(everything, "parket", out)
    with pytest.raises(ConfigError, match="deflate, none"):
        export(everything, "npz", out, options=ExportOptions(compression="zip"))
    with pytest.raises(ConfigError, match="actions is for .*minari.*, not for npz"):
        export(everything, "npz", out, options=ExportOptions(actions=["f8_0"]))
    with pytest.raises(ConfigError, match="fps is for lerobot, vtkhdf, not for minari"):
        export(everything, "minari", out, options=ExportOptions(fps=3))
    with pytest.raises(ConfigError, match="give it with fps"):
        export(everything, "lerobot", out)
    with pytest.raises(ConfigError, match="fps is 0"):
        export(everything, "lerobot", out, options=ExportOptions(fps=0))
    with pytest.raises(DatasetError, match="no mode"):
        export(everything, "npz", out, modes=["test"])
    with pytest.raises(ExchangeError, match="exists already"):
        export(everything, "npz", tmp_path)
    with pytest.raises(ExchangeError, match="does not exist"):
        export(everything, "npz", tmp_path / "none" / "out")
    assert not out.exists()


def test_a_format_of_one_mode_asks_which(folder, tmp_path):
    pytest.importorskip("pyarrow")
    arrays = table(["f8"])
    with make(folder, {"training": arrays, "validation": arrays}) as dataset:
        with pytest.raises(ConfigError, match="training, validation"):
            export(dataset, "parquet", tmp_path / "out")
        export(dataset, "parquet", tmp_path / "out", modes=["validation"])


def test_an_empty_dataset_is_not_exported(folder, tmp_path):
    with Dataset.create(folder) as dataset, pytest.raises(ExchangeError, match="no samples"):
        export(dataset, "npz", tmp_path / "out")


@pytest.mark.parametrize("to", LIBRARIES)
def test_an_export_that_fails_leaves_nothing(folder, tmp_path, to):
    pytest.importorskip(LIBRARIES[to])
    with make(folder, {"training": table(["f8"])}) as dataset:
        for path in folder.glob("*_f8_2_*.h5"):
            path.write_bytes(path.read_bytes()[:5000])
        with pytest.raises(DatasetError):
            export(dataset, to, tmp_path / "out", options=needed(to))
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


FULL = """
import os, sys
sys.path[:] = {path!r}
from physx_core.cli import main
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sys.exit(main(["export", {folder!r}, {out!r}, "--to", {to!r}, *{more!r}]))
"""


@pytest.mark.parametrize("to", ["npz", "parquet", "lerobot", "zarr", "hdf5-single"])
def test_a_full_disk_is_an_error(folder, tmp_path, to):
    """A limit of the file size simulates the disk: writing fails in the same way."""
    pytest.importorskip(LIBRARIES[to])
    with Dataset.create(folder) as dataset:
        random = np.random.default_rng(0)
        counters = {"episode": np.zeros(20_000, "i8"), "step": np.arange(20_000)}
        dataset.append("training", {"x": random.normal(size=(20_000, 9)), **counters})
    out = tmp_path / "out"
    more = ["--fps", "50"] if to == "lerobot" else []
    code = FULL.format(path=sys.path, folder=str(folder), out=str(out), to=to, more=more)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1, run.stderr
    assert "ExchangeError" in run.stderr and "cannot be written" in run.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_minari_checks_for_space_first(folder, tmp_path, minari, monkeypatch):
    usage = type(shutil.disk_usage(tmp_path))(10**6, 10**6 - 10**4, 10**4)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    message, modes = "the disk has 0.0 MB left", {"training": table(["f8"])}
    with make(folder, modes) as dataset, pytest.raises(ExchangeError, match=message):
        export(dataset, "minari", tmp_path / "x-v0")


def test_fields_without_elements(folder, tmp_path):
    with Dataset.create(folder) as dataset:
        dataset.append("training", {"x": np.ones(3), "none": np.empty((3, 0))})
        for to, name in (("npz", "out.npz"), ("hdf5-single", "out.h5")):
            export(dataset, to, tmp_path / name)
            import_file(tmp_path / name, tmp_path / to)
            with Dataset.open(tmp_path / to) as back:
                assert back["training"]["none"].shape == (3, 0)
        pytest.importorskip("pyarrow")
        with pytest.raises(ExchangeError, match='"none"'):
            export(dataset, "parquet", tmp_path / "out.parquet")


@pytest.mark.parametrize("to", LIBRARIES)
def test_memory_holds_a_few_blocks(folder, tmp_path, to):
    pytest.importorskip(LIBRARIES[to])
    rows = {"x": np.ones((200, 50_000)), "step": np.arange(200) % 20}
    with Dataset.create(folder) as dataset:
        dataset.append("training", rows)
        del rows
        tracemalloc.start()
        export(dataset, to, tmp_path / "out", options=needed(to))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 60e6  # the rows are 80 MB


def test_names_of_axes_survive_an_export_and_name_its_dimensions(tmp_path):
    zarr = pytest.importorskip("zarr")
    picture = ("channel", "y", "x")
    fields = {
        "u": Field("u", (2, 3, 4), axes=picture, unit="m"),
        "v": Field("v", (2, 3, 4), axes=picture, unit="m", like="u"),
        "w": Field("w", (5, 3), axes=("node", "channel")),
        "plain": Field("plain", (2,)),
    }
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.define_fields("training", fields.values())
        dataset.append("training", {n: np.ones((6, *of.shape)) for n, of in fields.items()})
        for form, name in (("zarr", "out.zarr"), ("npz", "out.npz"), ("hdf5-single", "out.h5")):
            export(dataset, form, tmp_path / name)
    group = zarr.open_group(str(tmp_path / "out.zarr"), mode="r")["training"]
    names = {name: group[name].metadata.dimension_names for name in fields}
    assert names["u"] == ("sample", "u_channel", "y", "x")  # of another length than in "w"
    assert names["v"] == ("sample", "v_channel", "y", "x")
    assert names["w"] == ("sample", "node", "w_channel")
    assert names["plain"] == ("sample", "plain_0")
    with h5py.File(tmp_path / "out.h5") as file:
        assert [axis.label for axis in file["training/u"].dims] == ["sample", *picture]
    for name in ("out.npz", "out.h5"):
        import_file(tmp_path / name, tmp_path / f"from_{name}")
        with Dataset.open(tmp_path / f"from_{name}") as dataset:
            assert dataset.fields("training") == fields
    import_file(tmp_path / "out.npz", tmp_path / "part", fields=["v"])
    with Dataset.open(tmp_path / "part") as dataset:
        assert dataset.fields("training")["v"].like == ""
