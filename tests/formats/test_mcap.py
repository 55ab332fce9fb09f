"""Recordings of robots: states of joints are imported as they were, or what is wrong is named."""

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from recorded import states, write_json, write_ros2

from physx_core import Dataset
from physx_formats import ExchangeError, import_file

JOINTS = ("b", "a/left")
TIMES = 0.01 * np.arange(20)
Q, V, TAU = np.random.default_rng(0).normal(size=(3, 20, 2))


def columns(path, folder):
    import_file(path, folder)
    with Dataset.open(folder) as dataset:
        return {name: dataset["training"][name][:] for name in dataset.fields("training")}


def check(found, topic="joint_states"):
    assert_array_equal(found[f"{topic}_position_b"], Q[:, 0])
    assert_array_equal(found[f"{topic}_position_a_left"], Q[:, 1])
    assert_array_equal(found[f"{topic}_velocity_b"], V[:, 0])
    assert_array_equal(found[f"{topic}_effort_a_left"], TAU[:, 1])
    assert_allclose(found[f"{topic}_time"], TIMES, atol=1e-9)
    assert_allclose(found[f"{topic}_log_time"], TIMES + np.arange(20) % 3 * 1e-5, atol=1e-9)


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none", "without index"])
def test_states_of_joints_come_back_as_they_were(tmp_path, kind):
    messages = states(JOINTS, TIMES, Q, TAU, V)
    messages[7][1].update(name=["a/left", "b"])  # another order
    for numbers in ("position", "velocity", "effort"):
        messages[7][1][numbers].reverse()
    topics = {"/joint_states": messages, "/chatter": [(time, "hello") for time, _ in messages]}
    types = pytest.importorskip("mcap.writer").CompressionType
    packed = types[kind.upper()] if kind in ("zstd", "lz4") else types.NONE
    path = write_ros2(tmp_path / "a.mcap", topics, chunk_size=500, compression=packed)
    if kind == "without index":
        path = without_index(path, tmp_path / "b.mcap")
    check(columns(path, tmp_path / "rows"))


def without_index(path, to):
    """Copy the messages to a file that has nothing but them."""
    reader, writer = pytest.importorskip("mcap.reader"), pytest.importorskip("mcap.writer")
    index = writer.IndexType.NONE
    with path.open("rb") as file, to.open("wb") as out:
        copy = writer.Writer(
            out, index_types=index, repeat_channels=False, repeat_schemas=False,
            use_statistics=False, use_summary_offsets=False, use_chunking=False,
        )  # fmt: skip
        copy.start()
        schemas, channels = {}, {}
        for schema, channel, message in reader.make_reader(file).iter_messages():
            if schema.id not in schemas:
                schemas[schema.id] = copy.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                own = schemas[schema.id]
                channels[channel.id] = copy.register_channel(channel.topic, "cdr", own)
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            copy.add_message(channels[channel.id], data=message.data, **times)
        copy.finish()
    return to


def test_json_and_the_folder_of_a_split_recording(tmp_path):
    messages = states(JOINTS, TIMES, Q, TAU, V)
    (tmp_path / "run").mkdir()
    write_json(tmp_path / "run" / "run_0.mcap", "/joint_states", messages[:12])
    write_ros2(tmp_path / "run" / "run_1.mcap", {"/joint_states": messages[12:]})
    check(columns(tmp_path / "run", tmp_path / "rows"))


def test_publishers_of_one_topic_are_tables_of_their_own(tmp_path):
    arm = states(JOINTS, TIMES, Q, TAU, V)
    hand = states(["hand"], TIMES[::2] + 0.005, Q[::2, :1], stamped=False)
    path = write_ros2(tmp_path / "a.mcap", {"/joint_states": arm + hand})
    with pytest.raises(ExchangeError, match="different numbers of rows"):
        import_file(path, tmp_path / "rows")
    names = ["joint_states/2/time", "joint_states/2/position.hand"]
    import_file(path, tmp_path / "rows", fields=names)
    with Dataset.open(tmp_path / "rows") as dataset:
        time = dataset["training"]["joint_states_2_time"][:]
    assert_allclose(time - time[0], TIMES[::2] + (np.arange(10) % 3 - 0) * 1e-5, atol=1e-9)


def test_what_cannot_be_read_is_named(tmp_path):
    messages = states(JOINTS, TIMES, Q, TAU, V)
    short = states(JOINTS, TIMES, Q)
    same = states(("b", "b"), TIMES, Q)
    long = states(("b",), TIMES, Q)
    text = [(time, "hello") for time, _ in messages]
    bad = {
        r"no message.*/chatter \(std_msgs/msg/String\)": write_ros2(
            tmp_path / "0.mcap", {"/chatter": text}
        ),
        "20 of 40 messages have no velocity": write_ros2(
            tmp_path / "1.mcap", {"/joint_states": messages + short}
        ),
        "same name": write_ros2(tmp_path / "2.mcap", {"/joint_states": same}),
        "numbers than joints": write_ros2(tmp_path / "3.mcap", {"/joint_states": long}),
        "encoded as protobuf": write_json(tmp_path / "4.mcap", "/q", messages, "protobuf"),
        "damaged": write_json(tmp_path / "5.mcap", "/q", [(0, {"name": ["b"]})]),
    }
    for message, path in bad.items():
        with pytest.raises(ExchangeError, match=message):
            import_file(path, tmp_path / "rows")


def test_a_recording_unpacks_to_no_more_than_is_allowed(tmp_path):
    state = states(JOINTS, TIMES, Q)
    topics = {"/joint_states": state, "/chatter": [(state[0][0], 10**6 * "no")]}
    path = write_ros2(tmp_path / "a.mcap", topics)
    with pytest.raises(ExchangeError, match="claims that it holds"):
        import_file(path, tmp_path / "rows", max_bytes=10**6)
    import_file(path, tmp_path / "rows", max_bytes=3 * 10**6)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    return write_ros2(path, {"/joint_states": states(JOINTS, TIMES, Q, TAU, V)}).read_bytes()


@settings(max_examples=60)
@given(share=st.floats(0, 1, exclude_max=True), flip=st.integers(0, 255))
def test_a_damaged_recording_is_named_or_read_as_it_was(whole, tmp_path_factory, share, flip):
    folder = tmp_path_factory.mktemp("damaged")
    place = max(8, int(share * len(whole)))
    damaged = bytearray(whole if flip else whole[:place])
    damaged[place : place + 1] = [damaged[place] ^ flip] if flip else []
    (folder / "a.mcap").write_bytes(damaged)
    try:
        found = columns(folder / "a.mcap", folder / "rows")
    except ExchangeError:
        return
    assert flip  # a truncated one is never taken for whole
    with contextlib.suppress(KeyError):  # a topic or joint of another name
        check(found)
