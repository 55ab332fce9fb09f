"""Recordings of joints as ROS 2 makes them: MCAP files, written by the library's own writer."""

import json

import pytest

STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
BEGIN = 1_700_000_000 * 10**9
KIND = "sensor_msgs/msg/JointState"


def states(joints, times, positions, torques=(), velocities=(), stamped=True):
    """Return messages and the times at which they were logged, in ns."""
    found = []
    for row, time in enumerate(times):
        stamp = BEGIN + round(time * 1e9) if stamped else 0
        own = [each[row] if len(each) else [] for each in (positions, velocities, torques)]
        numbers = {
            kind: [float(number) for number in each]
            for kind, each in zip(("position", "velocity", "effort"), own, strict=True)
        }
        header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
        message = {"header": header, "name": list(joints), **numbers}
        found.append((BEGIN + round(time * 1e9) + 2_000_000 + row % 3 * 10_000, message))
    return found


def write_ros2(path, topics, **options):
    """Write messages by topic; each is text if it is no state of joints."""
    pytest.importorskip("mcap")
    writer = pytest.importorskip("mcap_ros2.writer")
    with path.open("wb") as file, writer.Writer(file, **options) as recording:
        known = {
            "state": recording.register_msgdef(KIND, STATE),
            "text": recording.register_msgdef("std_msgs/msg/String", "string data"),
        }
        rows = [(time, topic, each) for topic, own in topics.items() for time, each in own]
        for time, topic, message in sorted(rows, key=lambda row: row[0]):
            schema = known["text" if isinstance(message, str) else "state"]
            message = {"data": message} if isinstance(message, str) else message
            recording.write_message(topic, schema, message, log_time=time)
    return path


def write_json(path, topic, messages, encoding="json", **options):
    """Write messages of one topic as JSON, or what says that it is of another encoding."""
    writer = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        recording = writer.Writer(file, **options)
        recording.start()
        schema = recording.register_schema(KIND, "jsonschema", b'{"type": "object"}')
        channel = recording.register_channel(topic, encoding, schema)
        for time, message in messages:
            data = json.dumps(message).encode()
            recording.add_message(channel, log_time=time, publish_time=time, data=data)
        recording.finish()
    return path
