"""Datasets with other rows or fields than those they were made from."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physx_core import Dataset, Field
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus
from physx_core.errors import ConfigError, DatasetError, FieldTypeError, UsageError
from physx_core.views import View
from physx_formats import ExchangeError, edit
from physx_formats.cli import edit as command
from physx_formats.transfer import episodes

pytestmark = pytest.mark.processes
MESH = Field("mesh", (2,), "f4", "m", role="episode")
MASS = Field("mass", (), "f8", "kg", role="additional")
FIELDS = [
    Field("x", (), "f8", "m"),
    Field("y", (2,), "f4", like=""),
    Field("z", (), "f8", "m", like="x"),
]


def values_of(episode, rows):
    """Return the rows of an episode: all of its values follow from two numbers."""
    x = 100.0 * episode + np.arange(rows)
    return {"x": x, "y": np.stack([x, -x], 1).astype("f4"), "z": x + 0.5}


def store(dataset, lengths):
    """Store episodes with these numbers of rows; one without rows has failed."""
    dataset.define_fields("training", FIELDS)
    dataset.define_episodes([MASS], [MESH])
    for number, rows in enumerate(lengths):
        status = EpisodeStatus.FINISHED if rows else EpisodeStatus.FAILED
        record = EpisodeRecord(
            episode=number,
            rows=rows,
            status=status,
            seconds=0.25,
            parameters={"mass": 0.5 * number},
            fields={"mesh": [number, 1.0]} if rows else {},
            reason="" if rows else f"it fell {number}",
        )
        dataset.append_episodes(
            "training", values_of(number, rows), [record], episode_fields=[MESH]
        )


@pytest.fixture
def data(tmp_path):
    with Dataset.create(tmp_path / "data", info={"environment": "toy/spring"}) as dataset:
        store(dataset, [5, 0, 3, 8])
    return tmp_path / "data"


def rows_of(folder, name="x", mode="training"):
    with Dataset.open(folder) as dataset:
        return dataset[mode][name][:].tolist()


def sums(rows):
    """Derive a field that depends on all earlier rows of a trajectory."""
    return {"sum": np.cumsum(rows["x"]), "y": rows["y"] * 2}


def test_what_is_not_named_stays_as_it_is(data, tmp_path):
    assert edit(data, tmp_path / "copy") == {"training": 16}
    with Dataset.open(data) as one, Dataset.open(tmp_path / "copy") as other:
        assert other.fields("training") == one.fields("training")
        assert other.fields(EPISODES) == one.fields(EPISODES)
        tables = [each.episode_table(["training"]) for each in (one, other)]
        for name in tables[0]:
            assert tables[1][name].tobytes() == tables[0][name].tobytes(), name
        for name in one.fields("training"):
            assert other["training"][name][:].tobytes() == one["training"][name][:].tobytes()
        assert other.failed_episodes("training") == one.failed_episodes("training")
        assert other.verify() == []
        assert other.info["environment"] == "toy/spring"
        assert other.info["edits"][0]["dataset"] == "data"


@pytest.mark.reported(
    "lerobot#630",
    "lerobot#378",
    "lerobot#2111",
    about="episodes and frames are deleted from a dataset",
)
def test_episodes_and_rows_are_chosen(data, tmp_path):
    edit(data, tmp_path / "few", drop_episodes=[0], view=View(hold_back=False, stride=3))
    assert rows_of(tmp_path / "few") == [200, 300, 303, 306]
    with pytest.warns(UserWarning, match="1 of 2 trajectories"):
        edit(tmp_path / "few", tmp_path / "fewer", rows=lambda rows: rows["x"] % 2 == 0)
    assert rows_of(tmp_path / "fewer") == [200, 300, 306]
    heavy = View(hold_back=False, episodes={"mass": [1.0, 9.0]})
    edit(data, tmp_path / "heavy", view=heavy)
    assert rows_of(tmp_path / "heavy") == [*range(200, 203), *range(300, 308)]
    with Dataset.open(tmp_path / "heavy") as dataset:
        assert dataset.failed_episodes("training") == []
    edit(data, tmp_path / "gone", drop_episodes=[1])
    with Dataset.open(tmp_path / "gone") as dataset:
        assert dataset.failed_episodes("training") == [] and dataset.num_samples("training") == 16
    with Dataset.open(tmp_path / "fewer") as dataset:
        assert "0x" not in str(dataset.info["edits"])
        found = dataset.recorded_episodes("training")
        entries = np.flatnonzero(found.rows)
        assert found.episode[entries].tolist() == [2, 3]
        assert found.rows[entries].tolist() == [1, 2]
        assert [each.episode for each in dataset.failed_episodes("training")] == [1]
        values = dataset.recorded_values("training", entries)
        assert values["mass"].tolist() == [1.0, 1.5]
        assert values["mesh"].tolist() == [[2, 1], [3, 1]]
        assert [each["dataset"] for each in dataset.info["edits"]] == ["data", "few"]


@pytest.mark.reported(
    "lerobot#2326",
    "deepmind-research#655",
    about="a feature is added to a dataset, or derived later",
)
def test_fields_are_derived_cast_renamed_and_dropped(data, tmp_path):
    edit(
        data,
        tmp_path / "other",
        derive=sums,
        cast={"x": "f4"},
        units={"sum": "m s"},
        rename={"x": "position", "sum": "path"},
        drop=["y"],
    )
    with Dataset.open(tmp_path / "other") as dataset:
        fields = dataset.fields("training")
        assert list(fields) == ["position", "z", "path"]
        assert fields["position"] == Field("position", (), "f4", "m")
        assert fields["z"].like == "position" and fields["path"].unit == "m s"
        wanted = np.concatenate(
            [np.cumsum(values_of(n, r)["x"]) for n, r in ((0, 5), (2, 3), (3, 8))]
        )
        assert dataset["training"]["path"][:].tolist() == wanted.tolist()
        assert dataset.verify() == []
    edit(data, tmp_path / "only", keep=["z", "y"], derive=sums)
    with Dataset.open(tmp_path / "only") as dataset:
        fields = dataset.fields("training")
        assert list(fields) == ["y", "z"] and fields["z"].like == ""
        x = np.array(rows_of(data))
        assert dataset["training"]["y"][:].tolist() == np.stack([2 * x, -2 * x], 1).tolist()


def test_a_held_back_part_is_written_alone(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        store(dataset, [2] * 20)
    found = [
        edit(tmp_path / "data", tmp_path / part, part=part, view=View())["training"]
        for part in ("training", "validation")
    ]
    assert found == [32, 8]
    assert not set(rows_of(tmp_path / "training")) & set(rows_of(tmp_path / "validation"))


def test_ranges_of_one_row_episodes_are_cut(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        rows = {"x": np.arange(8.0)}
        dataset.append_episodes("training", rows, [EpisodeRecord(episode=0, rows=8, count=8)])
    edit(tmp_path / "data", tmp_path / "some", drop_episodes=[2, 6])
    with Dataset.open(tmp_path / "some") as dataset:
        found = dataset.recorded_episodes("training")
        assert found.episode[found.rows > 0].tolist() == [0, 3, 7]
        assert found.numbers[found.rows > 0].tolist() == [2, 3, 1]
        assert dataset["training"]["x"][:].tolist() == [0, 1, 3, 4, 5, 7]


def test_interleaved_streams_keep_their_trajectories(tmp_path):
    rows, instances = 7, 2
    env_id, step = np.tile([1, 2], rows), np.repeat(np.arange(rows), instances)
    with Dataset.create(tmp_path / "data") as dataset:
        fields = [
            Field(name, (), "i8", role="additional") for name in ("env_id", "episode", "step")
        ]
        dataset.define_fields("training", [Field("x", ()), *fields])
        given = {"x": step * 1.0 + 100 * env_id, "env_id": env_id, "step": step}
        dataset.append("training", given | {"episode": np.zeros(rows * instances, "i8")})
    edit(
        tmp_path / "data",
        tmp_path / "thin",
        view=View(hold_back=False, stride=3),
        derive=lambda rows: {"gone": rows["x"] - rows["x"][0]},
    )
    with Dataset.open(tmp_path / "thin") as dataset:
        assert dataset["training"]["env_id"][:].tolist() == [1, 2] * 3
        assert dataset["training"]["gone"][:].tolist() == [0, 0, 3, 3, 6, 6]
        assert [len(each.rows) for each in dataset.episodes("training")] == [3, 3]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*gaps")
@settings(max_examples=15, deadline=None)
@given(
    lengths=st.lists(st.integers(0, 6), min_size=1, max_size=5).filter(any),
    stride=st.integers(1, 4),
    dropped=st.sets(st.integers(0, 4)),
    modulus=st.integers(1, 3),
    block=st.sampled_from([16, 2**20]),
)
def test_edits_have_the_rows_of_lists(tmp_path_factory, lengths, stride, dropped, modulus, block):
    folder = tmp_path_factory.mktemp("edits")
    with Dataset.create(folder / "data") as dataset:
        store(dataset, lengths)
    wanted = [
        (number, [v for v in values_of(number, rows)["x"][::stride].tolist() if v % modulus == 0])
        for number, rows in enumerate(lengths)
        if number not in dropped
    ]
    wanted = [(number, values) for number, values in wanted if values]

    def run(out):
        edit(
            folder / "data",
            folder / out,
            view=View(hold_back=False, stride=stride),
            drop_episodes=dropped,
            rows=lambda rows: rows["x"] % modulus == 0,
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episodes, "BLOCK", block)
        if not wanted:
            with pytest.raises(DatasetError, match="Nothing would be left"):
                run("out")
            assert not (folder / "out").exists()
            return
        run("out")
        run("again")
    with Dataset.open(folder / "out") as found, Dataset.open(folder / "again") as again:
        records = found.recorded_episodes("training")
        full = records.rows > 0
        assert records.episode[full].tolist() == [number for number, _ in wanted]
        assert found["training"]["x"][:].tolist() == [v for _, values in wanted for v in values]
        assert found.contents("training") == again.contents("training")
        assert found.verify() == []


MISTAKES = {
    "exists": ({}, ExchangeError, "exists already"),
    "an unknown field": ({"drop": ["w"]}, ConfigError, 'no field "w"'),
    "all fields": ({"drop": ["x", "y", "z"]}, ConfigError, "No field would be left"),
    "a name twice": ({"rename": {"x": "z"}}, ConfigError, 'Two fields would be called "z"'),
    "kept and dropped": ({"keep": ["x"], "drop": ["x"]}, ConfigError, "kept and dropped"),
    "a trajectory": ({"drop": ["step"]}, ConfigError, "it must stay"),
    "a type that does not fit": ({"cast": {"x": "i4"}}, FieldTypeError, "x"),
    "no row": ({"rows": lambda rows: rows["x"] < 0}, DatasetError, "Nothing would be left"),
    "no booleans": ({"rows": lambda rows: rows["x"]}, ExchangeError, "not one boolean"),
    "no arrays": ({"derive": lambda rows: 3}, ExchangeError, "not arrays by field name"),
    "too few": ({"derive": lambda rows: {"a": rows["x"][1:]}}, ExchangeError, "of shape"),
    "an unknown column": ({"derive": lambda rows: {"a": rows["w"]}}, ConfigError, 'no field "w"'),
    "windows": ({"view": View(window={"a": ("x", [0])})}, ConfigError, "Only what a View says"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_leave_nothing_behind(data, tmp_path, name):
    options, error, text = MISTAKES[name]
    (tmp_path / "kept").mkdir()
    out = tmp_path / ("kept" if name == "exists" else "out")
    with pytest.raises(error, match=text):
        edit(data, out, **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "kept"]


def test_the_command_line(data, tmp_path, capsys):
    (tmp_path / "own.py").write_text(
        "import numpy as np\n"
        "def sums(rows):\n    return {'sum': np.cumsum(rows['x'])}\n"
        "def even(rows):\n    return rows['x'] % 2 == 0\n"
    )
    words = "--episodes episode=2:3 --stride 2 --rows own.py:even --derive own.py:sums"
    words += " --drop z --cast y=float64 --units sum=m --rename x=position"
    command.run([str(data), "out", *words.split()])
    assert "6 training samples: out" in capsys.readouterr().out
    assert rows_of("out", "position") == [200, 202, 300, 302, 304, 306]
    assert rows_of("out", "sum")[:2] == [200, 603]
    with Dataset.open("out") as dataset:
        said = dataset.info["edits"][0]
        assert said["stride"] == 2 and said["rename"] == {"x": "position"}
        assert said["derive"] == "own.py:sums" and said["episodes"] == {"episode": [2.0, 3.0]}
    for word in ("--rename x", "--episodes mass=heavy"):
        with pytest.raises(UsageError, match="write"):
            command.run([str(data), "other", *word.split()])


def test_a_killed_edit_leaves_no_dataset(data, tmp_path):
    program = (
        "import os, signal\nfrom physx_formats import edit\n"
        f"edit({str(data)!r}, 'out', rows=lambda rows: os.kill(os.getpid(), signal.SIGKILL))"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    assert not (tmp_path / "out").exists()
    assert edit(data, tmp_path / "out") == {"training": 16}


def test_values_of_free_axes_are_derived(tmp_path):
    rows = {"before": [np.arange(3.0), np.arange(5.0)], "n": np.arange(2)}
    with Dataset.create(tmp_path / "data") as dataset:
        fields = [Field("before", ("node",), unit="K"), Field("n", (), "int64")]
        dataset.define_fields("training", fields)
        dataset.append("training", rows)

    def derive(rows):
        return {
            "twice": rows["before"] * 2,
            "pairs": [np.stack([each, -each], 1) for each in rows["before"]],
            "before": [each + 1 for each in rows["before"]],
        }

    edit(tmp_path / "data", tmp_path / "out", derive=derive, units={"twice": "K"})
    with Dataset.open(tmp_path / "out") as found:
        assert found.fields("training")["pairs"].shape == ("node", 2)
        for row, before in enumerate(rows["before"]):
            values = {name: found["training"][name][row] for name in ("twice", "pairs", "before")}
            np.testing.assert_array_equal(values["twice"], 2 * before)
            np.testing.assert_array_equal(values["pairs"][:, 1], -before)
            np.testing.assert_array_equal(values["before"], before + 1)
    with pytest.raises(ExchangeError, match=r"the sizes of no free axis: there are node"):
        edit(tmp_path / "data", tmp_path / "no", derive=lambda r: {"x": [np.ones(9)] * len(r["n"])})
