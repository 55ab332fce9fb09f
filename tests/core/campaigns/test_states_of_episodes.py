"""Long episodes that are lost go on from their last state, with the same rows."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import sizes
from campaigns import Results, leased
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from simulated import Simulation, drawn

from physx_core import DataGeneration, Dataset, DatasetConfig, EnvironmentConfig
from physx_core.cli import main
from physx_core.dataset import EpisodeStatus
from physx_core.net import Kind, encode
from physx_core.net.frames import HEADER, Frame
from physx_core.plugins import resolve
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.lease import Begun
from physx_core.workers.server.leases import Leases

ENVS = Path(__file__).parents[1] / "programs" / "state_envs.py"
VOYAGE = f"{ENVS}:Voyage"
SEED = [5, 2]
NUMBERS, ROWS = 4, 60


def simulate(every, environment=VOYAGE, simulation=None, **options):
    """Return the rows of all episodes: of simulated clients, or in this process."""
    options = {"env_kwargs": {}, **options}
    queue, transport = EpisodeQueue(NUMBERS, retries=options.get("retries")), {}
    if simulation is None:
        options["as_tcp_ip_client"] = False
    else:
        options["launcher"], transport = "simulated:SimulatedLauncher", {"transport": simulation}
    config = EnvironmentConfig(environment, state_every=every, **options)
    with leased(config, SEED, queue, **transport) as source:
        results = Results().take_all(source, queue)
    assert not results.failed
    return results.rows


@pytest.fixture(scope="module")
def undisturbed():
    """The rows with and without states: those of an engine that feels them."""
    return {every: simulate(every) for every in (0, 4)}


def test_rows_depend_on_states_only_where_the_engine_does(undisturbed):
    assert undisturbed[0].keys() == undisturbed[4].keys()
    assert undisturbed[0] != undisturbed[4]


@pytest.mark.parametrize("every", [0, 4])
def test_rows_of_lost_episodes_are_the_same(undisturbed, every, simulation):
    kills = [*range(0, ROWS, 7)]
    options = {"num_clients": 2, "retries": 100, "env_kwargs": {"kills": kills, "pace": 0.03}}
    assert simulate(every, simulation=simulation, **options) == undisturbed[every]
    again = simulation.steps - NUMBERS * ROWS
    assert again < 20 * (4 + 1) if every else again > 300


def test_an_episode_longer_than_its_clients_live_ends(undisturbed, simulation):
    kills = [*range(9, ROWS, 9)]
    options = {"num_clients": 1, "retries": 100, "env_kwargs": {"kills": kills, "pace": 5.0}}
    assert simulate(4, simulation=simulation, **options) == undisturbed[4]
    assert simulation.steps < 2 * NUMBERS * ROWS


@pytest.mark.slow
@settings(max_examples=sizes.size(30, 6), phases=[Phase.explicit, Phase.generate])
@given(drawn, st.integers(1, 3), st.sets(st.integers(0, ROWS - 1), max_size=8))
def test_rows_do_not_depend_on_kills_and_the_order_of_events(undisturbed, choose, count, kills):
    with Simulation(choose) as simulation:
        kwargs = {"kills": [*kills], "pace": 0.03}
        options = {"num_clients": count, "retries": 20, "env_kwargs": kwargs}
        assert simulate(4, simulation=simulation, **options) == undisturbed[4]


@pytest.mark.parametrize(("name", "runs"), [("OpaqueVoyage", 2), ("OwnVoyage", 1)])
def test_episodes_without_states_begin_anew_with_one_warning(simulation, said, name, runs):
    kind = f"{ENVS}:{name}"
    expected = simulate(4, kind)
    kills = [*range(9, ROWS, 9)]
    options = {"num_clients": 2, "retries": 100, "env_kwargs": {"kills": kills, "pace": 0.03}}
    assert simulate(4, kind, simulation=simulation, **options) == expected
    assert len(said("gives or takes no state")) == runs


def test_an_episode_that_went_on_is_repeated_as_a_whole():
    options = {"as_tcp_ip_client": False, "state_every": 4, "env_kwargs": {"wait": 0.01}}
    config = EnvironmentConfig(VOYAGE, **options)
    with leased(config, SEED, EpisodeQueue(1)) as source:
        block = source.take()
    begun = Begun(1, block.records[0].rows, *block.state[1:])
    queue = EpisodeQueue(1, begun={0: begun})
    with leased(config, SEED, queue) as source:
        while not queue.is_done:
            (record,) = source.take().records
        assert record.part > 1
        assert source.repeat(0, 1)["step"].tolist() == [*range(ROWS)]


def test_what_an_episode_takes_is_the_sum_of_its_parts():
    """A client gets several numbers at once only if they are short."""
    sent, no_pace = [], SimpleNamespace(go_on=lambda: None)
    client = {"instance_id": 1, "parameters": [], "row_fields": [], "episode_fields": []}
    peer = SimpleNamespace(**client, send=sent.append, pace=no_pace, received=0)
    leases = Leases(EpisodeQueue(100), lambda numbers: {})
    leases.grant(peer, 1)
    more, finished = int(EpisodeStatus.MORE), int(EpisodeStatus.FINISHED)
    for part, (status, seconds) in enumerate([(more, 0.03), (more, 0.03), (finished, 0.001)]):
        ended = [(0, 1, 0, part, status, seconds, "", {})]
        frame = Frame(Kind.EPISODES, 0, bytearray(encode([ended, None])))
        leases.dispatch[Kind.EPISODES](peer, frame)
    leases.grant(peer, 1)
    assert [HEADER.unpack_from(message)[-1] for message in sent] == [1, 1]


# Resumed runs -----------------------------------------------------------------------------------


def generate(name, stop=0, **options):
    """Generate the episodes in this process; end after some rows if asked to."""
    kind = resolve("environment", VOYAGE)
    kind.made, kind.stop = 0, stop
    config = {"as_tcp_ip_client": False, "seed": 4, "state_every": 4, "env_kwargs": {"wait": 0.002}}
    environment = EnvironmentConfig(VOYAGE, **config | options.pop("environment", {}))
    amount = options.pop("amount", {"episodes": NUMBERS})
    run = DataGeneration(
        environment, session_name=name, new_session=False, quiet=True, **amount, **options
    )
    if stop:
        with pytest.raises(KeyboardInterrupt):
            run.execute()
    else:
        run.execute()
    return kind.made


def stored(name, mode="training"):
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        data = dataset[mode]
        return {field: data[field][:].tobytes() for field in data}


@pytest.mark.parametrize("amount", [{"episodes": NUMBERS}, {"batch_nb": 23, "batch_size": 10}])
def test_a_resumed_run_goes_on_with_the_episode_that_was_begun(amount):
    generate("whole", amount=amount)
    generate("run", ROWS + 45, amount=amount)
    assert list(Path("sessions/run/states").iterdir())
    made = generate("run", ROWS + 40, resume=True, amount=amount)  # in the third
    rest = generate("run", resume=True, amount=amount)
    assert made + rest <= NUMBERS * ROWS - ROWS - 45 + 2 * 30
    assert stored("run") == stored("whole")
    assert not list(Path("sessions/run/states").iterdir())


def test_rejected_samples_before_a_state_are_stored_once():
    options = {"env_kwargs": {"refuse": 6, "wait": 0.002}, "record_wrong_samples": True}
    generate("whole", environment=options)
    generate("run", ROWS + 45, environment=options)
    generate("run", resume=True, environment=options)
    assert stored("run", "wrong") == stored("whole", "wrong")
    assert stored("run") == stored("whole")


@pytest.mark.parametrize("damage", ["file", "rows", "none"])
def test_states_that_do_not_fit_the_rows_do_not_count(damage):
    generate("whole")
    generate("run", 45)
    for path in Path("sessions/run/states").iterdir():
        if damage == "file":
            path.write_bytes(path.read_bytes()[:-1] + b"?")
    if damage == "rows":
        assert main(["compact", "sessions/run"]) == 0
    made = generate("run", resume=True)
    assert stored("run") == stored("whole")
    assert (made < NUMBERS * ROWS) == (damage == "none")


def test_states_of_another_campaign_do_not_count():
    generate("whole")
    generate("other", 45, environment={"seed": 5})
    generate("run", 45)
    for path in Path("sessions/other/states").iterdir():
        path.replace(Path("sessions/run/states") / path.name)
    generate("run", resume=True)
    assert stored("run") == stored("whole")


@pytest.mark.processes
@pytest.mark.parametrize("writers", ["server", "clients"])
def test_episodes_end_although_no_process_lives_as_long(writers):
    generate("whole", amount={"episodes": 2})
    mortal = {"env_kwargs": {"life": 25, "wait": 0.01}, "retries": 100, "as_tcp_ip_client": True}
    data = DatasetConfig(writers=writers)
    generate("run", amount={"episodes": 2}, environment=mortal, dataset_config=data)
    assert stored("run") == stored("whole")


@pytest.mark.processes
def test_clients_go_on_with_the_episode_of_a_run_in_one_process():
    clients = {"as_tcp_ip_client": True, "num_clients": 2}
    generate("whole")
    generate("run", ROWS + 45)
    generate("run", resume=True, environment=clients)
    assert stored("run") == stored("whole")


def test_state_every_must_stay_what_it_was():
    generate("run", 45)
    with pytest.raises(Exception, match="state_every was"):
        generate("run", resume=True, environment={"state_every": 5})
