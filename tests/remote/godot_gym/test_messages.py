"""Messages of a user's own that hold messages and maps: written by `fill`, read by the clients."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from physx_core.errors import ConfigError
from physx_remote import GodotGymClient, RLAgent, RLEnvironment, RLEnvWorld, fill

# What protoc makes of:
#
#   message Point { float x = 1; float y = 2; }
#   message Wheel { Point at = 1; repeated float load = 2; Wheel spare = 3; }
#   message Camera { repeated bytes frames = 1; int32 width = 2; }
#   message AgentData {
#     Point position = 1;
#     repeated Wheel wheels = 2;
#     map<string, Camera> cameras = 3;
#     map<int32, double> distances = 4;
#     map<string, bytes> masks = 5;
#     repeated string names = 6;
#     Wheel steering = 7;
#   }
#   message WorldData { bool crashed = 1; }
#   message Message { AgentData agent_data = 1; WorldData world_data = 2; }
MAP = "map"
MESSAGES = {
    "Point": [("float", "x"), ("float", "y")],
    "Wheel": [("Point", "at"), ("float*", "load"), ("Wheel", "spare")],
    "Camera": [("bytes*", "frames"), ("int32", "width")],
    "AgentData": [
        ("Point", "position"),
        ("Wheel*", "wheels"),
        ((MAP, "string", "Camera"), "cameras"),
        ((MAP, "int32", "double"), "distances"),
        ((MAP, "string", "bytes"), "masks"),
        ("string*", "names"),
        ("Wheel", "steering"),
    ],
    "WorldData": [("bool", "crashed")],
    "Message": [("AgentData", "agent_data"), ("WorldData", "world_data")],
}


def generate():
    """Return the class `Message`."""
    kinds = descriptor_pb2.FieldDescriptorProto

    def add(message, kind, name):
        repeated = kind.endswith("*")
        kind = kind.removesuffix("*")
        field = message.field.add(name=name, number=len(message.field) + 1, label=1 + 2 * repeated)
        if kind in MESSAGES or "." in kind:
            field.type, field.type_name = kinds.TYPE_MESSAGE, f".car.{kind}"
        else:
            field.type = kinds.Type.Value(f"TYPE_{kind.upper()}")

    file = descriptor_pb2.FileDescriptorProto(name="car.proto", package="car", syntax="proto3")
    for title, fields in MESSAGES.items():
        message = file.message_type.add(name=title)
        for kind, name in fields:
            if kind[0] == MAP:
                entry = message.nested_type.add(name=f"{name.capitalize()}Entry")
                entry.options.map_entry = True
                add(entry, kind[1], "key")
                add(entry, kind[2], "value")
                kind = f"{title}.{entry.name}*"
            add(message, kind, name)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("car.Message"))


Message = generate()
FRAME = np.array([[0, 200], [7, 0]], np.uint8)
DATA = {
    "position": {"x": 1.5, "y": -2.0},
    "wheels": [
        {"at": {"x": 1.0, "y": 0.0}, "load": [1.0, 2.0]},
        {"load": [], "spare": {"load": [3.0], "at": {"x": 0.0, "y": 0.5}}},
    ],
    "cameras": {"front": {"frames": [FRAME, b"\0\0"], "width": 2}, "rear": {"width": 3}},
    "distances": {3: np.float32(0.5), -1: 2},
    "masks": {"left": FRAME[0], "right": b"\1\0"},
    "names": ["a", "b"],
}
READ = {
    **DATA,
    "wheels": [
        {"at": {"x": 1.0, "y": 0.0}, "load": [1.0, 2.0]},
        {"load": [], "spare": {"load": [3.0], "at": {"x": 0.0, "y": 0.5}}},
    ],
    "cameras": {
        "front": {"frames": [FRAME.tobytes(), b"\0\0"], "width": 2},
        "rear": {"frames": [], "width": 3},
    },
    "distances": {3: 0.5, -1: 2.0},
    "masks": {"left": b"\0\xc8", "right": b"\1\0"},
}


class Car(RLAgent):
    def get_data(self, request, storage):
        fill(storage, **DATA)


class Road(RLEnvWorld):
    def get_data(self, request, storage):
        fill(storage, crashed=True)


class Drive(RLEnvironment):
    def _ready(self):
        self.agent, self.world, self.messages = Car(), Road(), Message


def test_messages_and_maps_travel_as_dictionaries_and_lists(in_thread):
    service = in_thread(Drive())
    with GodotGymClient(Message, service.address) as client:
        answer = client.request({"observation": {"agent": [], "world": []}})
    np.testing.assert_equal(answer, {"agent": READ, "world": {"crashed": True}})
    assert answer["agent"]["wheels"][0]["load"].dtype == np.float32


def test_what_a_field_held_before_is_replaced():
    message = Message().agent_data
    for _ in range(2):
        fill(message, **DATA)
    assert len(message.wheels) == len(message.cameras) == 2
    fill(message, position={"y": 1}, wheels=[], cameras={}, names=("c",))
    assert (message.position.x, message.position.y, [*message.names]) == (0.0, 1.0, ["c"])
    assert not message.wheels and not message.cameras
    fill(message, position={}, steering={})
    assert message.HasField("position") and message.HasField("steering")
    for numbers in ([1.0, 2.0], np.ones(2), np.ones(40), [3.0, np.float32(4.0)]):
        for _ in range(3):
            fill(message.steering, load=numbers)
            assert [*message.steering.load] == [*numbers]


def test_messages_may_stand_for_dictionaries():
    data = Message().agent_data
    wheel = type(data.steering)(load=[4.0])
    fill(data, steering=wheel, wheels=[wheel, {"load": [5.0]}], cameras={"top": data.cameras["x"]})
    assert data.steering.load == data.wheels[0].load == [4.0]
    assert [*data.cameras] == ["top"]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"speed": 1.0}, r'AgentData has no field "speed"\. It has: position, wheels'),
        ({"position": {"z": 1.0}}, r'The message Point has no field "z"\. It has: x, y'),
        ({"wheels": [{"at": {"x": "far"}}]}, "The field \"x\" of Point does not accept 'far'"),
        ({"cameras": {"front": {"size": 1}}}, 'The message Camera has no field "size"'),
        ({"position": 1.0}, 'The field "position" of AgentData does not accept 1.0'),
        ({"position": [1.0, 2.0]}, 'The field "position" of AgentData does not accept'),
        ({"wheels": {"at": {}}}, "a repeated field takes a list"),
        ({"wheels": [1.0]}, 'The field "wheels" of AgentData does not accept'),
        ({"cameras": [{"width": 1}]}, "a map takes a dictionary"),
        ({"cameras": {5: {}}}, 'The field "cameras" of AgentData does not accept'),
        ({"distances": {"a": 1.0}}, 'The field "distances" of AgentData does not accept'),
        ({"names": "ab"}, "a repeated field takes a list"),
        ({"names": [1]}, 'The field "names" of AgentData does not accept'),
        ({"position": {1: 2}}, 'The message Point has no field "1"'),
    ],
)
def test_what_a_field_does_not_take_is_named(values, said):
    with pytest.raises(ConfigError, match=said):
        fill(Message().agent_data, **values)
