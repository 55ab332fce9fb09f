"""ClientSource: the rows of LocalSource, from processes that may fail in every way."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from physx_core import Environment
from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    ClientError,
    ComponentNotFoundError,
    EnvironmentFailedError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    NotFiniteError,
    UnknownFieldError,
    UnknownOptionError,
    UsageError,
    WrongSamplesError,
)
from physx_core.sources.clients import ClientSource
from physx_core.sources.local import LocalSource

ENVS = f"{Path(__file__).parent / 'transport_envs.py'}:"
SEED = [5, 0, 7]


class Services:
    """Keeps what environments ask for; the prediction doubles x."""

    def __init__(self):
        self.kept, self.shown, self.asked = {}, [], []

    def predict(self, fields):
        self.asked.append(1)
        return {"y": 2 * np.asarray(fields["x"])}

    def save_parameters(self, instance_id, values):
        self.kept[instance_id] = values

    def load_parameters(self, instance_id):
        return self.kept.get(instance_id, {})

    def show(self, instance_id, step, events):
        self.shown.append((instance_id, step, events))


class BatchServices(Services):
    """Predicts several samples at once."""

    def predict(self, fields):
        self.asked.append(" ".join(str(int(fields["x"][0]))))
        return {"y": 2 * fields["x"]}

    def predict_batch(self, batch):
        self.asked.append(" ".join(str(int(one)) for one in batch["x"][:, 0]))
        return {"y": 2 * batch["x"]}


def config(name, **options):
    environment = name if isinstance(name, type) or ":" in name else ENVS + name
    return EnvironmentConfig(environment, **options)


@pytest.fixture(autouse=True)
def nothing_stays_behind(monkeypatch):
    """Every process that a test starts, directly or not, is gone when it ends."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv("PHYSX_TEST_MARK", mark)
    yield
    deadline = time.monotonic() + 2  # a process that is killed takes a moment to go
    while (left := marked(mark.encode())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left
    with pytest.raises(ChildProcessError):  # nor is there one that nobody waited for
        os.waitpid(-1, os.WNOHANG)


def marked(mark):
    """Command lines of the other processes with a mark in their environment."""
    found = []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in environ.read_bytes() and int(environ.parent.name) != os.getpid():
                found.append((environ.parent / "cmdline").read_bytes())
        except OSError:
            continue
    return found


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


# Rows -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("instances", "ahead", "options"),
    [
        (1, None, {}),
        (1, 0, {"refuse": 3}),
        (2, None, {"delay": 0.004}),
        (2, 0, {"size": 40}),
        (3, None, {"refuse": 4}),
        (3, 5, {"delay": 0.002}),
        (3, 0, {}),
    ],
)
def test_rows_are_those_of_a_local_source(instances, ahead, options):
    settings = config("Walk", num_clients=instances, env_kwargs=options, simulations_per_step=2)
    sizes = [1, 2, 5, 1, 16, 3] if "delay" in options else [1, 2, 5, 700, 16, 1, 3, 2000]
    with (
        LocalSource(settings, Services(), SEED) as local,
        ClientSource(settings, Services(), SEED, run_ahead=ahead, total=sum(sizes)) as clients,
    ):
        assert clients.fields == local.fields
        for size in sizes:
            same(clients.batch(size), local.batch(size))
        assert clients.fields == local.fields


def test_rows_do_not_depend_on_the_sizes_of_batches():
    settings = config("Walk", num_clients=3)
    collected = []
    for sizes in ([40], [1] * 40, [7, 13, 2, 18]):
        with ClientSource(settings, Services(), SEED) as clients:
            parts = [clients.batch(size)["state"].copy() for size in sizes]
        collected.append(np.concatenate(parts))
    assert np.array_equal(collected[0], collected[1])
    assert np.array_equal(collected[0], collected[2])


def test_large_rows_arrive_whole():
    settings = config("Walk", env_kwargs={"size": 30_000}, num_clients=2)
    with (
        LocalSource(settings, Services(), SEED) as local,
        ClientSource(settings, Services(), SEED) as clients,
    ):
        for size in (3, 20):
            same(clients.batch(size), local.batch(size))


def test_a_batch_has_at_least_one_row_and_an_open_source():
    source = ClientSource(config("Plain"), Services(), SEED)
    with pytest.raises(UsageError, match="not open"):
        source.batch(1)
    with source, pytest.raises(UsageError, match="at least one row, not 0"):
        source.batch(0)
    source.close()
    with pytest.raises(UsageError, match="not open"):
        source.batch(1)


def test_clients_make_no_more_than_they_may():
    for ahead, total, most in ((0, None, 6), (2, None, 10), (100, 8, 8), (0, 2, 6)):
        services = Services()
        settings = config("Drawing", num_clients=2, visualizer="any")
        with ClientSource(settings, services, SEED, run_ahead=ahead, total=total) as clients:
            clients.batch(6)
            time.sleep(0.1)
        steps = [step for _, step, events in services.shown if events[0].action == "update"]
        assert len(steps) == most


# Where the class comes from ---------------------------------------------------------------------


class HereDefined(Environment):
    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=float(self.step_index))


def test_the_class_may_come_from_a_module(tmp_path, monkeypatch):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    source = Path(ENVS[:-1]).read_text()
    (folder / "some_physx_test_module.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    module = __import__("some_physx_test_module")
    for reference in ("some_physx_test_module:Plain", module.Plain):
        with ClientSource(config(reference), Services(), SEED) as clients:
            assert clients.batch(2)["x"].tolist() == [[1, 0], [1, 1]]
    del sys.modules["some_physx_test_module"]


def test_the_class_may_come_from_a_plugin(tmp_path, monkeypatch):
    (tmp_path / "beans_plugin.py").write_text(
        "from physx_core.plugins import hookimpl\n"
        "@hookimpl\n"
        "def physx_environments():\n"
        f"    from physx_core.plugins import resolve\n"
        f"    return {{'plain': resolve('environment', {ENVS + 'Plain'!r})}}\n"
    )
    info = tmp_path / "beans-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: beans\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[physx]\nbeans = beans_plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with ClientSource(EnvironmentConfig("beans/plain"), Services(), SEED) as clients:
        assert clients.batch(1)["x"].tolist() == [[1, 0]]


def test_the_class_may_come_from_the_script_that_runs(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        Path(ENVS[:-1]).read_text()
        + f"""
if __name__ == "__main__":
    sys.path.insert(0, {str(Path(__file__).parent)!r})
    from physx_core.config import EnvironmentConfig
    from physx_core.sources.clients import ClientSource
    with ClientSource(EnvironmentConfig(Plain, num_clients=2), None, [1]) as clients:
        print(clients.batch(3)["x"].tolist())
"""
    )
    done = subprocess_run([sys.executable, str(script)])
    assert done.stdout.strip() == "[[1.0, 0.0], [2.0, 0.0], [1.0, 1.0]]", done.stderr


def subprocess_run(command):
    import subprocess

    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)


def test_a_class_that_no_other_process_finds_is_refused():
    class Inside(HereDefined):
        pass

    with pytest.raises(UsageError, match="inside a function"):
        ClientSource(config(Inside), Services(), SEED).open()


def test_an_unknown_class_is_named_as_in_process():
    with pytest.raises(ComponentNotFoundError, match='Did you mean "Plain"'):
        ClientSource(config("Plane"), Services(), SEED).__enter__()


# Errors of the environment ----------------------------------------------------------------------


def errors_of(settings, sizes):
    """Return the errors of both sources, and how many rows each gave before."""
    found = []
    for make in (LocalSource, ClientSource):
        rows = 0
        with pytest.raises(Exception) as caught, make(settings, Services(), SEED) as source:
            for size in sizes:
                rows += len(source.batch(size)["step"])
        found.append((caught.value, rows))
    return found


@pytest.mark.parametrize("method", ["__init__", "create", "init_database", "step", "close"])
def test_an_exception_comes_back_with_place_and_traceback(method):
    settings = config(
        "Trouble", num_clients=2, env_kwargs={"what": "fail", "method": method, "who": 2}
    )
    (local, rows), (error, client_rows) = errors_of(settings, [4, 4])
    assert type(error) is type(local) is EnvironmentFailedError
    assert str(error) == str(local)
    assert (error.instance_id, error.method) == (2, method)
    assert error.step == local.step
    assert 'raise RuntimeError("no more beans")' in error.remote_traceback
    assert rows == client_rows


@pytest.mark.parametrize("method", ["__init__", "create", "step"])
def test_an_error_of_physx_comes_back_as_itself(method):
    settings = config("Trouble", env_kwargs={"what": "fail_known", "method": method})
    (local, _), (error, _) = errors_of(settings, [8])
    assert type(error) is type(local) is FieldShapeError
    assert str(error) == str(local)
    assert vars(error) == vars(local)
    assert error.__notes__ == ["a note", f"in {method}() of instance 1"]


@pytest.mark.parametrize(
    ("value", "field", "expected"),
    [
        (np.zeros(3), "x", FieldShapeError),
        (np.array([1, np.nan]), "x", NotFiniteError),
        (np.array([1, -np.inf]), "x", NotFiniteError),
        (np.array([1j, 2]), "x", FieldTypeError),
        ([[1, 2], [3]], "x", FieldShapeError),
        (1.0, "velocity", UnknownFieldError),
    ],
)
def test_data_that_cannot_be_stored_is_refused_as_in_process(value, field, expected):
    settings = config(
        "Bad", num_clients=2, env_kwargs={"value": value, "field": field, "at": 7, "who": 2}
    )
    (local, rows), (error, client_rows) = errors_of(settings, [5, 5, 5, 5])
    assert type(error) is type(local) is expected
    assert str(error) == str(local)
    assert (error.field, error.instance_id, error.step) == (field, 2, 7)
    assert rows == client_rows == 15


def test_rows_before_a_bad_one_arrive_though_they_were_made_together():
    settings = config("Bad", env_kwargs={"value": np.full(2, np.nan), "at": 50})
    with ClientSource(settings, Services(), SEED, run_ahead=1000) as clients:
        assert clients.batch(49)["step"][-1] == 48
        assert clients.batch(1)["step"] == [49]
        with pytest.raises(NotFiniteError, match="Instance 1, step 50"):
            clients.batch(1)


def test_an_error_in_a_row_that_nobody_asked_for_is_no_error():
    settings = config("Bad", env_kwargs={"value": np.full(2, np.nan), "at": 5})
    with ClientSource(settings, Services(), SEED, run_ahead=1000) as clients:
        assert len(clients.batch(5)["x"]) == 5
        time.sleep(0.1)


def test_a_missing_field_and_wrong_samples_are_as_in_process():
    settings = config("Walk", env_kwargs={"refuse": 1}, max_wrong_samples_per_step=4)
    (local, _), (error, _) = errors_of(settings, [3])
    assert type(error) is WrongSamplesError
    assert str(error) == str(local)
    settings = config("Walk", env_kwargs={"speed": 1})
    (local, _), (error, _) = errors_of(settings, [3])
    assert type(error) is type(local) is UnknownOptionError
    assert str(error) == str(local)
    assert vars(error) == vars(local)


def test_open_shapes_must_be_the_same_in_all_instances():
    (local, _), (error, _) = errors_of(config("Shapes", num_clients=2), [1, 1])
    assert type(error) is type(local) is FieldShapeError
    assert str(error) == str(local)
    assert vars(error) == vars(local)


def test_instances_define_the_same_fields():
    with (
        pytest.raises(FieldsMismatchError, match="Instances 1 and 2") as caught,
        ClientSource(config("Names", num_clients=2), Services(), SEED),
    ):
        pass
    assert set(caught.value.differences) == {"x1", "x2"}


def test_an_environment_cannot_hide_a_row_that_is_not_finite():
    with (
        pytest.raises(NotFiniteError, match="Instance 1, step 1"),
        ClientSource(config("Stubborn"), Services(), SEED) as clients,
    ):
        clients.batch(1)
        clients.batch(9)


# Clients that end or hang -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "method", "text", "status"),
    [
        ("vanish", "step", "Client 2 ended with exit status 3", 3),
        ("leave", "step", "Client 2 ended with exit status 5", 5),
        ("vanish", "create", "Client 2 ended with exit status 3 after 0 rows", 3),
        ("leave", "__init__", "Client 2 ended with exit status 5 after 0 rows", 5),
        ("vanish", "close", "Client 2 ended with exit status 3", 3),
    ],
)
def test_a_client_that_ends_is_named(what, method, text, status):
    settings = config(
        "Trouble", num_clients=3, env_kwargs={"what": what, "method": method, "who": 2}
    )
    with (
        pytest.raises(ClientError, match=text) as caught,
        ClientSource(settings, Services(), SEED, run_ahead=2) as clients,
    ):
        clients.batch(3)
        if method != "close":
            clients.batch(30)
    assert caught.value.instance_id == 2
    assert caught.value.exit_status == status
    if what == "vanish":
        assert caught.value.stderr == "last words"
        assert "last words" in str(caught.value)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_client_that_is_killed_is_named_within_two_seconds(number):
    settings = config("Walk", num_clients=2, env_kwargs={"delay": 0.02})
    with (
        pytest.raises(
            ClientError, match=rf"Client 2 was killed by signal .*{number.name}"
        ) as caught,
        ClientSource(settings, Services(), SEED) as clients,
    ):
        clients.batch(4)
        timer = threading.Timer(0.1, os.kill, (pids(clients)[2], number))
        timer.start()
        began = time.monotonic()
        while True:
            clients.batch(2)
    assert time.monotonic() - began < 2.1
    assert caught.value.exit_status == -number
    timer.join()


def pids(clients):
    """Instance number to process id, from the command lines."""
    found = {}
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = command.read_bytes().split(b"\0")
            parent = (command.parent / "stat").read_text().rpartition(")")[2].split()[1]
        except OSError:
            continue
        if b"--instance" in words and int(parent) == os.getpid():
            found[int(words[words.index(b"--instance") + 1])] = int(command.parent.name)
    return found


@pytest.mark.parametrize("what", ["spin", "stop"])
def test_a_client_that_hangs_is_named_at_the_timeout(what):
    kwargs = {"what": what, "who": 2, "method": "never" if what == "stop" else "step"}
    settings = config("Trouble", num_clients=2, env_kwargs=kwargs, timeout=2.5)
    with (
        pytest.raises(ClientError, match=r"Client 2 sent nothing for 2\.5 s") as caught,
        ClientSource(settings, Services(), SEED, run_ahead=0) as clients,
    ):
        clients.batch(4)
        if what == "stop":
            os.kill(pids(clients)[2], signal.SIGSTOP)
        began = time.monotonic()
        clients.batch(8)
    assert caught.value.exit_status is None
    assert 2.4 < time.monotonic() - began < 8


def test_a_client_that_hangs_before_it_is_ready_is_named():
    settings = config("Trouble", env_kwargs={"what": "sleep", "method": "create"}, timeout=2.5)
    with (
        pytest.raises(ClientError, match="Client 1 sent nothing"),
        ClientSource(settings, Services(), SEED),
    ):
        pass


def test_a_client_that_cannot_start_is_noticed_at_once(monkeypatch, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "numpy.py").write_text("raise ImportError('numpy is broken today')\n")
    monkeypatch.setenv("PYTHONPATH", str(broken))
    began = time.monotonic()
    with (
        pytest.raises(ClientError, match="before it connected") as caught,
        ClientSource(config("Plain"), Services(), SEED),
    ):
        pass
    assert time.monotonic() - began < 5
    assert caught.value.exit_status == 1
    assert "numpy is broken today" in caught.value.stderr


def test_a_crash_says_where_it_happened():
    settings = config("Trouble", env_kwargs={"what": "crash"})
    with (
        pytest.raises(ClientError, match=r"SIGSEGV") as caught,
        ClientSource(settings, Services(), SEED) as clients,
    ):
        clients.batch(9)
    assert "in crash" in caught.value.stderr


def test_what_an_environment_leaves_running_is_ended(tmp_path, monkeypatch):
    note = tmp_path / "child"
    monkeypatch.setenv("PHYSX_TEST_CHILD", str(note))
    settings = config("Trouble", env_kwargs={"what": "leave_child", "method": "create"})
    with ClientSource(settings, Services(), SEED) as clients:
        clients.batch(2)
        os.kill(int(note.read_text()), 0)


def test_after_an_error_outside_the_clients_are_not_waited_for():
    settings = config("Trouble", env_kwargs={"what": "sleep", "at": 2})
    began = time.monotonic()
    with (
        pytest.raises(KeyboardInterrupt),
        ClientSource(settings, Services(), SEED) as clients,
    ):
        clients.batch(2)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 6


# What environments ask for ----------------------------------------------------------------------


@pytest.mark.parametrize("services", [Services(), BatchServices()])
def test_predictions_are_answered(services):
    with ClientSource(config("Asking", num_clients=3), services, SEED, run_ahead=0) as clients:
        rows = clients.batch(30)["x"]
    expected = [[2 * (row % 3 + 1), 2 * (row // 3)] for row in range(30)]
    assert rows.tolist() == expected
    assert "".join(map(str, services.asked)).count("1") >= 10


def test_requests_of_all_instances_are_one_batch_whatever_their_speed():
    services = BatchServices()
    settings = config("Asking", num_clients=3, env_kwargs={"delay": 0.01})
    with ClientSource(settings, services, SEED, run_ahead=0) as clients:
        for size in (1, 30, 2):
            clients.batch(size)
    assert services.asked == ["1"] + 10 * ["1 2 3"] + ["2 3"]


def test_who_keeps_a_batch_of_requests_waiting_is_named():
    kwargs = {"what": "sleep", "who": 2, "at": 1}
    settings = config("AskingTrouble", num_clients=2, env_kwargs=kwargs, timeout=2.5)
    with (
        pytest.raises(ClientError, match="Client 2 sent nothing"),
        ClientSource(settings, BatchServices(), SEED, run_ahead=10) as clients,
    ):
        clients.batch(1)
        clients.batch(2)


def test_a_refused_prediction_is_the_error_of_the_services():
    class None_(Services):
        def predict(self, fields):
            raise UsageError("there is no network")

    for make in (LocalSource, ClientSource):
        with (
            pytest.raises(UsageError, match="there is no network") as caught,
            make(config("Asking", num_clients=2), None_(), SEED) as source,
        ):
            source.batch(4)
        assert caught.value.__notes__ == ["in step() of instance 1"]


def test_a_long_prediction_is_not_taken_for_silence():
    class Slow(Services):
        def predict(self, fields):
            time.sleep(0.9)
            return super().predict(fields)

    settings = config("Asking", num_clients=3, timeout=2.5)
    with ClientSource(settings, Slow(), SEED, run_ahead=0) as clients:
        assert len(clients.batch(3)["x"]) == 3


def test_an_exception_of_the_network_is_raised_as_it_is():
    class Broken(Services):
        def predict(self, fields):
            raise ZeroDivisionError("in the network")

    with (
        pytest.raises(ZeroDivisionError, match="in the network"),
        ClientSource(config("Asking", num_clients=2), Broken(), SEED) as clients,
    ):
        clients.batch(4)


def test_parameters_are_kept_and_given_back():
    services = Services()
    for _ in range(2):
        with ClientSource(config("Asking", num_clients=2), services, SEED):
            pass
    assert set(services.kept) == {1, 2}
    for number in (1, 2):
        kept = services.kept[number]
        assert kept["instance"] == kept["kept"]["instance"] == number
        assert kept["table"].tolist() == [0, 1, 2]
        assert kept["kept"]["kept"] == {}


def test_drawing_events_arrive_exactly():
    shown = []
    for make in (LocalSource, ClientSource):
        services = Services()
        with make(config("Drawing", num_clients=2, visualizer="any"), services, SEED) as source:
            source.batch(6)
        shown.append(
            [one for number in (1, 2) for one in services.shown if one[0] == number and one[1] < 3]
        )
    local, clients = shown
    assert len(local) == len(clients) == 8
    for ours, theirs in zip(local, clients, strict=True):
        assert ours[:2] == theirs[:2]
        for a, b in zip(ours[2], theirs[2], strict=True):
            assert (a.action, a.kind, a.name, a.values.keys()) == (
                b.action,
                b.kind,
                b.name,
                b.values.keys(),
            )
            same_arrays(a.values, b.values)


def same_arrays(a, b):
    for name, value in a.items():
        if isinstance(value, np.ndarray):
            assert value.dtype == b[name].dtype
            assert value.tobytes() == b[name].tobytes()
        else:
            assert value == b[name]


def test_options_arrive_exactly():
    options = {
        "numbers": [0.1, 1e300, 2**70, -1, True, None],
        "pair": (1, (2.5, "x")),
        3: {"array": np.arange(1_000_000, dtype=np.float32).reshape(1000, 1000)},
        "scalar": np.int16(7),
        "bytes": bytes(range(256)),
    }
    services = Services()
    with ClientSource(config("Echo", env_kwargs={"options": options}), services, SEED):
        pass
    back = services.kept[1]["options"]
    assert back[3]["array"].dtype == np.float32
    assert np.array_equal(back[3].pop("array"), options[3].pop("array"))
    assert back == options
    assert [type(value) for value in back["numbers"]] == [float, float, int, int, bool, type(None)]
    assert type(back["pair"]) is tuple
    assert type(back["scalar"]) is np.int16


def test_options_that_cannot_travel_are_named_before_anything_starts():
    settings = config("Echo", env_kwargs={"options": {"deep": object()}})
    with pytest.raises(UsageError, match=r"env_kwargs'\]\['options'\]\['deep'\].*cannot travel"):
        ClientSource(settings, Services(), SEED).__enter__()


# Predictions that are applied -------------------------------------------------------------------


@pytest.mark.parametrize("instances", [1, 2, 3])
def test_predictions_are_applied_to_the_instance_and_row_they_belong_to(instances):
    results = []
    for make, options in ((LocalSource, {}), (ClientSource, {"run_ahead": 0})):
        rows, count = [], 0
        settings = config("Applied", num_clients=instances)
        with make(settings, Services(), SEED, **options) as source:
            for size in (1, 2, 1, 5, 4):
                rows.append(source.batch(size)["x"].copy())
                source.apply({"y": np.arange(count, count + size, dtype=float)[:, None]})
                count += size
            rows.append(source.batch(2 * instances)["x"].copy())
        results.append(np.concatenate(rows))
    assert np.array_equal(*results)


def test_an_error_while_a_prediction_is_applied_comes_back():
    settings = config("Trouble", env_kwargs={"what": "fail", "method": "apply_prediction"})
    for go_on in (True, False):
        with (
            pytest.raises(EnvironmentFailedError, match=r"apply_prediction\(\) at step 1"),
            ClientSource(settings, Services(), SEED, run_ahead=0) as clients,
        ):
            clients.batch(1)
            clients.apply({"y": np.zeros(1)})
            if go_on:
                clients.batch(1)


def test_predictions_cannot_be_applied_to_clients_that_run_ahead():
    with (
        ClientSource(config("Applied"), Services(), SEED) as clients,
        pytest.raises(UsageError, match="run_ahead=0"),
    ):
        clients.batch(1)
        clients.apply({"y": np.zeros(1)})
