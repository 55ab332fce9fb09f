"""The protocol godot-rl where something goes wrong: messages, environments, trainers."""

from __future__ import annotations

import json
import logging
import socket
import struct

import pytest

from physx_core.errors import ConfigError, UnknownOptionError
from physx_remote import Worlds
from physx_remote.errors import RemoteError
from physx_remote.godot_rl.protocol import GodotRL

ACTION = {"force": [0.0, -1.0], "gear": 1}


def framed(message):
    body = json.dumps(message).encode()
    return struct.pack("<I", len(body)) + body


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "not valid JSON"),
        (b"{", "not valid JSON"),
        (b"\xff\xfe", "not valid JSON"),
        (b"[" * 100_000, "not valid JSON"),
        (b"[1]", "JSON object"),
        (b"null", "JSON object"),
        (b"{}", "JSON object"),
        (b'{"type": 3}', "JSON object"),
        (b'{"type": "acton"}', 'Unknown message type "acton"'),
        (b'{"type": "action"}', "list of 1 actions"),
        (b'{"type": "action", "action": null}', "list of 1 actions"),
        (b'{"type": "action", "action": []}', "list of 1 actions"),
        (b'{"type": "action", "action": [{}, {}]}', "list of 1 actions, one per agent, not 2"),
        (b'{"type": "action", "action": [3]}', "entries force, gear"),
        (b'{"type": "action", "action": [{}]}', "entries force, gear"),
        (b'{"type": "action", "action": [{"force": [0, 0]}]}', "entries force, gear"),
        (b'{"type": "action", "action": [{"force": [0], "gear": 0}]}', "list of 2 numbers"),
        (b'{"type": "action", "action": [{"force": 0, "gear": 0}]}', "list of 2 numbers"),
        (b'{"type": "action", "action": [{"force": [0, NaN], "gear": 0}]}', '"force"[1] is nan'),
        (
            b'{"type": "action", "action": [{"force": [0, 1e999], "gear": 0}]}',
            "not a finite number",
        ),
        (
            b'{"type": "action", "action": [{"force": [0, 1%s], "gear": 0}]}' % (b"0" * 400),
            "not a finite",
        ),
        (b'{"type": "action", "action": [{"force": [0, "1"], "gear": 0}]}', "not a finite number"),
        (b'{"type": "action", "action": [{"force": [0, true], "gear": 0}]}', "not a finite number"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": 3}]}', "from 0 to 2"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": -1}]}', "from 0 to 2"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": 1.5}]}', "from 0 to 2"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": true}]}', "from 0 to 2"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": NaN}]}', "from 0 to 2"),
        (b'{"type": "action", "action": [{"force": [0, 0], "gear": [1]}]}', "from 0 to 2"),
        (b'{"type": "reset", "seed": -1}', "non-negative integer"),
    ],
)
def test_a_wrong_message_is_answered_moves_nothing_and_the_next_is_served(
    trainer, caplog, body, said
):
    one = trainer()
    one.ask({"type": "reset"})
    answer = one.ask(body)
    assert answer["type"] == "error"
    assert said in answer["message"]
    assert said in caplog.text
    assert one.ask({"type": "call", "method": "who"})["returns"][0]["steps"] == 0
    assert one.ask({"type": "action", "action": [ACTION]})["obs"][0]["level"] == 1


def test_one_wrong_action_among_several_moves_no_agent(trainer):
    one = trainer(num=3)
    one.ask({"type": "reset"})
    answer = one.ask({"type": "action", "action": [ACTION, ACTION, {**ACTION, "gear": 7}]})
    assert answer["message"].startswith("Agent 2: ")
    returns = one.ask({"type": "call", "method": "who"})["returns"]
    assert [told["steps"] for told in returns] == [0, 0, 0]


def test_an_error_of_the_environment_is_told_and_all_agents_begin_anew(trainer, cart, caplog):
    one = trainer(Worlds([cart(), cart(fails_at=2)]))
    one.ask({"type": "reset"})
    one.ask({"type": "action", "action": [ACTION] * 2})
    answer = one.ask({"type": "action", "action": [ACTION] * 2})
    assert answer == {
        "type": "error",
        "error": "ArithmeticError",
        "message": "the cart fell over; in the world of agent 1",
    }
    assert "in step" in caplog.text, "the traceback is in the log"
    moved = one.ask({"type": "action", "action": [ACTION] * 2})
    assert [seen["level"] for seen in moved["obs"]] == [1, 1]


def test_message_length_beyond_limit_ends_service(trainer, caplog):
    one = trainer()
    one.socket.sendall(struct.pack("<I", 1 << 30))
    with pytest.raises(RemoteError, match=f"The trainer at .* is lost: .*{1 << 30}"):
        one.service_ends()
    assert one.service_ends()
    assert str(1 << 30) in caplog.text


def abort(connection):
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


STATES = {
    "connected": b"",
    "in a prefix": b"\x10\x00",
    "in a body": struct.pack("<I", 50) + b'{"type": ',
    "after a request": framed({"type": "env_info"}),
    "in a step": framed({"type": "action", "action": [ACTION] * 2}),
    "in several steps": framed({"type": "action", "action": [ACTION] * 2}) * 5,
}


@pytest.mark.parametrize("end", [socket.socket.close, abort], ids=["closes", "dies"])
@pytest.mark.parametrize("state", STATES)
def test_the_service_ends_with_its_trainer(trainer, cart, state, end):
    carts = [cart(), cart()]
    one = trainer(Worlds(carts), options={"action_repeat": 3})
    one.socket.sendall(STATES[state])
    end(one.socket)
    assert one.service_ends()
    assert not one.service.poll()
    one.service.close()
    assert [cart.closed for cart in carts] == [1, 1]


def test_trainer_crash_during_step(trainer, cart):
    class Slow(cart):
        def step(self, action):
            if self.steps == 1:
                abort(one.socket)
            return super().step(action)

    one = trainer(Worlds([Slow(), Slow()]), options={"action_repeat": 5})
    one.send({"type": "action", "action": [ACTION] * 2})
    assert one.service_ends()


def test_a_service_may_be_closed_within_a_step(trainer, cart):
    class Last(cart):
        def step(self, action):
            one.service.close()
            assert not self.closed, "an environment is not closed under its own step"
            return super().step(action)

    last = Last()
    one = trainer(Worlds([last]))
    one.send({"type": "action", "action": [ACTION]})
    assert one.service_ends()
    assert (last.steps, last.closed) == (1, 1)


def test_without_a_trainer_the_error_says_what_to_do(cart):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(RemoteError, match=f"No godot-rl trainer.*{port}.*0.2 s.*start the trainer"):
        GodotRL(timeout=0.2).service(Worlds([cart()]), port=port)


def test_an_address_that_does_not_exist(cart):
    with pytest.raises(RemoteError, match="is not a valid address"):
        GodotRL(timeout=5).service(Worlds([cart()]), address="no such host", port=3)


@pytest.mark.parametrize(
    "options",
    [
        {"action_repeat": 0},
        {"action_repeat": 1.5},
        {"seed": -1},
        {"timeout": None},
        {"timeout": -1},
    ],
)
def test_options_are_checked(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        GodotRL(**options)


def test_an_unknown_option_is_named():
    with pytest.raises(UnknownOptionError, match='Did you mean "action_repeat"'):
        GodotRL(action_repeats=3)


def test_only_worlds_are_served():
    with pytest.raises(RemoteError, match="object"):
        GodotRL().service(object(), port=1)


def test_log_is_silent_where_all_is_well(trainer, caplog):
    with caplog.at_level(logging.WARNING):
        one = trainer()
        one.ask({"type": "reset"})
        one.socket.close()
        assert one.service_ends()
    assert not caplog.records
