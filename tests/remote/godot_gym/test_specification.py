"""Every line of the specification's page on RLEnvironment, over a real socket where it has one."""

from __future__ import annotations

import itertools
import threading

import pytest

from physx_remote import (
    Communication,
    PhysicsFramesTimer,
    RLAgent,
    RLEnvironment,
    RLEnvWorld,
)

LIVES = {"observation": {"world": []}}
ALIVE = bytes.fromhex("120d080110ffffffffffffffffff01")


def test_constants():
    names = ("CONFIG", "RESET", "ACTION", "OBSERVATION", "WORLD", "AGENT", "ENVIRONMENT")
    for name in names:
        assert getattr(RLEnvironment, f"{name}_KEY") == name.lower()


def test_properties_of_a_new_environment():
    environment = RLEnvironment()
    assert environment.agent is None
    assert environment.world is None
    assert isinstance(environment.communication, Communication)
    assert isinstance(environment.physics_frames_timer, PhysicsFramesTimer)
    assert environment.repeat_action == 4
    environment.close()


def test_launching_disables_physics_before_it_gets_ready(scene_class):
    class Launched(scene_class):
        def _ready(self):
            super()._ready()
            self.paused_when_ready = self.paused

    environment = Launched()
    environment.paused = False
    with environment:
        assert environment.paused_when_ready
        assert environment.paused


def test_agent_and_world_are_given_and_the_server_started_in_ready(scene_class, peer_class):
    """The page's example: world, agent, and communication.start_server(port, address)."""

    class Example(scene_class):
        def _ready(self):
            super()._ready()
            assert isinstance(self.agent, RLAgent)
            assert isinstance(self.world, RLEnvWorld)
            self.communication.start_server(0, "127.0.0.1")

    environment = Example()
    environment.open()
    thread = threading.Thread(target=environment.run)
    thread.start()
    peer = peer_class(environment.communication.address)
    assert peer.ask(LIVES) == ALIVE
    environment.close()
    thread.join(60)
    assert not thread.is_alive()
    peer.leave()


def test_process_looks_for_requests_and_nothing_else_does(peer, scene, message):
    peer.send(message(LIVES))
    assert peer.there() is None
    while (answer := peer.there()) is None:
        assert scene._process(0.05)
    assert answer[4:] == ALIVE


def test_physics_process_counts_frames():
    environment = RLEnvironment()
    timer, ends = environment.physics_frames_timer, []
    timer.timer_end.connect(lambda: ends.append(1))
    environment._physics_process(1 / 60)
    assert not timer.is_started
    assert timer.start() is timer
    for count in range(5):
        assert timer.is_started
        assert ends == [], f"{count} frames have passed"
        environment._physics_process(1 / 60)
    assert not timer.is_started
    assert ends == [1]
    timer.set_limit(0)
    timer.start().step()
    assert ends == [1, 1]
    environment.close()


def test_physics_runs_in_a_step_alone(peer, scene):
    seen = []
    frame = scene.agent._physics_process
    scene.agent._physics_process = lambda delta: (seen.append((scene.paused, delta)), frame(delta))
    peer.ask({"reset": 1, **LIVES})
    peer.ask({"config": {}})
    assert seen == []
    peer.ask({"action": [1]})
    assert seen == [(False, 1 / 60)] * 4
    assert scene.paused


def test_reset_as_in_the_example(peer, scene):
    def reset():
        scene.world.reset()
        scene.agent.reset(scene.world.sample_initial_position())

    told = []
    scene._reset = reset
    scene.world.reset = lambda arguments=None: told.append(("world", arguments))
    scene.world.sample_initial_position = lambda: [1.5, 2]
    scene.agent.reset = lambda arguments=None: told.append(("agent", arguments))
    peer.ask({"reset": 1})
    assert told == [("world", None), ("agent", [1.5, 2])]


KEYS = ("reset", "action", "config", "observation")
ACTS = {"reset": "reset", "action": "set_action", "config": "agent.configure"}


@pytest.mark.parametrize(
    "keys",
    [keys for size in range(5) for keys in itertools.combinations(KEYS, size)],
    ids=lambda keys: "+".join(keys) or "none",
)
def test_any_combination_of_keys_is_one_request_with_one_answer(peer, scene, keys):
    values = {"reset": 1, "action": [0], "config": {"agent": 1}, "observation": {"world": []}}
    answer = peer.ask({key: values[key] for key in keys})
    assert answer == (ALIVE if "observation" in keys else b"")
    acts = [ACTS[key] for key in keys if key in ACTS][:1]
    looks = ["world.get_data"] * ("observation" in keys)
    assert [name for name, _ in scene.calls] == [*acts, *looks, "after"]
    peer.arrive()
    assert peer.received == b""


def test_the_signal_hands_over_the_request_as_a_dictionary(peer, scene):
    requests = []

    def look(request):
        requests.append((request, scene.communication.message_processing))

    scene.communication.got_connection.connect(look)
    peer.ask({"action": [0], "other": {"ä": None}})
    assert requests == [({"action": [0], "other": {"ä": None}}, True)]
    assert not scene.communication.message_processing
    scene.communication.got_connection.disconnect(look)
    peer.ask({})
    assert len(requests) == 1


def test_a_response_is_gathered_from_world_and_agent(peer, scene):
    both = bytes.fromhex("0a060a0400000000") + ALIVE
    assert peer.ask({"observation": {"world": 1, "agent": 2}}) == both
    assert scene.calls[:2] == [("agent.get_data", 2), ("world.get_data", 1)]


def test_after_send_response_comes_after_the_answer_was_sent(peer, scene, message):
    sent = []
    scene._after_send_response = lambda: sent.append(peer.socket.recv(100))
    peer.send(message(LIVES))
    while not sent:
        peer.service.poll(0.05)
    assert sent == [b"\x0f\0\0\0" + ALIVE]


def test_configuration_of_agent_world_and_environment(peer, scene):
    config = {"agent": {"a": [1]}, "world": "w", "environment": {"repeat_action": 7}}
    assert peer.ask({"config": config}) == b""
    assert scene.repeat_action == 7
    calls = [call for call in scene.calls if call[0] != "after"]
    assert calls == [("agent.configure", {"a": [1]}), ("world.configure", "w")]
    peer.ask({"config": {"environment": {"time_speed": 1e6}}})
    assert (scene.repeat_action, scene.time_speed) == (7, 1e6)
    peer.ask({"action": [1]})
    assert scene.agent.frames == 7
