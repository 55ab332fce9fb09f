"""godot-gym on the wire: what godot_gym_api does, byte for byte."""

from __future__ import annotations

import json

import pytest

GOLDEN = [
    # (length, request, answer), as the original client and Godot exchanged them
    ("31000000", '{"config": {"environment": {"time_speed": 20.0}}}', "00000000"),
    ("31000000", '{"config": {"environment": {"repeat_action": 2}}}', "00000000"),
    (
        "37000000",
        '{"reset": 1, "observation": {"agent": [], "world": []}}',
        "170000000a060a0400000000120d080110ffffffffffffffffff01",
    ),
    (
        "33000000",
        '{"action": [0.5, -1], "observation": {"agent": []}}',
        "080000000a060a0400008040",
    ),
    ("13000000", '{"observation": {}}', "00000000"),
    ("1e000000", '{"observation": {"world": []}}', "0f000000120d080110ffffffffffffffffff01"),
]
REQUESTS = [bytes.fromhex(length) + request.encode() for length, request, _ in GOLDEN]
ANSWERS = [bytes.fromhex(answer) for *_, answer in GOLDEN]
EMPTY = b""


def observed(body):
    """Return the agent's value in an answer of the scene."""
    import struct

    assert body[:4] == bytes.fromhex("0a060a04")
    return struct.unpack("<f", body[4:8])[0]


SEE = {"agent": ["a"]}


# Framing ------------------------------------------------------------------------------------


def test_the_golden_exchanges(peer):
    for request, answer in zip(REQUESTS, ANSWERS, strict=True):
        peer.send(request)
        assert peer.read(len(answer)) == answer
    assert peer.received == b""


def test_golden_exchanges_in_one_segment(peer):
    peer.send(b"".join(REQUESTS))
    assert peer.read(sum(map(len, ANSWERS))) == b"".join(ANSWERS)


def test_golden_exchanges_byte_by_byte(peer):
    for request, answer in zip(REQUESTS, ANSWERS, strict=True):
        for byte in request:
            assert peer.received == b""
            peer.send(bytes([byte]))
            peer.arrive()
        assert peer.read(len(answer)) == answer


def test_a_request_split_at_every_byte(peer):
    for request, answer in zip(REQUESTS[:2] + REQUESTS[4:], ANSWERS[:2] + ANSWERS[4:], strict=True):
        for cut in range(1, len(request)):
            peer.send(request[:cut])
            peer.arrive()
            peer.send(request[cut:])
            assert peer.read(len(answer)) == answer


@pytest.mark.parametrize("cut", range(1, len(REQUESTS[2]) + len(REQUESTS[3])))
def test_two_requests_split_at_every_byte(peer, cut):
    peer.ask(json.loads(GOLDEN[1][1]))
    both = REQUESTS[2] + REQUESTS[3]
    peer.send(both[:cut])
    peer.arrive()
    peer.send(both[cut:])
    answers = ANSWERS[2] + ANSWERS[3]
    assert peer.read(len(answers)) == answers


def test_prefix_and_body_arrive_together(peer):
    peer.send(REQUESTS[2])
    while not peer.service.environment.calls:
        peer.service.poll(0.05)
    assert peer.socket.recv(4096) == ANSWERS[2]


def test_an_answer_of_megabytes(peer, scene):
    big = bytes(range(256)) * 20_000

    def get_data(request, storage):
        storage.frame = big

    scene.agent.get_data = get_data
    body = peer.ask({"observation": SEE})
    message = scene.messages.Message()
    message.ParseFromString(body)
    assert message.agent_data.frame == big


# What requests mean --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "request_",
    [{}, {"reset": 1}, {"action": [1]}, {"config": {}}, {"unknown": 1}, {"step": None}, b""],
)
def test_each_request_has_one_answer_empty_without_observation(peer, request_):
    assert peer.ask(request_) == EMPTY
    peer.arrive()
    assert peer.received == b""


def test_answers_come_in_the_order_of_requests(peer, message):
    requests = [{"reset": 1}] + [{"action": [1], "observation": SEE}] * 5 + [{"observation": SEE}]
    peer.send(b"".join(map(message, requests)))
    assert peer.answer() == EMPTY
    assert [observed(peer.answer()) for _ in range(6)] == [16, 32, 48, 64, 80, 80]


@pytest.mark.parametrize(
    ("keys", "called"),
    [
        (("action", "config", "reset"), ["reset"]),
        (("config", "reset"), ["reset"]),
        (("action", "reset"), ["reset"]),
        (("config", "action"), ["set_action"]),
        (("config",), ["agent.configure"]),
    ],
)
def test_reset_before_action_before_config_and_then_the_observation(peer, scene, keys, called):
    values = {"action": [1], "config": {"agent": 5}, "reset": 1, "observation": {"agent": 0}}
    peer.ask({key: values[key] for key in [*keys, "observation"]})
    assert [name for name, _ in scene.calls] == [*called, "agent.get_data", "after"]


@pytest.mark.parametrize("value", [0, None, False, "", [], {}, 1])
def test_that_reset_is_there_is_what_counts(peer, scene, value):
    peer.ask({"reset": value})
    assert scene.calls[0] == ("reset", value)


def test_an_action_of_null_steps(peer, scene):
    peer.ask({"action": None})
    assert scene.calls[0] == ("set_action", None)
    assert scene.agent.frames == 4


def test_a_part_that_is_asked_for_is_set_even_when_empty(peer, scene):
    scene.agent.get_data = scene.world.get_data = lambda request, storage: None
    assert peer.ask({"observation": {"agent": []}}) == bytes.fromhex("0a00")
    assert peer.ask({"observation": {"world": None}}) == bytes.fromhex("1200")
    assert peer.ask({"observation": {"agent": 1, "world": 1}}) == bytes.fromhex("0a001200")
    assert peer.ask({"observation": {"other": 1}}) == EMPTY


ANYTHING = [None, 0, 1.5, "text", "äöü €", [1, [2, [3, None]]], {"a": {"b": [True, "ß"]}}, 10**20]


@pytest.mark.parametrize("value", ANYTHING)
def test_values_reach_the_users_objects_unchanged(peer, scene, value):
    peer.ask({"config": {"agent": value, "world": value}})
    peer.ask({"action": value, "observation": {"agent": value, "world": value}})
    calls = [call for call in scene.calls if call[0] != "after"]
    names = ["agent.configure", "world.configure", "set_action", "agent.get_data", "world.get_data"]
    assert calls == [(name, value) for name in names]


def test_hooks_are_called_once_for_each_request(peer, scene):
    peer.ask({"action": [0.25], "observation": {"agent": 1, "world": 2}})
    names = [name for name, _ in scene.calls]
    assert names == ["set_action", "agent.get_data", "world.get_data", "after"]
    scene.calls.clear()
    peer.ask({})
    assert scene.calls == [("after", None)]


# Steps --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 4, 10])
def test_exactly_so_many_physics_frames(peer, scene, count):
    peer.ask({"config": {"environment": {"repeat_action": count}}})
    for number in (1, 2):
        peer.ask({"action": [1]})
        assert scene.agent.frames == number * count
    assert len([name for name, _ in scene.calls if name == "set_action"]) == 2


def test_an_action_lasts_four_frames_and_a_change_counts_from_the_next(peer, scene):
    peer.ask({"action": [1]})
    assert scene.agent.frames == 4
    peer.ask({"action": [1], "config": {"environment": {"repeat_action": 7}}})
    assert scene.agent.frames == 8
    peer.ask({"config": {"environment": {"repeat_action": 3.0}}})
    assert scene.agent.frames == 8
    peer.ask({"action": [1]})
    assert scene.agent.frames == 11


def test_nothing_moves_between_requests(peer, scene):
    peer.service.poll(0.05)
    assert scene.agent.frames == 0
    before = peer.ask({"action": [0.3], "observation": SEE})
    for _ in range(3):
        peer.service.poll(0.02)
    assert scene.agent.frames == 4
    assert peer.ask({"observation": SEE}) == before
    assert peer.ask({"observation": SEE}) == before


def test_the_pace_changes_no_state(start, scene_class, peer_class):
    seen = []
    for speed in (None, 20.0, 1000):
        service = start(scene_class())
        peer = peer_class(service.address, service)
        peer.ask({"config": {"environment": {"time_speed": speed}}})
        actions = ([0.1 * number] for number in range(5))
        seen.append([peer.ask({"action": a, "observation": SEE}) for a in actions])
        assert service.environment.agent.frames == 20
        peer.leave()
    assert seen[0] == seen[1] == seen[2]


def test_a_paced_step_keeps_nobody_waiting(peer, scene, peer_class):
    communication = scene.communication
    peer.ask({"config": {"environment": {"time_speed": 1e-4}}})
    peer.send(b"".join([(13).to_bytes(4, "little"), b'{"action": 1}']))
    called = []
    communication.after(0.0, lambda: called.append(1))
    while not called or not communication.message_processing:
        peer.service.poll(0.05)
    other = peer_class(peer.service.address)
    while len(communication.connections) < 2:
        peer.service.poll(0.05)
    assert communication.message_processing
    assert scene.agent.frames == 1
    other.leave()


def test_the_first_version_of_the_protocol(start, scene, peer_class):
    service = start(scene, reply="observation-only", request_framing="bare-json")
    peer = peer_class(service.address, service)
    text = '{"config": {"environment": {"repeat_action": 2}}} {"reset": "}{\\"\\\\"}'
    text += '\n{"action": [0.5], "observation": {"agent": []}}{"observation": {}}'
    answers = ANSWERS[3] + bytes(4)
    peer.send(text.encode())
    assert peer.read(len(answers)) == answers
    assert ("reset", '}{"\\') in scene.calls
    for byte in text.encode():
        peer.send(bytes([byte]))
        peer.arrive()
    assert peer.read(len(answers)) == answers
    peer.arrive()
    assert peer.received == b""
    peer.send(b"[1]")
    assert peer.read(1) == b""
    service = peer_class(service.address, service)
    service.leave()


def test_only_observations_are_answered_where_the_document_says_so(start, scene, peer_class):
    service = start(scene, reply="observation-only")
    peer = peer_class(service.address, service)
    peer.send(b"".join(REQUESTS))
    answers = b"".join(ANSWERS[2:])
    assert peer.read(len(answers)) == answers
    peer.leave()


# The original client -----------------------------------------------------------------------


def test_a_client_that_waits_for_each_answer(in_thread, scene, original_client):
    service = in_thread(scene)
    client = original_client(scene.messages, service.address)
    client.configure({"environment": {"repeat_action": 1}})
    client.reset({"agent": [], "world": []})
    for number in range(1, 4):
        data = client.step([1.0], {"agent": ["a"], "world": ["done"]})
        assert list(data["agent"].a) == [4.0 * number]
        assert data["world"].done
    client.socket.close()


def test_many_floats_and_a_flag(in_thread, scene_class, original_client):
    from physx_core import Field
    from physx_remote import Messages
    from physx_remote.godot_gym.messages import fill

    class Seeker(scene_class):
        def _ready(self):
            super()._ready()
            rays = [Field("distances", (16,), "float32"), Field("kinds", (40,), "float32")]
            self.messages = Messages.of_fields(agent=rays, world=[("found", bool)])
            self.agent.get_data = lambda request, storage: fill(
                storage, distances=[0.5] * 16, kinds=[float(n) for n in range(40)]
            )
            self.world.get_data = lambda request, storage: fill(storage, found=True)

    service = in_thread(Seeker())
    client = original_client(service.environment.messages, service.address)
    for _ in range(50):
        data = client.step({"move": [0, 1]}, {"agent": ["distances"], "world": ["found"]})
        assert list(data["agent"].kinds) == list(range(40))
        assert data["world"].found
    client.socket.close()
