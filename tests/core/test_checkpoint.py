"""Checkpoints: what is damaged is never used, and what was saved is on the disk."""

import contextlib
import os
import shutil
import tomllib
import zlib
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from safetensors.numpy import load_file, save

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Normalization,
    Prediction,
    Training,
    View,
    checkpoint,
    files,
)
from physx_core.checkpoint import DESCRIPTION, Progress, find, list_numbers, read
from physx_core.cli import main
from physx_core.errors import CheckpointError, SessionError
from physx_core.pipelines import Learner, load_learner
from physx_core.toy import LeastSquares, Linear

pytestmark = pytest.mark.processes

PARAMETERS, STATE = "parameters.npz", "state.txt"


class Stateful(LeastSquares):
    """An optimization with a state to resume from."""

    state_file = STATE

    def save_state(self, path):
        path.write_text("weights were solved for\n" * 40)


class Interrupted(Linear):
    """Writes half of its parameters when the user presses Ctrl-C."""

    def save_parameters(self, path):
        path.write_bytes(b"half")
        raise KeyboardInterrupt


def learner(weight=1.0, *, size=2, network=Linear):
    config = NetworkConfig(network, {"net_fields": "x", "opt_fields": "y"}, optimization=Stateful)
    made = Learner(config, trains=True)
    made.bind({name: Field(name, (size,)) for name in ("x", "y")}, {})
    made.network.weights = np.full((size + 1, size), weight)
    return made


def progress(epoch):
    return Progress(epoch, 0, epoch, 0)


def saved(session, count=3, **options):
    """Save numbered checkpoints with the weights 0, 1 ... and the last one as the best."""
    session.mkdir(exist_ok=True)
    paths = []
    for number in range(count):
        made = learner(number, **options)
        paths.append(made.save(session / "network", progress(number)))
    made.save(session / "network", progress(count - 1), best=True)
    return paths


def weight(place, which=-1):
    """Return the weight of a network as a user loads it."""
    found = load_learner(place, NetworkConfig(which_network=which))
    assert len(set(found.network.weights.ravel())) == 1
    return found.network.weights[0, 0]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# Damage -----------------------------------------------------------------------------------------


def test_a_checkpoint_describes_each_of_its_files(tmp_path):
    path = saved(tmp_path / "run", 1)[0]
    plain = tomllib.loads((path / DESCRIPTION).read_text())
    assert plain["format_version"] == 3
    sizes = {name: item["nbytes"] for name, item in plain["files"].items()}
    assert sizes == {name: (path / name).stat().st_size for name in (PARAMETERS, STATE)}
    assert list(plain)[-1] == "checksum"


@pytest.mark.parametrize("name", [DESCRIPTION, PARAMETERS, STATE])
def test_one_flipped_bit_anywhere_is_noticed_and_names_the_file(tmp_path, name):
    path = saved(tmp_path / "run", 1)[0]
    sound = (path / name).read_bytes()
    last = range(len(sound) - 60, len(sound))
    for place in sorted({*range(0, len(sound), 5), *last}):
        content = bytearray(sound)
        content[place] ^= 1 << (place % 8)
        (path / name).write_bytes(content)
        with pytest.raises(CheckpointError, match=rf"network_0.*{name}.*backup") as caught:
            find(tmp_path / "run", "network", 0)
        assert "Traceback" not in str(caught.value)
    (path / name).write_bytes(sound)
    assert find(tmp_path / "run", "network", 0) == read(path)


@pytest.mark.parametrize("name", [DESCRIPTION, PARAMETERS, STATE])
def test_files_that_were_cut_or_grew_or_are_missing_are_noticed(tmp_path, name):
    path = saved(tmp_path / "run", 1)[0]
    sound = (path / name).read_bytes()
    lengths = sorted({*range(0, len(sound), 7), *range(len(sound) - 60, len(sound))})
    for content in (*(sound[:length] for length in lengths), sound + b"\n", bytes(len(sound))):
        (path / name).write_bytes(content)
        with pytest.raises(CheckpointError, match=rf"network_0.*{name}.*backup"):
            read(path)
    (path / name).unlink()
    with pytest.raises(CheckpointError, match=rf"{name} is missing.*backup"):
        read(path)
    (path / name).symlink_to("/dev/zero")
    with pytest.raises(CheckpointError, match=name):
        read(path)


def test_a_description_that_was_edited_by_hand_says_how_to_go_on(tmp_path):
    path = saved(tmp_path / "run", 1)[0]
    file = path / DESCRIPTION
    text = file.read_text().replace("epoch = 0", "epoch = 7")
    file.write_text(text)
    with pytest.raises(CheckpointError, match='edited by hand.*put crc32 = "edited" under'):
        read(path)
    crc = tomllib.loads(text)["checksum"]["crc32"]
    file.write_text(text.replace(f'[checksum]\ncrc32 = "{crc}"', '[checksum]\ncrc32 = "edited"'))
    assert read(path).progress.epoch == 7
    content = bytearray((path / PARAMETERS).read_bytes())
    content[100] ^= 1
    (path / PARAMETERS).write_bytes(content)
    with pytest.raises(CheckpointError, match=PARAMETERS):
        read(path)


@pytest.mark.parametrize("end", ["", '[checksum]\ncrc32 = "edited"\n'])
def test_a_later_format_is_not_called_damaged(tmp_path, end):
    path = saved(tmp_path / "run", 1)[0]
    file = path / DESCRIPTION
    text = file.read_text().replace("format_version = 3", "format_version = 4")
    file.write_text(text[: text.index("[checksum]")] + end)
    with pytest.raises(CheckpointError, match="version 4.*reads version 3.*pip install --upgrade"):
        read(path)


def test_an_earlier_format_is_refused_because_its_normalization_was_text(tmp_path):
    path = saved(tmp_path / "run", 1)[0]
    file = path / DESCRIPTION
    text = file.read_text().replace("format_version = 3", "format_version = 2")
    file.write_text(text[: text.index("[checksum]")] + '[checksum]\ncrc32 = "edited"\n')
    with pytest.raises(CheckpointError, match=r"version 2.*reads version 3.*Train .* again"):
        read(path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "format_version = 3",
        "format_version = 'two'",
        "format_version = 3\nfields = 3\nprogress = 4",
        "format_version = 3\nfields = [" * 5000,
        'format_version = 3\nfiles = {"../x" = {}}\n[checksum]\ncrc32 = "edited"\n',
        "\xff",
    ],
)
def test_any_text_in_place_of_a_description_is_a_checkpoint_error(tmp_path, text):
    path = saved(tmp_path / "run", 1)[0]
    (path / DESCRIPTION).write_text(text, encoding="latin-1")
    with pytest.raises(CheckpointError, match=DESCRIPTION):
        read(path)


# Normalization ----------------------------------------------------------------------------------


def normalized(session, shape):
    """Save a checkpoint with a normalization of two fields of a shape; return both."""
    session.mkdir()
    rng = np.random.default_rng(0)
    config = NetworkConfig(Linear, {"net_fields": "x", "opt_fields": "y"}, optimization=Stateful)
    made = Learner(config, trains=True)
    given = {name: Normalization(*rng.random((4, *shape))) for name in ("x", "y", "z")}
    made.bind({name: Field(name, shape) for name in given}, given)
    return made.save(session / "network", progress(0)), given


def test_a_normalization_is_kept_bit_for_bit_in_a_file_of_arrays(tmp_path):
    path, given = normalized(tmp_path / "run", (2, 3))
    found = read(path).normalization
    assert found.keys() == {"x", "y"}
    for name, one in found.items():
        for part in ("mean", "std", "minimum", "maximum"):
            np.testing.assert_array_equal(getattr(one, part), getattr(given[name], part))
    stored = load_file(path / "normalization.safetensors")
    np.testing.assert_array_equal(stored["x/mean"], given["x"].mean)
    assert "normalization.safetensors" in tomllib.loads((path / DESCRIPTION).read_text())["files"]


def test_a_description_has_the_same_size_for_a_field_of_any_width(tmp_path):
    sizes = [
        (normalized(tmp_path / f"{width}", (width, width))[0] / DESCRIPTION).stat().st_size
        for width in (2, 30)
    ]
    assert max(sizes) - min(sizes) < 200
    assert not (saved(tmp_path / "plain", 1)[0] / "normalization.safetensors").exists()


@pytest.mark.parametrize("how", ["flipped", "cut", "gone", "longer"])
def test_a_damaged_normalization_is_noticed(tmp_path, how):
    path, _ = normalized(tmp_path / "run", (4,))
    file = path / "normalization.safetensors"
    content = bytearray(file.read_bytes())
    content[-3] ^= 4
    if how == "gone":
        file.unlink()
    else:
        sound = file.read_bytes()
        file.write_bytes({"flipped": content, "cut": sound[:-8], "longer": sound + b"0"}[how])
    with pytest.raises(CheckpointError, match=r"normalization\.safetensors"):
        read(path)


@pytest.mark.parametrize(
    "arrays",
    [
        {"x/mean": np.zeros(4), "x/std": np.ones(3)},
        {"x/mean": np.array([0.0, 1, np.nan, 3]), "x/std": np.ones(4)},
        {"x/mean": np.zeros(4)},
        {"other/mean": np.zeros(4), "other/std": np.ones(4)},
        {"mean": np.zeros(4)},
        {"x/mean": np.zeros(4, "int32"), "x/std": np.ones(4)},
        None,
    ],
)
def test_arrays_that_are_no_normalization_are_a_checkpoint_error(tmp_path, arrays):
    path, _ = normalized(tmp_path / "run", (4,))
    content = b"text" * 99 if arrays is None else save(arrays)
    (path / "normalization.safetensors").write_bytes(content)
    file = path / DESCRIPTION
    plain = tomllib.loads(file.read_text())
    plain["files"]["normalization.safetensors"] = {
        "nbytes": len(content), "crc32": f"{zlib.crc32(content):08x}"
    }  # fmt: skip
    file.write_text(tomli_w.dumps({**plain, "checksum": {"crc32": "edited"}}))
    with pytest.raises(CheckpointError, match="network_0"):
        read(path)


# Stepping back ----------------------------------------------------------------------------------


def damage(path, how):
    file = path / {"empty": DESCRIPTION, "gone": DESCRIPTION}.get(how, PARAMETERS)
    if how == "gone":
        file.unlink()
    else:
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 16
        file.write_bytes(b"" if how == "empty" else content)


@pytest.mark.parametrize("how", ["empty", "gone", "flip"])
def test_the_last_readable_checkpoint_is_used_with_a_warning(tmp_path, how):
    paths = saved(tmp_path / "run", 4)
    damage(paths[3], how)
    damage(paths[2], "flip")
    with pytest.warns(
        UserWarning, match=r"network_1, because later.*\n.*network_3: .*\n.*network_2: "
    ):
        assert weight(tmp_path / "run") == 1
    for number in (2, 3):
        others = [f"network_{n}" for n in (0, 1, 2, 3) if n != number]
        with pytest.raises(CheckpointError, match=f"Other checkpoints: {', '.join(others)}"):
            weight(tmp_path / "run", number)
    damage(tmp_path / "run" / "network" / "network_best", how)
    with pytest.raises(CheckpointError, match="network_best.*Other checkpoints: network_0"):
        weight(tmp_path / "run", "best")


def test_if_none_can_be_read_each_is_named_with_its_reason(tmp_path):
    for path, how in zip(saved(tmp_path / "run"), ("empty", "gone", "flip"), strict=True):
        damage(path, how)
    message = (
        r"None of the checkpoints in .*network_2: parameters.npz.*checksum"
        r".*network_1: checkpoint.toml is missing.*network_0: checkpoint.toml .*0 bytes.*best"
    )
    with pytest.raises(CheckpointError, match=f"(?s){message}"):
        weight(tmp_path / "run")


def test_no_number_is_used_twice(tmp_path):
    paths = saved(tmp_path / "run")
    damage(paths[2], "gone")
    before = (paths[2] / PARAMETERS).read_bytes()
    assert learner(9).save(tmp_path / "run" / "network", progress(3)).name == "network_3"
    assert (paths[2] / PARAMETERS).read_bytes() == before


@pytest.fixture
def trained():
    """A session with the checkpoints of four epochs, in the working directory."""
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        rows = {"state": rng.random((20, 2)), "force": rng.random((20, 1))}
        dataset.append("training", {**rows, "next_state": rng.random((20, 2))})
    training(4).execute()
    return Path("sessions/training")


def training(epochs, **options):
    config = NetworkConfig("toy/linear", save_each_epoch=True)
    data = DatasetConfig(existing_dir="data", view=View(hold_back=False))
    return Training(config, data, epoch_nb=epochs, batch_size=5, seed=0, **options)


def test_commands_step_back_and_say_so(trained, capsys):
    damage(trained / "network" / "network_3", "flip")
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    for run in (
        Prediction(NetworkConfig(), spring, step_nb=1).execute,
        training(5, resume=True).execute,
    ):
        with pytest.warns(
            UserWarning, match=r"network_2, because later.*\n.*network_3: parameters"
        ):
            run()
    assert "network_3: parameters.npz is damaged" in (trained / "info.txt").read_text()
    assert list_numbers(trained / "network", "network") == [0, 1, 2, 3, 4, 5]
    assert find(trained, "network", -1).progress.epoch == 5
    damage(trained / "network" / "network_1", "empty")
    assert main(["info", str(trained), "--verify"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "checkpoint network" in line]
    assert [("cannot be read" in line) for line in lines] == [
        False,
        True,
        False,
        True,
        False,
        False,
    ]
    for number in range(6):
        damage(trained / "network" / f"network_{number}", "gone")
    for words in (["info"], ["export-network", "--to", "onnx"], ["predict", "toy/spring"]):
        assert main([words[0], str(trained), *words[1:]]) == 1
        text = capsys.readouterr().err
        assert "None of the checkpoints" in text and "Traceback" not in text


# Saving -----------------------------------------------------------------------------------------


class Recorder:
    """Stands in for the module `os`: keeps the order in which files reach the disk."""

    def __init__(self):
        self.paths, self.calls = {}, []

    def __getattr__(self, name):
        return getattr(os, name)

    def open(self, path, *arguments):
        descriptor = os.open(path, *arguments)
        self.paths[descriptor] = Path(path).absolute()
        return descriptor

    def fsync(self, descriptor):
        self.calls.append(("sync", self.paths[descriptor]))
        os.fsync(descriptor)

    fdatasync = fsync

    def pwrite(self, descriptor, *arguments):
        self.calls.append(("write", self.paths[descriptor]))
        return os.pwrite(descriptor, *arguments)

    def replace(self, path, target):
        before = {p.name for p in Path(path).iterdir()} if Path(path).is_dir() else set()
        self.calls.append(("rename", Path(path).absolute(), Path(target).absolute(), before))
        os.replace(path, target)  # noqa: PTH105

    def unlink(self, path):
        os.unlink(path)  # noqa: PTH108
        self.calls.append(("remove", Path(path).absolute()))

    def synced_since(self, path, place):
        """Return whether a file or folder was synced, and not written again, before a call."""
        wanted = ("sync", path)
        done = [call for call in self.calls[:place] if call in (wanted, ("write", path))]
        return bool(done) and done[-1] == wanted


@pytest.mark.parametrize("best", [False, True])
def test_a_checkpoint_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch, best):
    (tmp_path / "run").mkdir()
    folder = tmp_path / "run" / "network"
    for number in range(2):
        recorder = Recorder()
        monkeypatch.setattr(files, "os", recorder)
        path = learner(number).save(folder, progress(number), best=best)
        monkeypatch.undo()
        (place,) = (
            i for i, call in enumerate(recorder.calls) if call[0] == "rename" and call[2] == path
        )
        _, partial, _, inside = recorder.calls[place]
        assert inside == {DESCRIPTION, PARAMETERS, *([] if best else [STATE])}
        assert recorder.synced_since(partial, place)
        assert all(recorder.synced_since(partial / name, place) for name in inside)
        after = recorder.calls[place + 1 :]
        assert after[0] == ("sync", folder)
        removed = [call for call in after if call[0] == "remove"]
        assert bool(removed) == (best and number == 1)
        assert not any(call[0] == "remove" for call in recorder.calls[:place])
    assert ("sync", tmp_path / "run") not in recorder.calls  # was done for the first one


class Ended(BaseException):
    """Ends a process as a kill does."""


class Stopping:
    """Stands in for the module `os`: raises at one operation that changes the disk.

    After `Ended` nothing changes any more, as after a kill.
    """

    CHANGES = ("mkdir", "rmdir", "unlink", "replace", "fsync", "fdatasync", "pwrite")

    def __init__(self, place, error):
        self.left, self.error = place, error

    def __getattr__(self, name):
        call = getattr(os, name)

        def changing(*arguments):
            self.left -= 1
            if self.left == -1 or (self.left < -1 and self.error is Ended):
                raise self.error
            return call(*arguments)

        return changing if name in self.CHANGES else call


@pytest.mark.parametrize("best", [False, True])
def test_a_save_that_is_killed_anywhere_leaves_the_old_or_the_new_one(tmp_path, monkeypatch, best):
    which, ended = "best" if best else -1, False
    found = set()
    for left in range(40):
        session = tmp_path / f"run_{left}"
        saved(session, 2)
        monkeypatch.setattr(files, "os", Stopping(left, Ended))
        try:
            learner(7).save(session / "network", progress(2), best=best)
            ended = True
        except Ended:
            pass
        monkeypatch.undo()
        found.add(weight(session, which))
        other = learner(8).save(session / "network", progress(3), best=not best)
        assert weight(other) == 8  # whichever is saved next tidies up
        assert weight(session, which) in ((1, 7) if best else (1, 7, 8))
        assert not [name for name in names(session / "network") if name.startswith(".")]
        shutil.rmtree(session)
        if ended:
            break
    assert ended and found == {1, 7}


@pytest.mark.parametrize("best", [False, True])
def test_ctrl_c_in_a_save_leaves_nothing_behind(tmp_path, best):
    saved(tmp_path / "run")
    before = names(tmp_path / "run" / "network")
    with pytest.raises(KeyboardInterrupt):
        learner(9, network=Interrupted).save(tmp_path / "run/network", progress(3), best=best)
    assert names(tmp_path / "run" / "network") == before
    assert weight(tmp_path / "run", "best") == 2


@pytest.mark.parametrize("place", range(12))
def test_ctrl_c_at_any_operation_leaves_nothing_hidden(tmp_path, monkeypatch, place):
    saved(tmp_path / "run", 2)

    monkeypatch.setattr(files, "os", Stopping(place, KeyboardInterrupt))
    with contextlib.suppress(KeyboardInterrupt):
        learner(7).save(tmp_path / "run" / "network", progress(2), best=True)
    monkeypatch.undo()
    assert names(tmp_path / "run" / "network") == ["network_0", "network_1", "network_best"]
    assert weight(tmp_path / "run", "best") in (1, 7)


def test_a_failed_sync_is_an_error_and_keeps_what_was_there(tmp_path, monkeypatch):
    saved(tmp_path / "run", 2)

    class Failing(Recorder):
        def fdatasync(self, descriptor):
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(files, "os", Failing())
    with pytest.raises(
        CheckpointError, match=r"network_2 cannot be stored: .*\(Input/output error\)"
    ):
        learner(7).save(tmp_path / "run" / "network", progress(2))
    with pytest.raises(CheckpointError, match="network_best cannot be stored"):
        learner(7).save(tmp_path / "run" / "network", progress(2), best=True)
    monkeypatch.undo()
    assert names(tmp_path / "run" / "network") == ["network_0", "network_1", "network_best"]
    assert weight(tmp_path / "run") == weight(tmp_path / "run", "best") == 1


def test_the_best_one_that_was_moved_aside_is_found(tmp_path, capsys):
    saved(tmp_path / "run", 1)
    best = tmp_path / "run" / "network" / "network_best"
    best.rename(best.with_name(".network_best.former"))
    assert weight(tmp_path / "run", "best") == 0 and weight(best) == 0
    assert main(["info", str(tmp_path / "run")]) == 0
    assert "checkpoint network_best: " in capsys.readouterr().out
    (tmp_path / "run" / "network" / ".network_5.partial").mkdir()
    learner(3).save(tmp_path / "run" / "network", progress(1))
    assert names(tmp_path / "run" / "network") == ["network_0", "network_1", "network_best"]


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_not_mixed(tmp_path):
    saved(tmp_path / "run", 1)
    found = find(tmp_path / "run", "network", "best")
    learner(5).save(tmp_path / "run" / "network", progress(1), best=True)
    with pytest.raises(CheckpointError, match="replaced while it was being read"):
        checkpoint.check_unchanged(found)


# Full disks and deleted folders -----------------------------------------------------------------


def check_full_disk(disk, made, load):
    """Save 1 MB each until the disk is full; return how many fitted."""
    (disk / "run").mkdir()
    folder = disk / "run" / "network"
    with pytest.raises(CheckpointError, match="the disk is full.*network_0, .*Free some space"):
        for count in range(20):
            made(count).save(folder, progress(count))
    assert names(folder) == [f"network_{number}" for number in range(count)]
    for number in range(count):
        load(folder / f"network_{number}", number)
    shutil.rmtree(folder / "network_0")
    made(count).save(folder, progress(count))
    load(disk / "run", count)
    return count


def test_a_full_disk_leaves_the_earlier_checkpoints_and_no_leftover(small_disk):
    def load(place, number):
        assert weight(place) == number

    assert check_full_disk(small_disk, lambda number: learner(number, size=360), load) == 8


def test_the_folder_of_a_session_that_was_deleted_does_not_come_back(tmp_path):
    made = learner()
    saved(tmp_path / "run")
    shutil.rmtree(tmp_path / "run")
    for best in (False, True):
        with pytest.raises(SessionError, match=r"run is gone: it was deleted or renamed"):
            made.save(tmp_path / "run" / "network", progress(1), best=best)
    assert names(tmp_path) == []


def test_a_training_notices_that_its_session_was_deleted(trained):
    class Deletes(Training):
        def epoch_end(self):
            super().epoch_end()
            if self.epoch_id == 5:
                shutil.rmtree(self.session.path)

    config, data = NetworkConfig("toy/linear"), DatasetConfig(existing_dir="data")
    run = Deletes(config, data, epoch_nb=10**9, batch_size=5)
    with pytest.raises(SessionError, match="sessions/training_1 is gone"):
        run.execute()
    assert names(Path("sessions")) == ["training"]


def test_a_training_whose_session_is_deleted_ends_with_an_error_that_says_so(trained):
    class Deletes(Training):
        def epoch_end(self):
            shutil.rmtree("sessions/training")
            super().epoch_end()

    run = Deletes(
        NetworkConfig("toy/linear"),
        DatasetConfig(existing_dir="data"),
        epoch_nb=1,
        batch_size=5,
        new_session=False,
    )
    with pytest.raises(SessionError, match="sessions/training is gone"):
        run.execute()
    assert not trained.exists()
