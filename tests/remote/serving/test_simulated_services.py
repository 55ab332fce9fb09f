"""The loop of services in simulated time, on links in memory; the order of events is drawn."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import Simulation, drawn

from physx_remote import Communication
from physx_remote.errors import RemoteClosedError, RemoteTimeoutError
from physx_remote.serving.client_link import RequestLink
from physx_remote.serving.framing import add_prefix
from physx_remote.serving.socket_service import SocketService

PORT = 1


class Echo(SocketService):
    """Sends each message back after as many seconds as its first byte says."""

    def handle(self, connection, body):
        yield from [float(body[0])] * (body[0] > 0)
        self.send(connection, add_prefix(body))


def serve(simulation, service):
    """Start a service and a task that runs it until it is closed."""
    if isinstance(service, Communication):
        service.start_server(PORT)
    else:
        service.listen("127.0.0.1", PORT)

    def run():
        while service.poll(0.5):
            pass

    simulation.start(run)
    return service


def link(simulation, **options):
    return RequestLink(("127.0.0.1", PORT), transport=simulation, **options)


@pytest.mark.slow
@settings(max_examples=30)
@given(drawn, st.lists(st.lists(st.binary(max_size=300), max_size=4), min_size=1, max_size=4))
def test_each_client_gets_its_answers_in_any_order_of_events(choose, told):
    with Simulation(choose) as simulation:
        service = serve(simulation, Echo(transport=simulation))
        answers = [[] for _ in told]

        def ask(number):
            client = link(simulation)
            for body in told[number]:
                answers[number].append(client.exchange(b"\0" + body))
            client.close()

        clients = [simulation.start(lambda number=n: ask(number)) for n in range(len(told))]
        assert simulation.wait(lambda: all(client.greenlet.dead for client in clients), 60.0)
        assert answers == [[b"\0" + body for body in bodies] for bodies in told]
        service.close()


@pytest.mark.slow
@settings(max_examples=30)
@given(drawn)
def test_a_request_that_takes_long_keeps_the_others_waiting(choose):
    with Simulation(choose) as simulation:
        service, began = serve(simulation, Echo(transport=simulation)), simulation.monotonic()
        slow, quick = link(simulation), link(simulation)
        task = simulation.start(lambda: slow.exchange(bytes([30])))
        simulation.sleep(1.0)
        assert quick.exchange(b"\0") == b"\0"
        assert 30.0 <= simulation.monotonic() - began < 32.0
        assert simulation.wait(lambda: task.greenlet.dead, 1.0)
        service.close()


@pytest.mark.slow
@pytest.mark.parametrize("timeout", [0.5, 86_400.0])
def test_an_answer_that_does_not_come_is_given_up(timeout):
    with Simulation() as simulation:
        Echo(transport=simulation).listen("127.0.0.1", PORT)  # and nobody runs it
        client, began = link(simulation, timeout=timeout), simulation.monotonic()
        with pytest.raises(RemoteTimeoutError, match=f"did not answer within {timeout} s"):
            client.exchange(b"\0")
        assert timeout <= simulation.monotonic() - began < timeout + 1.0


def test_a_service_is_waited_for():
    with Simulation() as simulation:
        with pytest.raises(RemoteTimeoutError, match="Nothing answered at .* within 600 s"):
            link(simulation, connect_timeout=600)
        service = Echo(transport=simulation)
        later = simulation.monotonic() + 300
        simulation.start(lambda: (simulation.sleep(300), serve(simulation, service)))
        assert link(simulation, connect_timeout=600).exchange(b"\0a") == b"\0a"
        assert later <= simulation.monotonic() < later + 1.0
        service.close()


@pytest.mark.slow
def test_a_silent_client_is_left_after_its_time_where_another_waits(caplog):
    with Simulation() as simulation:
        service = serve(simulation, Communication(patience=3600.0, transport=simulation))
        service.got_connection.connect(lambda request: service.put_message(b"yes"))
        silent, other = link(simulation), link(simulation, timeout=7200.0)
        assert silent.exchange(b"{}") == b"yes"
        began = simulation.monotonic()
        assert other.exchange(b"{}") == b"yes"
        assert 3600.0 <= simulation.monotonic() - began < 4600.0
        with pytest.raises(RemoteClosedError):
            silent.exchange(b"{}")
        assert "silent for 3600 s while another waits" in caplog.text
        service.close()
