"""What physx stores, read by unmodified libraries of others; the trainers' side is in tests/gym."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.errors import ConfigError
from physx_formats import ExportOptions, export, import_file

pytestmark = pytest.mark.processes

PROGRAMS = Path(__file__).parent / "programs"
ROWS = 60


@pytest.fixture
def dataset(tmp_path):
    """Two instances with three trajectories of ten samples each, in turn."""
    rng = np.random.default_rng(0)
    rows = {
        "state": rng.normal(size=(ROWS, 3)),
        "grid": rng.normal(size=(ROWS, 2, 3)).astype("f4"),
        "image": rng.integers(0, 256, (ROWS, 4, 5, 3)).astype("u1"),
        "torque": rng.normal(size=(ROWS, 2)),
        "lever": rng.normal(size=ROWS),
        "goal": rng.normal(size=2).repeat(ROWS).reshape(2, ROWS).T,
        "reward": rng.normal(size=ROWS).astype("f4"),
        "flag": rng.integers(0, 2, ROWS).astype("?"),
        "env_id": np.tile([1, 2], ROWS // 2).astype("i4"),
        "episode": np.repeat([0, 1, 2], ROWS // 3),
        "step": np.arange(ROWS) // 2,
    }
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", rows)
        yield dataset


def unnested(values):
    """Return arrays of arrays, as pandas keeps them, as one array."""
    return np.stack([unnested(value) for value in values]) if values.dtype == "O" else values


def test_pandas_reads_the_parquet_file(dataset, tmp_path):
    pandas = pytest.importorskip("pandas")
    export(dataset, "parquet", tmp_path / "rows.parquet")
    frame = pandas.read_parquet(tmp_path / "rows.parquet")
    for name, values in dataset["training"].items():
        assert_array_equal(unnested(frame[name].to_numpy()), values[:])
    means = frame.groupby("env_id")["lever"].mean()
    assert means[1] == pytest.approx(dataset["training"]["lever"][:][::2].mean())


@pytest.mark.filterwarnings("error")
def test_xarray_finds_coordinates_units_and_episodes(tmp_path):
    xarray = pytest.importorskip("xarray")
    field = Field("u", (4, 2), unit="m/s", axes=("x", "channel"))
    where = {"x": [0.0, 0.5, 1.0, 1.5], "y": [1.0]}
    with Dataset.create(tmp_path / "set", info={"coordinates": where}) as dataset:
        more = [Field("time", unit="s"), Field("episode", (), int), Field("step", (), int)]
        dataset.define_fields("training", [field, *more])
        u, time = np.arange(48.0).reshape(6, 4, 2), np.arange(6) / 10
        episode, step = np.divmod(np.arange(6), 3)
        dataset.append("training", {"u": u, "time": time, "episode": episode, "step": step})
        export(dataset, "zarr", tmp_path / "rows.zarr")
    with xarray.open_zarr(tmp_path / "rows.zarr", group="training") as found:
        assert set(found.coords) == {"x", "time", "episode", "step"}
        assert found["u"].attrs["units"] == "m/s" and found["u"].dims == ("sample", "x", "channel")
        assert_array_equal(found["u"].sel(x=1.0).isel(channel=1), u[:, 2, 1])
        last = found["u"].where(found["episode"] == 1, drop=True)
        assert_array_equal(last["time"], time[3:])


@pytest.mark.filterwarnings("error")
def test_xarray_opens_the_zarr_folder(dataset, tmp_path):
    xarray = pytest.importorskip("xarray")
    export(dataset, "zarr", tmp_path / "rows.zarr")
    with xarray.open_zarr(tmp_path / "rows.zarr", group="training") as found:
        assert found.sizes["sample"] == ROWS
        for name, values in dataset["training"].items():
            assert found[name].dtype == values.dtype
            assert_array_equal(found[name].to_numpy(), values[:])
    with xarray.open_datatree(tmp_path / "rows.zarr", engine="zarr") as tree:
        assert list(tree.children) == ["training"]


def link_ffmpeg(folder):
    """Return a folder with PyAV's FFmpeg under the names by which LeRobot's decoder finds it."""
    folder.mkdir(exist_ok=True)
    own = Path(pytest.importorskip("av").__file__).parents[1] / "av.libs"
    for path in [*own.glob("libav*.so.*"), *own.glob("libsw*.so.*")]:
        name, _, version = path.name.partition(".so.")
        (folder / f"{name.split('-')[0]}.so.{version.split('.')[0]}").symlink_to(path)
    return folder


def run_lerobot(tmp_path, program, *words):
    """Run a program with LeRobot, and return what it printed."""
    library = Path(sys.prefix) / "lerobot"
    if not library.is_dir():
        assert not os.environ.get("CI"), f"{library} is missing: make test installs it"
        pytest.skip(f"LeRobot is not installed in {library}: make test installs it")
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    places = {"PYTHONPATH": str(library), "LD_LIBRARY_PATH": str(link_ffmpeg(tmp_path / "ffmpeg"))}
    variables = os.environ | offline | places
    command = [sys.executable, PROGRAMS / program, *words]
    ended = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    assert not ended.returncode, ended.stderr
    return ended.stdout


@pytest.mark.faults
def test_policies_of_lerobot_learn_from_its_format(dataset, tmp_path):
    features = {
        "observation.state": ["state", "lever"],
        "observation.environment_state": ["torque"],
        "action": ["torque"],
    }
    options = ExportOptions(features=features, fps=50)
    with pytest.raises(ConfigError, match='The field "torque" is chosen more than once'):
        export(dataset, "lerobot", tmp_path / "arm", options=options)
    features["observation.environment_state"] = ["goal"]
    export(dataset, "lerobot", tmp_path / "arm", options=options)
    said = run_lerobot(tmp_path, "train_lerobot.py", tmp_path / "arm").splitlines()
    assert [line.split()[0] for line in said] == ["act", "diffusion"]


@pytest.mark.faults
def test_lerobot_loads_its_format(dataset, tmp_path):
    options = ExportOptions(
        observations=["state"], actions=["torque", "lever"], rewards="reward", fps=50, task="swing"
    )
    assert export(dataset, "lerobot", tmp_path / "arm", options=options) == {"training": ROWS}
    run_lerobot(tmp_path, "read_lerobot.py", tmp_path / "arm", tmp_path / "out.npz")
    stored = {name: values[:] for name, values in dataset["training"].items()}
    order = np.lexsort([stored["step"], stored["env_id"], stored["episode"]])
    rows = {name: values[order] for name, values in stored.items()}
    actions = np.concatenate([rows["torque"], rows["lever"][:, None]], axis=1)
    with np.load(tmp_path / "out.npz") as found:
        # torch datasets of LeRobot give float32 and int64, whatever is stored
        assert_array_equal(found["observation.state"], rows["state"].astype("f4"))
        assert_array_equal(found["action"], actions.astype("f4"))
        assert_array_equal(found["next.reward"], rows["reward"])
        for name in ("grid", "image", "flag", "env_id", "episode", "step"):
            assert_array_equal(found[f"info.{name}"], rows[name])
        assert found["lengths"].tolist() == [10] * 6
        assert_array_equal(found["frame_index"], np.tile(np.arange(10), 6))
        assert_array_equal(found["timestamp"], np.tile(np.arange(10) / 50, 6).astype("f4"))
        following = np.where(np.arange(ROWS) % 10 == 9, np.arange(ROWS), np.arange(ROWS) + 1)
        assert_array_equal(found["ahead"][:, 1], rows["state"].astype("f4")[following])
        assert found["mean"] == pytest.approx(rows["state"].mean(axis=0))
        assert set(found["tasks"]) == {"swing"}


def camera_rows():
    """Rows of three trajectories, with pictures that change smoothly."""
    step, y, x = np.ogrid[:ROWS, :24, :32]
    phases = [step / 9 + x / 30 + 0 * y, step / 7 - y / 20 + 0 * x, (x + y - step) / 30]
    pictures = (128 + 100 * np.sin(np.stack(phases, axis=3))).astype("u1")
    episode, number = np.divmod(np.arange(ROWS), 20)
    state = np.arange(ROWS * 2.0).reshape(ROWS, 2)
    return {"q": state, "camera": pictures, "episode": episode, "step": number}


@pytest.mark.faults
def test_lerobot_decodes_its_videos(tmp_path):
    """Its decoder, torchcodec, finds by their times the pictures that the import finds, too."""
    rows = camera_rows()
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", rows)
        named = {"observation.state": ["q"], "observation.images.top": ["camera"]}
        options = ExportOptions(features=named, fps=50)
        export(dataset, "lerobot", tmp_path / "arm", options=options)
    run_lerobot(tmp_path, "read_lerobot.py", tmp_path / "arm", tmp_path / "out.npz")
    import_file(tmp_path / "arm", tmp_path / "back")
    with np.load(tmp_path / "out.npz") as found, Dataset.open(tmp_path / "back") as back:
        seen = 255 * found["observation.images.top"].transpose(0, 2, 3, 1)
        assert np.abs(seen - rows["camera"]).mean() < 2
        assert_array_equal(seen.round(), back["training"]["camera"][:])


@pytest.mark.faults
def test_what_lerobot_has_recorded_is_imported(tmp_path):
    rows = camera_rows()
    np.savez(tmp_path / "rows.npz", **rows)
    run_lerobot(tmp_path, "write_lerobot.py", tmp_path / "rows.npz", tmp_path / "recorded")
    import_file(tmp_path / "recorded", tmp_path / "data")
    with Dataset.open(tmp_path / "data") as dataset:
        found = dataset["training"]
        assert_array_equal(found["observation_state"][:], rows["q"])
        assert_array_equal(found["observation_images_png"][:], rows["camera"])
        for row, picture in enumerate(found["observation_images_video"][:].astype("f8")):
            apart = np.abs(rows["camera"] - picture).mean(axis=(1, 2, 3))
            assert apart.argmin() == row and apart[row] < 8
        assert_array_equal(found["episode"][:], rows["episode"])
        assert_array_equal(found["task_index"][:], rows["episode"])
        assert dataset.info["tasks"] == ["task 0", "task 1", "task 2"]
