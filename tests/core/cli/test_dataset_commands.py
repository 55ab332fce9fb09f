import numpy as np
import pytest

from physx_core import Dataset, Field
from physx_core.cli import main
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.origin import install_hint

WIDTH = 100


@pytest.fixture
def run(capsys, monkeypatch):
    """Runs a command; gives its exit status and what it printed."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))

    def command(*words):
        status = main([str(word) for word in words])
        text = capsys.readouterr()
        assert "Traceback" not in text.err
        return status, text.out, text.err

    return command


@pytest.fixture
def session(tmp_path):
    """A session's folder with trajectories of two instances in several partitions."""
    unit = "rad, rad/s, rad/s^2; fingers: m, m/s, m/s^2; and what else there may be to say of it"
    number = np.arange(400)
    with Dataset.create(tmp_path / "run" / "dataset", max_file_size=4e-5) as dataset:
        fields = [Field("state", (27,), unit=unit), Field("torque", (2,), unit="N m")]
        kept = [Field(n, (), t, role="additional") for n, t in
                {"env_id": "i4", "episode": "i8", "step": "i8"}.items()]  # fmt: skip
        dataset.define_fields("training", [*fields, *kept])
        dataset.append(
            "training",
            {
                "state": np.outer(number, np.ones(27)),
                "torque": np.array([[1.0, -2.5]] * 200 + [[3.0, -2.5]] * 200),
                "env_id": number % 2 + 1,
                "episode": number // 100,
                "step": number // 2,
            },
        )
        dataset.append("validation", {"x": np.zeros(3)})
        dataset.update_info(environment="dart/arm", env_kwargs={"task": "excite"}, seed=3)
    return tmp_path / "run"


def test_info_shows_what_there_is(session, run):
    status, text, _ = run("info", session)
    assert status == 0
    assert all(len(line) <= WIDTH or str(session) in line for line in text.splitlines())
    for part in (
        "environment: dart/arm",
        "env_kwargs: {'task': 'excite'}",
        "training: 400 samples, 101 kB in 4 partitions",
        "validation: 3 samples, 24 B in 1 partition",
        "shuffled by default: exact",
        "trajectories: 8 of 2 instances, 50 samples each",
        "rad, rad/s, rad/s^2; fingers: m, m/s",
        "all 27     200 … 200",
        "0 … 0",
        "399 … 399",
        "integrity: sound (sizes and headers",
    ):
        assert part in text
    torque = [line.split() for line in text.splitlines() if line.startswith("  torque ")]
    assert torque[1:] == [
        ["torque", "0", "2", "1", "1", "3"],
        ["torque", "1", "-2.5", "1", "-2.5", "-2.5"],
    ]


def test_info_reads_every_byte_when_asked(session, run):
    path = next((session / "dataset").glob("*training_state_0.h5"))
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    assert "integrity: sound" in run("info", session)[1]
    status, text, _ = run("info", session, "--verify")
    assert status == 0 and "integrity: 1 problem (every byte" in text and "changed" in text


def test_info_of_a_damaged_dataset_shows_the_rest(session, run):
    next((session / "dataset").glob("*training_torque_1.h5")).unlink()
    status, text, _ = run("info", session)
    assert status == 0
    assert "missing" in text and "validation: 3 samples" in text and "1 problem" in text
    assert all(len(line) <= WIDTH or "/" in line for line in text.splitlines())


def test_info_of_a_dataset_without_samples(tmp_path, run):
    Dataset.create(tmp_path / "data").close()
    status, text, _ = run("info", tmp_path / "data")
    assert status == 0 and "no samples" in text and "sound" in text


def test_verify_says_what_was_checked(session, run):
    status, text, _ = run("verify", session)
    assert (status, text) == (0, "sound: 21 files, 400 training samples, 3 validation samples\n")


def test_verify_names_each_problem(session, run):
    path = next((session / "dataset").glob("*training_state_0.h5"))
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    status, out, err = run("verify", session)
    assert status == 1
    assert str(path) in out and "1 problem" in err and "--repair" in err
    status, out, _ = run("verify", session, "--repair")
    assert status == 0 and path.name in out and "3 validation samples" in out


@pytest.mark.parametrize("content", [None, b"", b'{"format": "physx da'])
def test_repair_rebuilds_a_lost_manifest(session, run, content):
    path = session / "dataset" / "dataset.json"
    path.unlink() if content is None else path.write_bytes(content)
    if content is not None:
        status, out, _ = run("verify", session)
        assert status == 1 and "dataset.json" in out
    status, out, _ = run("verify", session, "--repair")
    assert status == 0 and "repaired:" in out and "400 training samples" in out
    assert run("verify", session)[0] == 0


def test_there_and_back_by_commands(session, run, tmp_path):
    for name, to in (("a.npz", "npz"), ("a.h5", "hdf5-single")):
        status, out, _ = run("export", session, name, "--to", to, "--mode", "training")
        assert (status, out) == (0, f"400 training samples: {name}\n")
        assert run("import", name, to)[:2] == (0, f"400 training samples: {to}\n")
        with Dataset.open(session) as dataset, Dataset.open(tmp_path / to) as back:
            assert back.fields("training") == dataset.fields("training")
            for field, view in dataset["training"].items():
                assert view[:].tobytes() == back["training"][field][:].tobytes()
            assert back.info["environment"] == "dart/arm"


def test_minari_by_commands(session, run, tmp_path):
    minari = pytest.importorskip("minari")
    words = ["--mode", "training", "--observations", "state", "--actions", "torque"]
    status, out, _ = run("export", session, "arm-v0", "--to", "minari", *words)
    assert (status, out) == (0, "400 training samples: arm-v0\nminari is not imported\n")
    found = minari.MinariDataset(tmp_path / "arm-v0" / "data")
    assert (found.total_episodes, found.total_steps) == (8, 392)
    assert found[0].observations.shape == (50, 27) and found[0].actions.shape == (49, 2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info", "nowhere"], "nowhere"),
        (["verify", "nowhere"], "nowhere"),
        (["export", "run", "out", "--to", "npy"], "npy"),
        (["export", "run", "out"], "--to"),
        (["export", "run", "out", "--to", "npz", "--compression", "zip"], "deflate"),
        (["export", "run", "out", "--to", "npz", "--mode", "trainin"], 'Did you mean "training"'),
        (["export", "run", "run", "--to", "npz"], "exists already"),
        (["export", "run", "out", "--to", "parquet"], "--mode"),
        (["import", __file__, "out"], "is of no known format"),
        (["import", "a.npz", "out"], "There is no file"),
        (["import", "a.npz"], "DIR"),
    ],
)
def test_mistakes_end_with_one_clear_error(session, run, words, message):
    pytest.importorskip("pyarrow")
    status, out, err = run(*words)
    assert status == 1 and message in out + err


def test_a_missing_library_is_an_error_with_advice(session, run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "zarr", None)
    status, _, err = run("export", session, "out", "--to", "zarr")
    assert status == 1 and install_hint("physx-formats", "zarr") in err


# Campaigns --------------------------------------------------------------------------------------


@pytest.fixture
def campaign(tmp_path):
    """A session that has 42 of 64 episodes, which were to be simulated by two clients."""
    folder = tmp_path / "campaign"
    with Dataset.create(folder / "dataset") as dataset:
        for episode in range(44):
            status = EpisodeStatus.FAILED if episode == 7 else EpisodeStatus.FINISHED
            status = EpisodeStatus.MORE if episode == 43 else status
            rows = 0 if status is EpisodeStatus.FAILED else 2
            record = EpisodeRecord(episode=episode, rows=rows, status=status, seconds=20.0)
            dataset.append_episodes("training", {"x": np.zeros(rows)}, [record])
    (folder / "config.toml").write_text(
        "[data_generation]\nepisodes = 64\n"
        "[data_generation.environment]\nas_tcp_ip_client = true\nnum_clients = 2\n"
    )
    return folder


def test_info_says_how_far_a_campaign_is(campaign, run, monkeypatch):
    text = run("info", campaign)[1]
    assert "campaign 0: 42 of 64 finished, 1 failed, 1 unfinished" in text
    assert "20 s each, 6 per min by 2 clients; 21 missing: go on with" in text
    assert "episodes: 45 records" in text
    monkeypatch.setattr(Dataset, "is_written", True)
    assert "; about 3.5 min left at the rate so far" in run("info", campaign)[1]
    (campaign / "config.toml").unlink()
    assert "campaign 0: 42 finished, 1 failed" in run("info", campaign)[1]


def test_verify_and_compact_a_campaign(campaign, run):
    assert "45 records, 84 training samples" in run("verify", campaign)[1]
    status, text, _ = run("compact", campaign)
    assert status == 0 and text.startswith(("freed", "in order now", "there was nothing"))
    assert run("compact", campaign)[1] == "there was nothing to free\n"
    assert "44 records, 84 training samples" in run("verify", campaign)[1]
    assert "no mode" in run("compact", campaign, "--mode", "other")[2]
