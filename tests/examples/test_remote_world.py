"""The room of the example: what the robot sees, finds, and is told."""

import numpy as np
import pytest

pytest.importorskip("physx_dart", reason="the room runs on DART")


@pytest.fixture
def room(root, monkeypatch):
    """The opened environment, with the robot south-west of the pillar, heading east."""
    monkeypatch.syspath_prepend(str(root / "examples"))
    from environments.room import AppleSeeker

    with AppleSeeker() as room:
        room._reset()
        positions = room.begin.copy()
        positions[:7] = -2.0, 0.0, positions[2], 0.0, 0.0, 0.0, 1.0
        room.simulation.set_state(positions, np.zeros(room.simulation.layout.nv))
        yield room


def told(room, part):
    """Return what the agent or the world tells, by name."""
    message = getattr(room.messages.Message(), f"{part}_data")
    getattr(room, part).get_data(None, message)
    return {
        field.name: np.array(getattr(message, field.name)) for field in message.DESCRIPTOR.fields
    }


def test_walls_hide_apples(room):
    room.world.apples = np.array([[2.0, 0.0], [-1.0, 0.0], [-2.0, 2.0], [-2.0, 2.5], [2.5, 2.5]])
    seen = told(room, "agent")
    assert seen["obstacles"][0] == pytest.approx(1.7, abs=0.01), "the pillar"
    assert seen["obstacles"][4] == pytest.approx(2.95, abs=0.01), "the northern wall"
    assert seen["apples"][0] == pytest.approx(1.0), "the other one is behind the pillar"
    assert seen["apples"][4] == pytest.approx(2.0), "the nearer one"
    room.world.eaten[[1, 2]] = True
    seen = told(room, "agent")
    assert seen["apples"][0] == 6.0 and seen["apples"][4] == pytest.approx(2.5)


def test_an_apple_is_found_once_and_the_last_one_ends_the_episode(room):
    room.world.apples = np.array([[1.0, 0.0], [1.0, 1.0], [1.3, 0.0], [2.0, 2.0], [2.0, -2.0]])
    room.world.eat(np.array([1.1, 0.1]))
    outcome = told(room, "world")
    assert outcome["reward"] == 2.0 and not outcome["terminated"]
    room.world.eat(np.array([1.1, 0.1]))
    assert told(room, "world")["reward"] == 0.0
    for place in room.world.apples:
        room.world.eat(place)
    assert told(room, "world")["terminated"]


def test_both_wheels_drive_the_robot_ahead(room):
    before, _ = room.agent.pose()
    room.agent.set_action([1.0, 1.0])
    room.simulation.step(120)
    after, heading = room.agent.pose()
    assert after[0] - before[0] > 0.2 and abs(heading) < 0.1
