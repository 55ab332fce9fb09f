"""godot-gym when things go wrong: the server says what happened, lives, and serves the next."""

from __future__ import annotations

import socket
import struct

import pytest

from physx_core.errors import UsageError
from physx_remote import serve

SEE = {"agent": ["a"]}
LIVES = {"observation": {"world": []}}
ALIVE = bytes.fromhex("120d080110ffffffffffffffffff01")


def assert_lives(peer, peer_class):
    """The client that is there is served, and so is the next."""
    assert peer.ask(LIVES) == ALIVE
    peer.leave()
    after = peer_class(peer.service.address, peer.service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


# Requests that are none ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"{", "not valid JSON"),
        (b"\xff\xfe{}", "not valid JSON"),
        (b"[" * 200_000, "not valid JSON"),
        (b'{"action": 1' + b"0" * 9000 + b"}", "not valid JSON"),
        (b"[1, 2]", "not list"),
        (b"null", "not NoneType"),
        (b'"reset"', "not str"),
        (b"5", "not int"),
        (b'{"observation": null}', '"observation" must be a JSON object'),
        (b'{"observation": ["agent"]}', '"observation" must be a JSON object'),
        (b'{"config": null}', '"config" must be a JSON object'),
        (b'{"config": {"environment": 1}}', '"config.environment" must be a JSON object'),
        (b'{"config": {"environment": {"repeat_action": -1}}}', "repeat_action"),
        (b'{"config": {"environment": {"repeat_action": 1.5}}}', "repeat_action"),
        (b'{"config": {"environment": {"repeat_action": true}}}', "repeat_action"),
        (b'{"config": {"environment": {"repeat_action": Infinity}}}', "repeat_action"),
        (b'{"config": {"environment": {"repeat_action": "4"}}}', "repeat_action"),
        (b'{"config": {"environment": {"time_speed": 0}}}', "time_speed"),
        (b'{"config": {"environment": {"time_speed": NaN}}}', "time_speed"),
        (b'{"config": {"environment": {"time_speed": []}}}', "time_speed"),
        (b'{"reset": {"seed": -1}}', "seed"),
        (b'{"reset": {"seed": 1.5}}', "seed"),
        (b'{"reset": {"seed": true}}', "seed"),
    ],
)
def test_a_request_that_cannot_be_carried_out(peer, peer_class, caplog, body, said):
    assert said in peer.error(body)
    assert said in caplog.text
    assert_lives(peer, peer_class)


def test_a_wrong_configuration_changes_nothing(peer, scene):
    wrong = {"repeat_action": 9, "time_speed": "fast"}
    assert "time_speed" in peer.error({"config": {"environment": wrong, "agent": 1}})
    assert scene.repeat_action == 4
    assert scene.calls == []


def test_such_a_client_may_be_closed_instead(start, scene, peer_class, caplog):
    service = start(scene, errors="close")
    peer = peer_class(service.address, service)
    assert peer.ask({"action": 1}) == b""
    assert peer.ask(b"null") is None
    assert "its request failed" in caplog.text
    after = peer_class(service.address, service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


# Exceptions of the user's code ----------------------------------------------------------------


HOOKS = [
    ("agent.set_action", {"action": 1}),
    ("agent.get_data", {"observation": {"agent": 1}}),
    ("agent.configure", {"config": {"agent": 1}}),
    ("agent._physics_process", {"action": 1}),
    ("world.get_data", {"observation": {"world": 1}}),
    ("world.configure", {"config": {"world": 1}}),
    ("world._physics_process", {"action": 1}),
    ("_reset", {"reset": 1}),
    ("_step", {"action": 1}),
    ("_configure", {"config": {}}),
    ("_send_response", {"observation": {}}),
    ("_physics_process", {"action": 1}),
]


@pytest.mark.parametrize(("hook", "request_"), HOOKS)
def test_an_exception_in_a_hook(peer, peer_class, scene, caplog, hook, request_):
    owner, _, name = hook.rpartition(".")
    owner = getattr(scene, owner) if owner else scene

    def fail(*arguments):
        raise ValueError("the ball is lost")

    whole = getattr(owner, name)
    setattr(owner, name, fail)
    assert peer.error(request_) == "ValueError: the ball is lost"
    assert "the ball is lost" in caplog.text and "Traceback" in caplog.text
    assert scene.paused
    setattr(owner, name, whole)
    assert peer.ask({"action": [1]}) == b""
    assert_lives(peer, peer_class)


def test_an_exception_after_the_answer_is_only_logged(peer, peer_class, scene, caplog):
    def fail():
        raise ValueError("no frames")

    scene._after_send_response = fail
    assert peer.ask(LIVES) == ALIVE
    peer.arrive()
    assert peer.received == b"" and "no frames" in caplog.text
    assert_lives(peer, peer_class)


def test_missing_parts_are_named(peer, peer_class, scene):
    agent, world, messages = scene.agent, scene.world, scene.messages
    scene.agent = scene.world = scene.messages = None
    assert "set self.messages" in peer.error({"observation": {}})
    assert "set self.agent" in peer.error({"action": 1})
    scene.messages = messages
    assert "set self.world" in peer.error(LIVES)
    scene.agent, scene.world = agent, world
    assert_lives(peer, peer_class)


def test_what_a_subclass_forgot_is_named(peer, scene):
    from physx_remote import RLAgent, RLEnvironment, RLEnvWorld

    scene.agent, scene.world = RLAgent(), RLEnvWorld()
    assert "does not implement set_action" in peer.error({"action": 1})
    assert "does not implement get_data" in peer.error({"observation": {"agent": 1}})
    assert "does not implement get_data" in peer.error({"observation": {"world": 1}})
    assert peer.ask({"config": {"agent": 1, "world": 1}}) == b""
    with pytest.raises(UsageError, match="does not implement _ready"):
        serve(RLEnvironment(), "godot-gym")


def test_a_message_that_is_put_twice(peer, peer_class, scene):
    scene._after_send_response = scene.communication.put_message
    assert peer.ask(LIVES) == ALIVE
    scene._after_send_response = lambda: None
    with pytest.raises(UsageError, match="there is none"):
        scene.communication.put_message()
    assert_lives(peer, peer_class)


def test_a_step_that_waits_for_nonsense(peer, peer_class, scene):
    def step(action):
        yield "soon"

    whole, scene._step = scene._step, step
    assert "waits for 'soon'" in peer.error({"action": 1})
    scene._step = whole
    assert_lives(peer, peer_class)


# Clients that leave ---------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["fin", "rst"])
@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"\x10",
        b"\x10\0\0\0",
        b'\x10\0\0\0{"act',
        b'\x0d\0\0\0{"action": 1}',
        b'\x0d\0\0\0{"action": 1}' * 3,
        b'\x0d\0\0\0{"action": 1}\x10\0\0',
    ],
)
def test_client_disconnect_at_any_moment(peer, peer_class, scene, how, sent):
    assert peer.ask({"action": [1]}) == b""
    leaving = peer_class(peer.service.address, peer.service)
    peer.leave()
    if sent:
        leaving.send(sent)
    leaving.leave(how)
    after = peer_class(peer.service.address, peer.service)
    assert after.ask(LIVES) == ALIVE
    assert scene.agent.distance >= 16  # nothing was reset
    after.leave()


@pytest.mark.parametrize("how", ["fin", "rst"])
def test_client_disconnect_during_step(peer, peer_class, scene, how, message):
    peer.ask({"config": {"environment": {"time_speed": 0.25}}})
    peer.send(message({"action": [1]}))
    while scene.agent.frames < 1:
        peer.service.poll(0.05)
    peer.leave(how)
    after = peer_class(peer.service.address, peer.service)
    assert after.ask(LIVES) == ALIVE
    assert 1 <= scene.agent.frames <= 4
    assert scene.paused
    assert after.ask({"action": [1]}) == b""
    after.leave()


def test_a_client_that_says_all_at_once_and_then_only_reads(peer, message):
    peer.send(message({"reset": 1}) + message(LIVES))
    peer.socket.shutdown(socket.SHUT_WR)
    assert peer.answer() == b""
    assert peer.answer() == ALIVE
    assert peer.answer() is None


def test_client_that_does_not_read_blocks_nobody(start, scene, peer_class, message):
    service = start(scene, clients="serve")
    deaf, other = (peer_class(service.address, service) for _ in range(2))
    scene.agent.get_data = lambda request, storage: setattr(storage, "frame", bytes(1 << 20))
    deaf.send(message({"observation": SEE}) * 40)
    while not any(connection.outgoing for connection in scene.communication.connections):
        service.poll(0.05)
    assert other.ask(LIVES) == ALIVE
    assert sum(len(connection.outgoing) for connection in scene.communication.connections) < 2 << 20
    for _ in range(40):
        assert len(deaf.answer()) > 1 << 20
    deaf.leave()
    other.leave()


# Floods, lies and silence ----------------------------------------------------------------------


def test_message_length_of_a_gigabyte_is_refused(peer, peer_class, caplog):
    peer.send(struct.pack("<I", 1 << 30) + b"{")
    assert peer.answer() is None
    assert "1073741824 bytes" in caplog.text
    after = peer_class(peer.service.address, peer.service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


def test_requests_before_a_lie_are_answered(peer, message):
    peer.send(message(LIVES) + message(LIVES) + b"\xff\xff\xff\xff")
    assert [peer.answer() for _ in range(3)] == [ALIVE, ALIVE, None]


def test_silent_client_blocks_nobody(peer, peer_class):
    silent = [peer_class(peer.service.address) for _ in range(5)]
    silent[0].send(b"\x20\0\0\0{")
    assert peer.ask(LIVES) == ALIVE
    for other in silent:
        other.leave()


def test_patience_ends_where_another_waits(start, scene, peer_class, caplog):
    service = start(scene, patience=0.05)
    first = peer_class(service.address, service)
    assert first.ask(LIVES) == ALIVE
    second = peer_class(service.address, service)
    assert second.ask(LIVES) == ALIVE
    assert first.answer() is None
    assert "silent for 0.05 s while another waits" in caplog.text
    second.leave()


def test_fifty_clients_at_once_in_turn(start, scene, peer_class, message):
    service = start(scene, clients="serve")
    peers = [peer_class(service.address, service) for _ in range(50)]
    for peer in peers:
        peer.send(message({"action": [0.0], **LIVES}))
    for peer in peers:
        assert peer.answer() == ALIVE
    assert scene.agent.frames == 200
    for peer in peers:
        peer.leave()


def test_fifty_clients_at_once_one_after_the_other(start, scene, peer_class, message):
    service = start(scene)
    peers = [peer_class(service.address, service) for _ in range(50)]
    for peer in peers:
        peer.send(message({"action": [0.0], **LIVES}))
    while (waiting := len(peers)) > 0:
        readable = [p for p in peers if _has_answer(p)]
        for peer in readable:
            assert peer.answer() == ALIVE
            peer.leave()
            peers.remove(peer)
        service.poll(0.02)
        assert len(readable) <= 1 or waiting == len(peers) + len(readable)
    assert scene.agent.frames == 200


def _has_answer(peer):
    peer.socket.setblocking(False)
    try:
        return bool(peer.socket.recv(1, socket.MSG_PEEK))
    except BlockingIOError:
        return False
    finally:
        peer.socket.settimeout(30)


def test_more_clients_than_there_may_be(start, scene, peer_class, caplog):
    service = start(scene, max_clients=2, clients="serve")
    peers = [peer_class(service.address, service) for _ in range(3)]
    assert [peer.ask(LIVES) for peer in peers[:2]] == [ALIVE, ALIVE]
    assert peers[2].ask(LIVES) is None
    assert "Too many clients are connected: max_clients is 2" in caplog.text
    assert peers[0].ask(LIVES) == ALIVE
    for peer in peers:
        peer.leave()


def test_idle_clients_do_not_exhaust_connections(start, scene, peer_class, caplog):
    service = start(scene, max_clients=4)
    idle = []
    for _ in range(50):
        idle.append(peer_class(service.address, service))
        service.poll(0.01)
    idle[-1].send(b"\x05")  # not a whole request
    peer = peer_class(service.address, service)
    assert peer.ask(LIVES) == ALIVE
    assert len(service.environment.communication.connections) <= 32 + 1
    assert "too many connections are pending" in caplog.text
    for one in (*idle, peer):
        one.leave()


def test_a_flood_of_bad_requests_does_not_flood_the_log(start, scene, peer_class, caplog):
    service = start(scene)
    peer = peer_class(service.address, service)
    for _ in range(200):
        peer.error(b"[]")
    said = [text for text in caplog.messages if "must be a JSON object" in text]
    assert 10 <= len(said) <= 50
    peer.leave()
    service.close()
    left_out = [text for text in caplog.messages if "more entries like these" in text]
    assert left_out[0].endswith("about 127.0.0.1")
    assert sum(int(text.split()[0]) for text in left_out) + len(said) == 200
