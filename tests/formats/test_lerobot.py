"""Datasets of LeRobot, with their videos, written by physx and by others."""

import io
import json

import numpy as np
import pytest

from physx_core import Dataset
from physx_core.errors import ConfigError, MissingLibraryError, UsageError
from physx_formats import ExchangeError, ExportOptions, export, import_file
from physx_formats.cli.export import run

pyarrow = pytest.importorskip("pyarrow")
for library in ("pandas", "av"):
    pytest.importorskip(library)
ROWS = 12
FEATURES = {
    "observation.state": ["q", "v"],
    "observation.images.top": ["camera"],
    "action": ["torque"],
}


@pytest.fixture
def rows(tmp_path):
    """Two trajectories of six samples, of which each has a picture of another brightness."""
    numbers = np.arange(ROWS)
    shade = 20 * numbers[:, None, None, None] + np.arange(3) * 5
    found = {
        "q": np.random.default_rng(0).normal(size=(ROWS, 2)), "v": numbers / 3,
        "torque": np.random.default_rng(1).normal(size=(ROWS, 2)).astype("f4"),
        "camera": np.broadcast_to(shade, (ROWS, 17, 20, 3)).astype("u1"),
        "mask": np.random.default_rng(2).integers(0, 256, (ROWS, 4, 5, 3)).astype("u1"),
        "step": numbers % 6, "episode": numbers // 6,
    }  # fmt: skip
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", found)
    return found


@pytest.fixture
def written(rows, tmp_path):
    options = ExportOptions(features=FEATURES, fps=30, task="lift")
    with Dataset.open(tmp_path / "data") as dataset:
        export(dataset, "lerobot", tmp_path / "out", options=options)
    return tmp_path / "out"


def change(folder, function):
    """Change what a dataset says of itself."""
    place = folder / "meta/info.json"
    info = json.loads(place.read_text())
    function(info)
    place.write_text(json.dumps(info))


def imported(folder, tmp_path):
    import_file(folder, tmp_path / "copy")
    with Dataset.open(tmp_path / "copy") as dataset:
        return {name: values[:] for name, values in dataset["training"].items()}, dataset.info


def assert_close(found, pictures):
    """Check that each picture is the one of its row: the rows' shades differ by 20."""
    assert np.abs(np.subtract(found, pictures, dtype=float)).max() < 8


def test_fields_of_a_feature_and_pictures_come_back(rows, written, tmp_path):
    found, _ = imported(written, tmp_path)
    assert_close(found.pop("camera"), rows.pop("camera"))
    assert found.keys() == rows.keys()
    for name, values in rows.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_statistics_of_pictures_are_those_of_their_colors(rows, written):
    stats = json.loads((written / "meta/stats.json").read_text())["observation.images.top"]
    colors = rows["camera"].reshape(-1, 3) / 255
    for name, function in (("mean", np.mean), ("std", np.std), ("max", np.max)):
        assert np.shape(stats[name]) == (3, 1, 1)
        np.testing.assert_allclose(np.ravel(stats[name]), function(colors, axis=0))


def test_videos_of_several_files_come_back(rows, tmp_path, monkeypatch):
    monkeypatch.setattr("physx_formats.files.lerobot.video.FILE_BYTES", -1)
    test_fields_of_a_feature_and_pictures_come_back(
        rows, written.__wrapped__(rows, tmp_path), tmp_path
    )
    assert len([*(tmp_path / "out").rglob("*.mp4")]) == 2


def test_datasets_of_others_are_imported(rows, written, tmp_path):
    def forget(info):
        del info["physx"]
        for feature in info["features"].values():
            feature.pop("fields", None)

    change(written, forget)
    found, info = imported(written, tmp_path)
    assert_close(found["observation_images_top"], rows["camera"])
    state = np.column_stack([rows["q"], rows["v"]])
    np.testing.assert_array_equal(found["observation_state"], state)
    np.testing.assert_array_equal(found["episode"], rows["episode"])
    np.testing.assert_array_equal(found["step"], rows["step"])
    np.testing.assert_allclose(found["timestamp"], rows["step"] / 30, rtol=1e-6)
    assert (info["tasks"], info["fps"]) == (["lift"], 30)


def test_images_in_the_rows_are_imported(rows, written, tmp_path):
    parquet, image = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("PIL.Image")
    (place,) = written.glob("data/*/*.parquet")

    def store(contents):
        column = pyarrow.array([{"bytes": each, "path": None} for each in contents])
        table = parquet.read_table(place)
        if "info.png" in table.column_names:
            table = table.drop(["info.png"])
        parquet.write_table(table.append_column("info.png", column), place)

    files = [io.BytesIO() for _ in range(ROWS)]
    for file, picture in zip(files, rows["camera"], strict=True):
        image.fromarray(picture).save(file, "PNG")
    store([file.getvalue() for file in files])
    png = {"dtype": "image", "shape": [3, 17, 20], "names": ["channels", "height", "width"]}
    change(written, lambda info: info.pop("physx") and info["features"].update({"info.png": png}))
    found, _ = imported(written, tmp_path)
    np.testing.assert_array_equal(found["info_png"], rows["camera"])
    store([b"nothing"] * ROWS)
    with pytest.raises(ExchangeError, match=r'"info.png" has what is no picture'):
        import_file(written, tmp_path / "other")


def test_the_command_says_that_colors_are_lost_if_there_are_pictures(rows, tmp_path, capsys):
    words = [str(tmp_path / "data"), str(tmp_path / "out"), "--to", "lerobot", "--fps", "30"]
    run([*words, "--as", "observation.state=q,v", "observation.images.top=camera"])
    assert "whose colors are only close" in capsys.readouterr().out
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["observation.state"]["fields"] == ["q", "v"]
    with pytest.raises(UsageError, match="--as q names no value"):
        run([*words, "--as", "q"])


def test_a_feature_is_no_path(rows, tmp_path):
    options = ExportOptions(features={"observation.images.a/../b": ["camera"]}, fps=30)
    with (
        Dataset.open(tmp_path / "data") as dataset,
        pytest.raises(ConfigError, match='a/../b" needs a name without "/"'),
    ):
        export(dataset, "lerobot", tmp_path / "out", options=options)


@pytest.mark.parametrize("of", [["mask", "camera"], ["q"]])
def test_what_is_no_picture_is_named(rows, tmp_path, of):
    options = ExportOptions(features={"observation.images.top": of}, fps=30)
    with (
        Dataset.open(tmp_path / "data") as dataset,
        pytest.raises(ExchangeError, match=r'"q"|vectors'),
    ):
        export(dataset, "lerobot", tmp_path / "out", options=options)


def test_a_missing_library_of_videos_is_named(rows, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingLibraryError, match=r"physx.formats\[lerobot\]"):
        written.__wrapped__(rows, tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda info: info.update(codebase_version="v2.1"), "version 'v2.1'.* v3.0"),
        (lambda info: info.update(fps=0), "info.json is damaged"),
        (lambda info: info.update(features=[1]), "info.json is damaged"),
        (lambda info: info["features"]["action"].update(shape=[9]), "components of 9"),
        (lambda info: info["features"]["action"].update(dtype="O"), "of type object"),
        (lambda info: info["features"]["action"].update(dtype="int64"), "values of float32"),
        (lambda info: info["features"]["action"].update(fields=["x"]), '"action".* damaged'),
        (
            lambda info: info["features"].update(
                {"../x": {"dtype": "video", "shape": [4, 5, 3], "fields": ["camera"]}}
            ),
            "not that of a folder",
        ),
        (
            lambda info: info["features"]["observation.images.top"].update(shape=[16, 20, 3]),
            "17 x 20 pixels, not of 16 x 20",
        ),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused(written, tmp_path, damage, message):
    change(written, damage)
    with pytest.raises(ExchangeError, match=message):
        import_file(written, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("kept", [0, 0.5])
def test_a_damaged_video_is_named(written, tmp_path, kept):
    (video,) = written.rglob("*.mp4")
    content = video.read_bytes()
    video.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ExchangeError, match=r"file-000.mp4"):
        import_file(written, tmp_path / "copy")
