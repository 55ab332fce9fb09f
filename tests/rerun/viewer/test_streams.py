"""What viewers that die or hang, and processes that are killed, leave behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import textwrap
import time

import numpy as np
import pytest
import rerun as rr

from physx_core.components import Factory
from physx_rerun.drawing.chunks import ChunkBuilder
from physx_rerun.viewer.streams import LiveWriter
from physx_rerun.viewer.viewer import Viewer, find_free_port

pytestmark = pytest.mark.processes


def steps_of(path, entity="/env_1/error"):
    steps = []
    for chunk in rr.chunk.RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            steps += batch.column("step").to_pylist()
    return sorted(steps)


def wait_for_steps(path, is_enough):
    """Wait until a receiver, which writes its file behind what it has taken, has these steps."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with contextlib.suppress(FileNotFoundError, ValueError, RuntimeError):  # being written
            steps = steps_of(path)
            if is_enough(steps):
                return steps
        time.sleep(0.05)
    raise TimeoutError(f"{path} has the steps {steps_of(path)}.")


def run_steps(visualizer, count, first=0, factory=None):
    if factory is None:
        factory = Factory()
        factory.add_scalars("error", ["x"])
    for step in range(first, first + count):
        factory.update_scalars("error", [step])
        visualizer.events(1, step, factory.take_events())
    return factory


def test_a_live_viewer_gets_everything(opened, receiver):
    viewer, path = receiver
    visualizer = opened(mode="connect", address=viewer.address)
    run_steps(visualizer, 350)
    visualizer.close()
    wait_for_steps(path, lambda steps: len(steps) == 350)
    viewer.end()
    assert steps_of(path) == steps_of(visualizer.file) == list(range(350))
    live, file = (rr.chunk.RrdReader(p).recordings()[0] for p in (path, visualizer.file))
    assert (live.application_id, live.recording_id) == (file.application_id, file.recording_id)


def test_a_viewer_that_dies(opened, receiver):
    viewer, _ = receiver
    visualizer = opened(mode="connect", address=viewer.address)
    factory = run_steps(visualizer, 200)
    viewer.process.send_signal(signal.SIGKILL)
    viewer.process.wait()
    run_steps(visualizer, 200, 200, factory)
    with pytest.warns(UserWarning, match=f"{viewer.address}"):
        visualizer.close()
    assert steps_of(visualizer.file) == list(range(400))


COMING = """
    import pathlib, sys
    from physx_rerun.visualizer import RerunVisualizer
    from physx_rerun.viewer import streams
    from physx_core.components import Factory

    streams.RETRY_SECONDS = 0.05
    folder, *addresses = sys.argv[1:]
    visualizer = RerunVisualizer(mode="connect", address=addresses)
    visualizer.open("run", pathlib.Path(folder), 1)
    factory = Factory()
    factory.add_scalars("error", ["x"])
    for name in ("fixed", "moving"):
        factory.add_box(name, (1.0, 1.0, 1.0))
    for step, _ in enumerate(sys.stdin):
        factory.update_scalars("error", [step])
        factory.update_box("moving", position=[step, 0.0, 0.0])
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
"""


@contextlib.contextmanager
def receiving(port, path):
    viewer = Viewer(port, ("--save", str(path)))
    viewer.wait_until_ready()
    yield
    viewer.process.send_signal(signal.SIGKILL)
    viewer.end()


def test_viewers_that_come_late_and_come_back_get_the_last_state_and_go_on(python, tmp_path):
    """Two viewers: one is there from the start, is killed, and comes back; the other comes late."""
    one, two = find_free_port(), find_free_port()
    command = [python, "-c", textwrap.dedent(COMING), str(tmp_path)]
    command += [f"127.0.0.1:{port}" for port in (one, two)]
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "bufsize": 1}
    first, back, late = (tmp_path / f"{name}.rrd" for name in ("first", "back", "late"))
    with contextlib.ExitStack() as viewers, subprocess.Popen(command, **pipes) as run:

        def step_until_it_has_some(path):
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                for _ in range(5):
                    run.stdin.write("step\n")
                time.sleep(0.05)
                with contextlib.suppress(FileNotFoundError, ValueError, RuntimeError):
                    if len(steps_of(path)) > 20:
                        return
            raise TimeoutError(path)

        with receiving(one, first):
            step_until_it_has_some(first)
        viewers.enter_context(receiving(one, back))
        step_until_it_has_some(back)
        viewers.enter_context(receiving(two, late))
        step_until_it_has_some(late)
        _, errors = run.communicate(timeout=60)
        assert run.returncode == 0, errors
        assert "\x1b" not in errors  # Rerun's own messages are colored
        assert errors.count("not always reachable") == 2
        every = steps_of(tmp_path / "run.rrd")
        assert every == list(range(len(every)))
        for path in (back, late):
            steps = wait_for_steps(path, lambda steps: steps[-1:] == every[-1:])
            assert steps[0] > 0 and steps == list(range(steps[0], len(every)))
            assert len(frames_of(path)) == 2
            assert rr.chunk.RrdReader(path).blueprints()


def frames_of(path):
    frames = set()
    for chunk in rr.chunk.RrdReader(path).stream().filter(content="/env_1/tf"):
        names = chunk.to_record_batch()["Transform3D:child_frame"].to_pylist()
        frames |= {name for (name,) in names}
    return frames


HANGING = """
    import sys
    from physx_core.components import Factory
    from physx_rerun.visualizer import RerunVisualizer

    visualizer = RerunVisualizer(mode="connect", address=sys.argv[2:])
    visualizer.open("run", sys.argv[1], 1)
    factory = Factory()
    factory.add_scalars("error", ["x"])
    print("ready", flush=True)
    input()
    for step in range(1000):
        factory.update_scalars("error", [step])
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
"""


def test_a_viewer_that_hangs_holds_up_neither_run_nor_exit_nor_another_viewer(
    receiver, python, tmp_path
):
    viewer, _ = receiver
    port, other = find_free_port(), tmp_path / "other.rrd"
    addresses = [viewer.address, f"127.0.0.1:{port}"]
    command = [python, "-c", textwrap.dedent(HANGING), str(tmp_path), *addresses]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with receiving(port, other), subprocess.Popen(command, **pipes) as run:
        assert run.stdout.readline() == b"ready\n"
        viewer.process.send_signal(signal.SIGSTOP)
        try:
            _, errors = run.communicate(b"\n", timeout=60)
        finally:
            run.kill()
            viewer.process.send_signal(signal.SIGCONT)
        wait_for_steps(other, lambda steps: steps == list(range(1000)))
    assert run.returncode == 0, errors.decode()
    assert errors.count(b"does not respond") == 1 and b"not there" not in errors
    assert steps_of(tmp_path / "run.rrd") == list(range(1000))


def test_rows_for_a_viewer_that_hangs_are_dropped_and_counted(receiver, monkeypatch):
    viewer, _ = receiver
    monkeypatch.setattr(rr, "unregister_shutdown", lambda: None)
    writer = LiveWriter("test", "test", "test", viewer.address)
    rows = ChunkBuilder()
    noise = np.random.default_rng(0).random((500_000, 3), np.float32)
    rows.add("cloud", rr.Points3D, {"step": 0}, positions=noise)
    (chunk,) = rows.pop_chunks()
    viewer.process.send_signal(signal.SIGSTOP)
    try:
        puts = 0
        while writer.missed < 3 and puts < 200:
            writer.put(chunk)
            puts += 1
            time.sleep(0.02)
        assert 0 < writer.missed < puts
        with pytest.warns(UserWarning) as warned:
            writer.end()
            writer.close(time.monotonic() + 0.2)
        texts = [str(warning.message) for warning in warned]
        assert any(f"missed {writer.missed} blocks" in text for text in texts)
    finally:
        viewer.process.send_signal(signal.SIGCONT)


ENDLESS = """
    import itertools, sys, time
    from physx_core.components import Factory
    from physx_rerun.visualizer import RerunVisualizer

    visualizer = RerunVisualizer()
    visualizer.open("run", sys.argv[1], 1)
    factory = Factory()
    factory.add_scalars("error", ["x"])
    for step in itertools.count():
        factory.update_scalars("error", [step])
        visualizer.events(1, step, factory.take_events())
        time.sleep(0.001)
"""


def test_a_killed_run_leaves_a_readable_file(python, tmp_path):
    path = tmp_path / "run.rrd"
    with subprocess.Popen([python, "-c", textwrap.dedent(ENDLESS), str(tmp_path)]) as run:
        deadline = time.monotonic() + 60
        while not path.exists() or len(steps_of(path)) < 500:
            assert run.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)
        os.kill(run.pid, signal.SIGKILL)
    steps = steps_of(path)
    assert len(steps) >= 500
    assert steps == list(range(len(steps)))
