"""Fields of text: UTF-8 in a fixed number of bytes."""

import h5py
import numpy as np
import pytest

from physx_core import (
    Dataset,
    Field,
    NetworkConfig,
    Training,
    View,
)
from physx_core.dataset import EpisodeRecord
from physx_core.errors import ConfigError, FieldsMismatchError, FieldTypeError

LABEL = Field("label", (), "S8", role="additional")
NAMES = Field("names", (2,), "S4", role="additional")
TEXTS = ["steel", "", "größe", 'a b,"c"']


def rows(count=4):
    return {
        "label": [TEXTS[n % 4] for n in range(count)],
        "names": [[TEXTS[n % 2][:4], "ß"] for n in range(count)],
        "x": np.arange(float(count)),
    }


def store(folder, count=4, **options):
    with Dataset.create(folder, session="run", **options) as dataset:
        dataset.define_fields("training", [LABEL, NAMES, Field("x", ())])
        dataset.append("training", rows(count))


def decoded(values):
    return np.char.decode(np.asarray(values), "utf-8").tolist()


def test_text_is_stored_as_strings_that_h5py_reads(tmp_path):
    store(tmp_path, max_file_size=(2**14 + 24.5) * 1e-9)
    for path, place in (("run_training_label_0.h5", "data"), ("run.h5", "training/label")):
        with h5py.File(tmp_path / path) as file:
            stored = file[place]
            kind = h5py.check_string_dtype(stored.dtype)
            assert (kind.encoding, kind.length) == ("utf-8", 8)
            texts = stored.asstr()[:].tolist()
            assert texts and texts == TEXTS[: len(texts)]
    Dataset.rebuild(tmp_path)
    with Dataset.open(tmp_path) as dataset:
        assert dataset.verify() == [] and dataset.fields("training")["label"] == LABEL
        assert decoded(dataset["training"]["label"][:]) == TEXTS
        assert decoded(dataset["training"]["names"][1]) == ["", "ß"]


def test_text_is_changed_and_comes_with_batches(tmp_path):
    store(tmp_path)
    with Dataset.open(tmp_path, writable=True) as dataset:
        dataset.append_sample("training", {"label": "new", "names": ["a", "b"], "x": 4.0})
        dataset.flush()
        dataset.update("training", [0, 2], {"label": ["one", b"two"]})
    with View(hold_back=False).open(5, data=tmp_path) as batches:
        found = batches[0]
        known = dict(enumerate(["one", "", "two", TEXTS[3], "new"]))
        assert decoded(found["label"]) == [known[int(x)] for x in found["x"]]


def test_episodes_are_chosen_by_text(tmp_path):
    material = Field("material", (), "S8", role="episode")
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.define_fields("training", [Field("x", ())])
        records = [
            EpisodeRecord(episode=n, rows=1, fields={"material": text})
            for n, text in enumerate(["steel", "größe", "steel"])
        ]
        dataset.append_episodes(
            "training", {"x": np.arange(3.0)}, records, episode_fields=[material]
        )
    choice = tmp_path / "choose.py"
    choice.write_text("def steel(episodes):\n    return episodes['material'] == b'steel'\n")
    view = View(where=f"{choice}:steel", hold_back=False, order="stored")
    with view.open(3, data=tmp_path / "data") as batches:
        assert batches[0]["x"].tolist() == [0.0, 2.0]


@pytest.mark.parametrize(
    ("value", "match"),
    [
        ("größer als", "takes 12 bytes in UTF-8; it has room for 8"),
        (3, "holds 3 but is defined as text"),
        (b"\xff", "not UTF-8"),
        (np.array(b"\xff", "S8"), "not UTF-8"),
        ("a\0", "zero character"),
        ("\ud800", "not UTF-8"),
        (None, "defined as text"),
    ],
)
def test_values_that_are_no_text_of_its_size_are_refused(value, match):
    with pytest.raises(FieldTypeError, match=match):
        LABEL.convert(value)


def test_mistakes_with_text_say_what_to_do(tmp_path):
    with pytest.raises(ConfigError, match="S16"):
        Field("label", (), str)
    with pytest.raises(FieldTypeError, match="float64, which cannot hold it"):
        Field("x", ()).convert("3")
    with Dataset.create(tmp_path) as dataset, pytest.raises(FieldTypeError, match=r'"S16"\)'):
        dataset.append("training", {"label": ["steel"]})


def test_a_network_does_not_read_text(tmp_path):
    store(tmp_path / "data", 40)
    run = Training(
        NetworkConfig(
            "torch/fc", {"layers": [9, 1], "net_fields": ["label", "x"], "opt_fields": "x"},
            loss="MSELoss", optimizer="Adam",
        ),
        str(tmp_path / "data"), epoch_nb=1, batch_size=4, session_dir=str(tmp_path), quiet=True,
    )  # fmt: skip
    with pytest.raises(FieldsMismatchError, match="label"):
        run.execute()
