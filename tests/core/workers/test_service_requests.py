"""ClientSource: what environments ask for, and predictions that are applied to them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from physx_core.errors import ClientError, EnvironmentFailedError, UsageError


@pytest.fixture
def batch_services(services):
    """The services, predicting several samples at once; `asked` tells the instances."""

    def predict(fields):
        services.asked.append(str(int(fields["x"][0])))
        return {"y": 2 * fields["x"]}

    def predict_batch(batch):
        services.asked.append(" ".join(str(int(one)) for one in batch["x"][:, 0]))
        return {"y": 2 * batch["x"]}

    services.predict, services.predict_batch = predict, predict_batch
    return services


# What environments ask for ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["services", "batch_services"])
def test_predictions_are_answered(simulated, kind, request):
    services = request.getfixturevalue(kind)
    with simulated("Asking", num_clients=3, run_ahead=0) as source:
        rows = source.batch(30)["x"]
    expected = [[2 * (row % 3 + 1), 2 * (row // 3)] for row in range(30)]
    assert rows.tolist() == expected
    assert "".join(map(str, services.asked)).count("1") >= 10


def test_requests_of_all_instances_are_one_batch_whatever_their_speed(simulated, batch_services):
    with simulated("Asking", num_clients=3, env_kwargs={"delay": 0.01}, run_ahead=0) as source:
        for size in (1, 30, 2):
            source.batch(size)
    assert batch_services.asked == ["1"] + 10 * ["1 2 3"] + ["2 3"]


def test_instance_that_delays_batch_of_requests_is_reported(simulated, batch_services):
    kwargs = {"what": "sleep", "who": 2, "at": 1}
    settings = {"num_clients": 2, "env_kwargs": kwargs, "timeout": 2.5}
    with (
        pytest.raises(ClientError, match="Client 2 sent nothing"),
        simulated("AskingTrouble", run_ahead=10, **settings) as source,
    ):
        source.batch(1)
        source.batch(2)


def test_a_refused_prediction_is_the_error_of_the_services(local, simulated, services):
    def predict(fields):
        raise UsageError("there is no network")

    services.predict = predict
    for make in (local, simulated):
        with (
            pytest.raises(UsageError, match="there is no network") as caught,
            make("Asking", num_clients=2) as source,
        ):
            source.batch(4)
        (note,) = caught.value.__notes__
        line = r"(, at \w+\.py:\d+: .+)?"  # of the services if they are here, else of the class
        assert re.fullmatch(rf"in step\(\) of instance [12]{line}", note)  # whoever was first


def test_long_prediction_is_no_timeout(simulated, services, simulation):
    quick = services.predict

    def predict(fields):
        simulation.sleep(0.4)
        return quick(fields)

    services.predict = predict
    with simulated("Asking", num_clients=3, timeout=1.0, run_ahead=0) as source:
        assert len(source.batch(3)["x"]) == 3


def test_an_exception_of_the_network_is_raised_as_it_is(simulated, services):
    def predict(fields):
        raise ZeroDivisionError("in the network")

    services.predict = predict
    with (
        pytest.raises(ZeroDivisionError, match="in the network"),
        simulated("Asking", num_clients=2) as source,
    ):
        source.batch(4)


def test_parameters_are_kept_and_given_back(simulated, services):
    for _ in range(2):
        with simulated("Asking", num_clients=2):
            pass
    assert set(services.kept) == {1, 2}
    for number in (1, 2):
        kept = services.kept[number]
        assert kept["instance"] == kept["kept"]["instance"] == number
        assert kept["table"].tolist() == [0, 1, 2]
        assert kept["kept"]["kept"] == {}


def test_drawing_events_arrive_exactly(local, simulated, services):
    shown = []
    for make in (local, simulated):
        services.shown.clear()
        with make("Drawing", num_clients=2, visualizer="rerun") as source:
            source.batch(6)
        shown.append(
            [one for number in (1, 2) for one in services.shown if one[0] == number and one[1] < 3]
        )
    assert len(shown[0]) == len(shown[1]) == 8
    for ours, theirs in zip(*shown, strict=True):
        assert ours[:2] == theirs[:2]
        for a, b in zip(ours[2], theirs[2], strict=True):
            assert (a.action, a.kind, a.name) == (b.action, b.kind, b.name)
            assert a.values.keys() == b.values.keys()
            same_arrays(a.values, b.values)


DRAWING = {"visualizer": "rerun", "env_kwargs": {"pace": 1e-4}}


@pytest.mark.slow
def test_ending_client_waits_until_server_has_read_everything(simulated, services, simulation):
    """The server is slow, and the client comes to its end while thousands of messages wait."""
    shown, closing, ended = [], [], []

    def show(instance_id, step, events):
        if len(shown) == 1:  # the first is what is drawn at the beginning
            simulation.sleep(1.0)  # meanwhile the client gets ahead
        if closing and not ended:
            simulation.sleep(1.0)  # meanwhile it closes its environment
            ended.append(closing[0].exit_status())
        shown.append(step)

    services.show = show
    with simulated("Drawing", run_ahead=5000, total=5000, **DRAWING) as source:
        source.batch(1)
        closing += simulation.clients
    assert shown[1:] == list(range(len(shown) - 1))
    assert len(shown) > 1000
    assert ended == [None]
    assert closing[0].exit_status() == 0


@pytest.mark.slow
def test_rows_sent_before_kill_are_read(simulated, services, simulation):
    """The server is slow, and thousands of messages of a client that is no more wait."""
    shown, killing = [], []

    def show(instance_id, step, events):
        if killing:
            simulation.sleep(1.0)  # meanwhile the client gets ahead
            killing.pop().kill()
        shown.append(step)

    services.show = show
    with (
        pytest.raises(ClientError, match="killed by signal 9"),
        simulated("Drawing", run_ahead=3000, **DRAWING) as source,
    ):
        source.batch(1)
        killing += simulation.clients
        assert source.batch(2000)["step"].tolist() == list(range(1, 2001))
        assert not killing
        shown.append("all")
    assert "all" in shown


def same_arrays(a, b):
    for name, value in a.items():
        if isinstance(value, np.ndarray):
            assert value.dtype == b[name].dtype
            assert value.tobytes() == b[name].tobytes()
        else:
            assert value == b[name]


def test_options_arrive_exactly(simulated, services):
    options = {
        "numbers": [0.1, 1e300, 2**70, -1, True, None],
        "pair": (1, (2.5, "x")),
        3: {"array": np.arange(1_000_000, dtype=np.float32).reshape(1000, 1000)},
        "scalar": np.int16(7),
        "bytes": bytes(range(256)),
    }
    with simulated("Echo", env_kwargs={"options": options}):
        pass
    back = services.kept[1]["options"]
    assert back[3]["array"].dtype == np.float32
    assert np.array_equal(back[3].pop("array"), options[3].pop("array"))
    assert back == options
    assert [type(value) for value in back["numbers"]] == [float, float, int, int, bool, type(None)]
    assert type(back["pair"]) is tuple
    assert type(back["scalar"]) is np.int16


def test_unserializable_options_are_refused_before_start(simulated):
    message = r"env_kwargs'\]\['options'\]\['deep'\].*cannot be sent"
    kwargs = {"options": {"deep": object()}}
    with pytest.raises(UsageError, match=message), simulated("Echo", env_kwargs=kwargs):
        pass


# Predictions that are applied -------------------------------------------------------------------


@pytest.mark.parametrize("instances", [1, 2, 3])
def test_predictions_are_applied_to_the_instance_and_row_they_belong_to(
    local, simulated, instances
):
    results = []
    for make, options in ((local, {}), (simulated, {"run_ahead": 0})):
        rows, count = [], 0
        with make("Applied", num_clients=instances, **options) as source:
            for size in (1, 2, 1, 5, 4):
                rows.append(source.batch(size)["x"].copy())
                source.apply({"y": np.arange(count, count + size, dtype=float)[:, None]})
                count += size
            rows.append(source.batch(2 * instances)["x"].copy())
        results.append(np.concatenate(rows))
    assert np.array_equal(*results)


def test_an_error_while_a_prediction_is_applied_comes_back(simulated):
    kwargs = {"what": "fail", "method": "apply_prediction"}
    for go_on in (True, False):
        with (
            pytest.raises(EnvironmentFailedError, match=r"apply_prediction\(\) at step 1"),
            simulated("Trouble", env_kwargs=kwargs, run_ahead=0) as source,
        ):
            source.batch(1)
            source.apply({"y": np.zeros(1)})
            if go_on:
                source.batch(1)


def test_predictions_cannot_be_applied_to_clients_that_run_ahead(simulated):
    with simulated("Applied") as source, pytest.raises(UsageError, match="run_ahead=0"):
        source.batch(1)
        source.apply({"y": np.zeros(1)})
