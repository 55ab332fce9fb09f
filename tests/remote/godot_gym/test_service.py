"""godot-gym with several clients, and as a part of a process."""

from __future__ import annotations

import logging
import threading

import pytest

from physx_core import PhysxError
from physx_core.errors import ConfigError, UnknownOptionError, UsageError
from physx_remote import serve
from physx_remote.errors import RemoteError

LIVES = {"observation": {"world": []}}
ALIVE = bytes.fromhex("120d080110ffffffffffffffffff01")


# Second clients ------------------------------------------------------------------------------


def test_a_second_client_waits(start, scene, peer_class, message, caplog):
    caplog.set_level(logging.INFO)
    service = start(scene)
    first, second = (peer_class(service.address, service) for _ in range(2))
    assert first.ask(LIVES) == ALIVE
    second.send(message({"reset": 2, **LIVES}))
    for _ in range(3):
        service.poll(0.01)
        assert first.ask(LIVES) == ALIVE
    assert ("reset", 2) not in scene.calls
    first.leave()
    assert second.answer() == ALIVE
    assert ("reset", 2) in scene.calls
    second.leave()


def test_what_a_client_wanted_that_did_not_wait_is_not_done(start, scene, peer_class, message):
    service = start(scene)
    first, second = (peer_class(service.address, service) for _ in range(2))
    assert first.ask(LIVES) == ALIVE
    second.send(message({"reset": 2}))
    while not any(c.body for c in scene.communication.connections):
        service.poll(0.05)
    second.leave()
    while len(scene.communication.connections) > 1:
        service.poll(0.05)
    first.leave()
    third = peer_class(service.address, service)
    assert third.ask(LIVES) == ALIVE
    assert ("reset", 2) not in scene.calls
    third.leave()


def test_a_second_client_is_refused(start, scene, peer_class, caplog):
    service = start(scene, clients="refuse")
    early, first = (peer_class(service.address, service) for _ in range(2))
    assert first.ask(LIVES) == ALIVE
    late = peer_class(service.address, service)
    assert early.answer() is None
    assert late.answer() is None
    assert caplog.text.count("turned away while") == 2
    first.leave()
    while scene.communication.connections:  # the next one could be seen before its end is
        service.poll(0.05)
    after = peer_class(service.address, service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


def test_two_clients_are_served_in_turn(start, scene, peer_class, message):
    service = start(scene, clients="serve")
    first, second = (peer_class(service.address, service) for _ in range(2))
    first.send(b"".join(message({"action": [1], "config": n}) for n in range(20)))
    second.send(message({"reset": 1}))
    assert second.answer() == b""
    assert [first.answer() for _ in range(20)] == [b""] * 20
    assert first.ask(LIVES) == second.ask(LIVES) == ALIVE
    first.leave()
    second.leave()


# The process -----------------------------------------------------------------------------------


def test_closing_from_another_thread_and_within_a_request(in_thread, scene_class, peer_class):
    service = in_thread(scene_class())
    peer = peer_class(service.address)
    peer.ask({})
    service.close()
    assert peer.answer() is None
    service = in_thread(scene_class())
    service.environment.agent.set_action = lambda action: service.close()
    peer = peer_class(service.address)
    peer.ask({"action": 1})
    assert peer.answer() is None
    assert not service.poll(10.0)
    service.close()


def test_an_interruption_ends_run_and_the_service_goes_on(start, scene, peer_class, message):
    service = start(scene)
    peer = peer_class(service.address, service)

    def interrupt(action):
        raise KeyboardInterrupt

    whole, scene.agent.set_action = scene.agent.set_action, interrupt
    peer.send(message({"action": 1}))
    service.run()  # returns
    assert peer.answer() is None
    scene.agent.set_action = whole
    after = peer_class(service.address, service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


def test_an_environment_that_listens_by_itself(scene_class, peer_class):
    class Alone(scene_class):
        def _ready(self):
            super()._ready()
            self.communication.start_server(0, "127.0.0.1")

    environment = Alone()
    with environment:
        thread = threading.Thread(target=environment.run)
        thread.start()
        peer = peer_class(environment.communication.address)
        assert peer.ask(LIVES) == ALIVE
        with pytest.raises(UsageError, match="already listening"):
            environment.communication.start_server(0)
        environment.close()
        thread.join(60)
        assert peer.answer() is None
    with pytest.raises(UsageError, match="start_server"):
        scene_class().run()


def test_options_are_checked(scene_class):
    with pytest.raises(UnknownOptionError, match='Did you mean "clients"'):
        serve(scene_class(), "godot-gym", client="queue")
    for option in ("clients", "reply", "errors", "request_framing"):
        with pytest.raises(ConfigError, match=f"{option} is \"?'some"):
            serve(scene_class(), "godot-gym", **{option: "some"})
    for option in ("max_request", "max_clients", "patience"):
        with pytest.raises(ConfigError, match=option):
            serve(scene_class(), "godot-gym", **{option: 0})
    with pytest.raises(UsageError, match="one world"):
        serve(scene_class(), "godot-gym", num_worlds=2)
    with pytest.raises(PhysxError, match='Did you mean "godot-gym"'):
        serve(scene_class(), "godot_gym")


def test_a_port_that_is_taken(start, scene, scene_class):
    service = start(scene)
    with pytest.raises(RemoteError, match="no other program uses"):
        serve(scene_class(), "godot-gym", port=service.address[1])
    with pytest.raises(RemoteError, match="192.0.2.1"):
        serve(scene_class(), "godot-gym", address="192.0.2.1")
