"""Trainings whose batches a buffer draws while environments generate the rows."""

from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    Buffer,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)
from physx_core.checkpoint import BUFFER, read_buffer
from physx_core.checkpoint import read as read_checkpoint
from physx_core.cli import main
from physx_core.errors import ConfigError, SessionError
from physx_core.observers import read_scalars
from physx_core.pipelines import load_learner, read_drawn_rows
from physx_core.toy import LeastSquares

pytestmark = pytest.mark.processes

DRAWN = f"{Path(__file__).parents[1] / 'programs' / 'buffer_envs.py'}:Drawn"
RESERVOIR = {"capacity": 40, "watermark": 20, "views": 3}
BUFFERS = {
    "reservoir": RESERVOIR,
    "window": {"capacity": 30, "watermark": 10, "views": 2},
    "fifo": {"capacity": 40, "watermark": 20, "views": 2},
}


class Descending(LeastSquares):
    """Has no state but the weights."""

    def optimize(self, loss):
        error = self._rows @ self._network.weights - self._targets
        self._network.weights = self._network.weights - 0.02 * self._rows.T @ error


NETWORK = NetworkConfig(
    "toy/linear", optimization=Descending, network_kwargs={"net_fields": "x", "opt_fields": "y"}
)


def train(
    name,
    online="stream",
    *,
    buffer=None,
    kind=Training,
    clients=False,
    delay=0.0,
    sees=None,
    **options,
):
    environment = EnvironmentConfig(
        DRAWN,
        num_clients=2,
        seed=5,
        as_tcp_ip_client=clients,
        env_kwargs={"delay": delay},
        always_produce=options.pop("always_produce", False),
    )

    class Seeing(kind):
        def optimize(self):
            super().optimize()
            if sees is not None:
                sees.append({key: value.copy() for key, value in self.batch.items()})

    chosen = {
        "epoch_nb": 1,
        "batch_nb": 30,
        "batch_size": 8,
        "seed": 3,
        "online": buffer or f"physx/{online}",
        "online_kwargs": BUFFERS.get(online, {}),
        "dataset_config": DatasetConfig(normalize=True),
        **options,
    }
    training = Seeing(
        NETWORK, environment_config=environment, session_name=name, quiet=True, **chosen
    )
    training.execute()
    return training.session.path


def parameters(path):
    return load_learner(path).network.get_parameters()


def assert_equal_runs(one, other):
    first, second = parameters(one), parameters(other)
    assert first.keys() == second.keys()
    for name in first:
        assert np.array_equal(first[name], second[name])
    with Dataset.open(one / "dataset") as a, Dataset.open(other / "dataset") as b:
        for name in ("x", "y", "number"):
            assert np.array_equal(a["training"][name][:], b["training"][name][:])
    numbers = [read_scalars(path) for path in (one, other)]
    names = [name for name in numbers[0] if name[1] == "loss/batch" or name[1].startswith("fields")]
    assert ("batch", "fields/y/1/q95") in names
    for name in names:
        assert numbers[0][name] == numbers[1][name]


@pytest.mark.parametrize("online", BUFFERS)
def test_batches_hold_the_rows_that_the_session_says_they_held(online):
    batches = []
    path = train("run", online, sees=batches)
    drawn = read_drawn_rows(path)
    assert drawn.shape == (30, 8)
    with Dataset.open(path / "dataset") as dataset:
        rows = dataset["training"]
        views = BUFFERS[online]["views"]
        assert len(rows["x"]) == 30 * 8 / views
        for batch, index in zip(batches, drawn, strict=True):
            assert list(batch) == ["x", "y"]
            for name, values in batch.items():
                assert values.dtype == np.float32
                assert np.array_equal(values, rows[name][index].astype(np.float32))
    if online == "fifo":
        assert np.bincount(drawn.ravel()).tolist() == [2] * 120


@pytest.mark.parametrize("online", ["stream", *BUFFERS])
def test_clients_make_the_training_of_environments_in_this_process(online):
    one = train("here", online)
    other = train("clients", online, clients=True, delay=0.004)
    assert_equal_runs(one, other)
    if online != "stream":
        assert np.array_equal(read_drawn_rows(one), read_drawn_rows(other))


@pytest.mark.faults
def test_a_first_batch_that_waits_for_many_rows_takes_them_in_several_blocks():
    options = {"capacity": 3000, "watermark": 2600, "views": 2}
    batches = []
    one = train("here", "reservoir", online_kwargs=options, batch_nb=10, sees=batches)
    other = train("clients", "reservoir", online_kwargs=options, batch_nb=10, clients=True)
    assert_equal_runs(one, other)
    drawn = read_drawn_rows(one)
    assert np.array_equal(drawn, read_drawn_rows(other)) and drawn.max() > 2048
    with Dataset.open(one / "dataset") as dataset:
        rows = dataset["training"]["x"][:].astype(np.float32)
        assert len(rows) == 2600
    assert all(np.array_equal(b["x"], rows[i]) for b, i in zip(batches, drawn, strict=True))


class Cut(Training):
    """Ends with an error in the middle of an epoch."""

    def batch_end(self):
        super().batch_end()
        if not self.resume and (self.epoch_id, self.batch_id) == (self.epoch_nb - 1, 13):
            raise RuntimeError("cut")


@pytest.mark.parametrize("always_produce", [False, True])
@pytest.mark.parametrize("clients", [False, True])
@pytest.mark.parametrize("online", BUFFERS)
def test_resume_restores_rows_of_buffer(online, clients, always_produce):
    options = {"clients": clients, "always_produce": always_produce}
    options |= {"epoch_nb": 2 if always_produce else 1}
    whole = train("whole", online, **options)
    with pytest.raises(RuntimeError, match="cut"):
        train("cut", online, kind=Cut, **options)
    path = Path("sessions/cut")
    assert len(read_drawn_rows(path)) == 13 + 30 * always_produce
    train("cut", online, kind=Cut, resume=True, **options)
    assert_equal_runs(whole, path)
    assert np.array_equal(read_drawn_rows(whole), read_drawn_rows(path))


def test_a_training_is_made_longer_with_the_rows_of_its_buffer():
    train("run", "fifo", epoch_nb=2, always_produce=True)
    path = train("run", "fifo", epoch_nb=3, always_produce=True, resume=True)
    drawn = read_drawn_rows(path)
    assert np.bincount(drawn.ravel()).tolist() == [2] * 360


def test_resume_with_another_buffer_is_refused():
    with pytest.raises(RuntimeError, match="cut"):
        train("cut", "reservoir", kind=Cut)
    with pytest.raises(ConfigError, match="online was 'physx/reservoir' and is now 'physx/window'"):
        train("cut", "window", resume=True)


def test_later_epochs_read_all_rows_and_the_record_ends_with_the_first():
    path = train("run", "reservoir", epoch_nb=3)
    assert read_drawn_rows(path).shape == (30, 8)
    with Dataset.open(path / "dataset") as dataset:
        assert dataset.num_samples("training") == 80
    assert len(read_scalars(path)["batch", "loss/batch"]) == 90


def test_a_buffer_goes_on_through_epochs_that_all_generate():
    path = train("run", "fifo", epoch_nb=3, always_produce=True)
    drawn = read_drawn_rows(path)
    assert drawn.shape == (90, 8)
    assert np.bincount(drawn.ravel()).tolist() == [2] * 360


def test_rows_that_the_session_had_before_are_counted_but_not_drawn():
    first = train("run")
    again = train("run", "window", new_session=False)
    assert first == again
    drawn = read_drawn_rows(again)
    assert drawn.min() == 240
    with Dataset.open(again / "dataset") as dataset:
        assert drawn.max() < dataset.num_samples("training") == 240 + 120


def test_a_stream_records_no_rows():
    path = train("run")
    with pytest.raises(SessionError, match=r"drawn_rows\.bin cannot be read.*buffer"):
        read_drawn_rows(path)


def test_truncated_or_corrupt_record_of_drawn_rows_ends_there():
    path = train("run", "window")
    file, whole = path / "stats" / "drawn_rows.bin", read_drawn_rows(path)
    content = file.read_bytes()
    file.write_bytes(content[:-3])
    assert np.array_equal(read_drawn_rows(path), whole[:-1])
    assert np.array_equal(read_drawn_rows(path, 4), whole[:4])
    place = 16 + 10 * 72 + 5
    file.write_bytes(content[:place] + b"\xff" + content[place + 1 :])
    assert np.array_equal(read_drawn_rows(path), whole[:10])
    file.write_bytes(b"physx")
    with pytest.raises(SessionError, match="damaged, or was not written by physx"):
        read_drawn_rows(path)


def test_checkpoint_of_interrupted_run_has_buffer_state():
    environment = EnvironmentConfig(
        DRAWN, as_tcp_ip_client=False, seed=1, env_kwargs={"fails_at": 20}
    )
    training = Training(
        NETWORK,
        environment_config=environment,
        batch_nb=30,
        epoch_nb=1,
        batch_size=8,
        seed=3,
        online="physx/reservoir",
        online_kwargs={"capacity": 16, "watermark": 8, "views": 4},
        quiet=True,
    )
    with pytest.raises(Exception, match="enough"):
        training.execute()
    found = read_checkpoint(training.checkpoint_path)
    state = read_buffer(found)
    drawn = read_drawn_rows(training.session.path)
    assert len(drawn) == found.progress.batch == 7
    assert state[0] == 20
    uses = dict(zip(state[1:17].tolist(), state[17:].tolist(), strict=True))
    counts = np.bincount(drawn.ravel(), minlength=20)
    assert all(counts[row] == number for row, number in uses.items())
    assert (found.path / BUFFER).is_file()


@pytest.mark.parametrize("online", ["stream", "reservoir"])
def test_statistics_summarize_the_rows_that_were_generated(online, capsys):
    path = train("run", online, batch_nb=300)
    numbers = {name: steps for (_, name), steps in read_scalars(path).items()}
    with Dataset.open(path / "dataset") as dataset:
        x, grid = dataset["training"]["x"][:], dataset["training"]["grid"][:]
    assert len(x) == (2400 if online == "stream" else 800)
    of_x = {name: list(steps.values()) for name, steps in numbers.items() if "s/x/0/" in name}
    assert len(of_x) == 5
    for values in of_x.values():
        assert len(values) < 60
    assert of_x["fields/x/0/mean"][-1] == pytest.approx(x[:, 0].mean(), abs=1e-12)
    assert of_x["fields/x/0/std"][-1] == pytest.approx(x[:, 0].std(), abs=1e-12)
    for name, share in (("q05", 0.05), ("median", 0.5), ("q95", 0.95)):
        below = (x[:, 0] < of_x[f"fields/x/0/{name}"][-1]).mean()
        assert below == pytest.approx(share, abs=0.05 if online == "stream" else 0.002)
    assert not any(name.startswith("fields/number") for name in numbers)
    of_grid = [list(steps.values())[-1] for name, steps in numbers.items() if "s/grid/" in name]
    wanted = [grid.mean(), grid.std(), *np.quantile(grid, [0.05, 0.5, 0.95])]
    assert of_grid == pytest.approx(wanted, abs=0.2)
    capsys.readouterr()
    main(["stats", str(path)])
    said = capsys.readouterr().out.splitlines()
    line = next(line for line in said if line.startswith("x/0"))
    assert line.split()[1::5] == [f"{of_x['fields/x/0/mean'][-1]:.4g}", "m"]
    head = ["field", "mean", "std", "q05", "median", "q95", "unit"]
    assert any(line.split() == head for line in said)


def test_statistics_say_how_the_buffer_and_both_sides_are_doing(capfd):
    environment = EnvironmentConfig(DRAWN, as_tcp_ip_client=False, seed=1)
    training = Training(
        NETWORK,
        environment_config=environment,
        batch_nb=30,
        epoch_nb=1,
        batch_size=8,
        online="physx/reservoir",
        online_kwargs=RESERVOIR,
    )
    training.execute()
    said = capfd.readouterr().err
    assert "generate 80 samples; batches are drawn from up to 40 of them, once there are 20" in said
    assert "each row used 3.00 times on average" in said
    assert "rows/s" in said and "the network waited" in said and "the environments" in said


class Thirds(Buffer):
    """A plugin's buffer: keeps the last three rows and repeats them."""

    capacity = 3

    def needed(self, batch):
        return 3 * (batch + 1)

    def place(self, count, random):
        return np.arange(count)

    def draw(self, random):
        return random.integers(0, 3, self.batch_size)


def test_a_buffer_of_a_plugin_is_chosen_by_its_class():
    path = train("run", buffer=Thirds)
    drawn = read_drawn_rows(path)
    assert (drawn // 3 == np.arange(30)[:, None]).all()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"online_kwargs": {"capacity": 4}}, "capacity is 4"),
        ({"online_kwargs": {"size": 4}}, '"size"'),
        ({"buffer": "physx/resevoir"}, "reservoir"),
    ],
)
def test_options_that_do_not_fit_leave_no_session(tmp_path, options, text):
    with pytest.raises(Exception, match=text):
        train("run", "reservoir", **options)
    assert not (tmp_path / "sessions").exists()


def test_a_buffer_without_environments_that_generate_is_an_error():
    train("data")
    with pytest.raises(ConfigError, match="but none do here"):
        Training(
            NETWORK,
            DatasetConfig(existing_dir="sessions/data"),
            epoch_nb=1,
            batch_size=8,
            online="physx/window",
        ).execute()


def test_the_command_line_chooses_the_buffer(capfd):
    words = (
        "train --environment.environment toy/spring --network.network toy/linear "
        "--network.network-kwargs net_fields=state opt_fields=next_state "
        "--epoch-nb 1 --batch-nb 20 --batch-size 8 --online physx/reservoir "
        "--online-kwargs capacity=40 watermark=16 views=4 "
        "--environment.no-as-tcp-ip-client"
    )
    assert not main(words.split())
    assert read_drawn_rows("sessions/training").shape == (20, 8)
    assert main(words.replace("capacity=40", "capacity=2").split())
    assert "capacity is 2" in capfd.readouterr().err
