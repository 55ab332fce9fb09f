"""Options, training curves, layout and picture of the visualizer."""

from __future__ import annotations

import contextlib
import time
import urllib.parse
import urllib.request
from pathlib import Path

import numpy as np
import psutil
import pytest
import rerun as rr
from rerun.experimental import ViewerClient

from physx_core import DataGeneration, EnvironmentConfig, plugins
from physx_core.components import Factory
from physx_core.errors import ConfigError, UnknownOptionError, VisualizerError
from physx_rerun import visualizer as visualizer_module
from physx_rerun.viewer.viewer import Viewer, find_free_port
from physx_rerun.visualizer import RerunVisualizer

pytestmark = pytest.mark.processes


def ball(visualizer, step=0, instance=1, **look):
    factory = Factory()
    factory.add_sphere("ball", 0.1, **look)
    visualizer.events(instance, step, factory.take_events())
    return factory


def test_the_plugin_is_found_by_its_name():
    assert plugins.resolve("visualizer", "rerun") is RerunVisualizer


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "show"}, "'save', 'spawn', 'connect', 'web', 'headless'"),
        ({"mode": "connect"}, "HOST:PORT"),
        ({"mode": "connect", "address": "localhost"}, "HOST:PORT"),
        ({"address": "localhost:9876"}, 'mode "connect"'),
        ({"picture": "run.png"}, 'mode "headless"'),
        ({"mode": "headless", "save": False}, "save=True"),
        ({"save": False}, "save=True"),
        ({"max_instances": -1}, "at least 0"),
        ({"port": "auto"}, "port"),
        ({"mode": "connect", "address": ["localhost:1", "here"]}, "HOST:PORT"),
        ({"page_port": 8000}, 'mode "web"'),
        ({"every": 0}, "at least 1"),
        ({"picture_size": (10, 10)}, "64"),
    ],
)
def test_unfit_options(options, message):
    with pytest.raises(ConfigError, match=message):
        RerunVisualizer(**options)


def test_unknown_option():
    with pytest.raises(UnknownOptionError, match='Did you mean "address"'):
        RerunVisualizer(adress="localhost:1")


def test_a_window_needs_a_display(monkeypatch, tmp_path):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(VisualizerError, match="no display"):
        RerunVisualizer(mode="spawn").open("run", tmp_path, 1)


def test_a_window_that_cannot_be_opened(monkeypatch, tmp_path):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(VisualizerError, match="viewer ended with status"):
        RerunVisualizer(mode="spawn").open("run", tmp_path, 1)


def test_a_port_that_is_taken(monkeypatch, tmp_path, receiver):
    monkeypatch.setenv("DISPLAY", ":987")
    port = int(receiver[0].address.rpartition(":")[2])
    with pytest.raises(VisualizerError, match=f'Port {port} is taken.*"connect"'):
        RerunVisualizer(mode="spawn", port=port).open("run", tmp_path, 1)


@pytest.mark.usefixtures("vulkan")
def test_a_viewer_of_its_own_outlives_the_run(monkeypatch, opened):
    """The viewer is started without a window, for there may be no display."""
    monkeypatch.setenv("DISPLAY", ":987")

    def without_window(port, options, **more):
        return Viewer(port, ("--headless", *options), **more)

    monkeypatch.setattr(visualizer_module, "Viewer", without_window)
    visualizer = opened(mode="spawn", save=False)
    try:
        ball(visualizer)
        visualizer.scalars({"loss/training": 1.0}, 0, "batch")
        visualizer.close()
        client = ViewerClient.connect(f"rerun+http://{visualizer.viewer.address}/proxy")
        deadline = time.monotonic() + 60
        shown = {"environment", "loss per epoch (log10)"}
        while {view.name for view in client.get_state().views} != shown:
            assert time.monotonic() < deadline, client.get_state()
            time.sleep(0.1)
        assert visualizer.file is None
    finally:
        visualizer.viewer.end()


def test_nobody_listens(opened):
    port = find_free_port()
    visualizer = opened(mode="connect", address=f"127.0.0.1:{port}")
    (line,) = visualizer.announcements()
    assert f"127.0.0.1:{port}" in line and line.endswith(f"rerun --bind 127.0.0.1 --port {port}")
    ball(visualizer)
    with pytest.warns(UserWarning, match=f"127.0.0.1:{port} was never reachable"):
        visualizer.close()
    assert visualizer.file.is_file()


def test_an_environment_that_draws_nothing_is_named(opened, tmp_path):
    visualizer = opened()
    visualizer.events(1, 0, [])
    with pytest.warns(UserWarning, match=r"draws nothing: add objects .* init_visualization"):
        visualizer.close()
    assert not list(tmp_path.rglob("*.rrd")) and not visualizer.outputs()


def test_nothing_is_drawn_nor_written_in_the_mode_none(opened, tmp_path):
    visualizer = opened(mode="none")
    ball(visualizer)
    visualizer.scalars({"loss": 1.0}, 0, "batch")
    visualizer.close()
    assert not list(tmp_path.iterdir()) and not visualizer.outputs()


def test_a_page_for_browsers(opened, tmp_path):
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    visualizer = opened(mode="web")
    (line,) = visualizer.announcements()
    page, _, viewer = line.removeprefix("viewer: ").partition("?url=")
    with urllib.request.urlopen(page, timeout=30) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    ball(visualizer)
    visualizer.scalars({"loss/training": 1.0}, 0, "batch")
    visualizer._flush()
    received = tmp_path / "received.rrd"  # what a page that is opened now gets
    with Viewer(0, (urllib.parse.unquote(viewer), "--save", str(received))).process:
        deadline = time.monotonic() + 60
        while not {"/env_1/ball", "/run/loss/training"} <= entities_of(received):
            assert time.monotonic() < deadline
            time.sleep(0.1)
    visualizer.close()
    assert {child.pid for child in psutil.Process().children(recursive=True)} == before
    assert visualizer.file.is_file()


def entities_of(path):
    with contextlib.suppress(FileNotFoundError, ValueError, RuntimeError):  # being written
        return {chunk.entity_path for chunk in rr.chunk.RrdReader(path).stream()}
    return set()


def test_every_third_step_is_recorded_and_the_last(opened, read):
    visualizer = opened(every=3)
    factory = ball(visualizer)
    factory.add_scalars("error", ["x"])
    for step in range(1, 12):
        factory.update_scalars("error", [step])
        if step < 6:
            factory.update_sphere("ball", position=[step, 0.0, 0.0])
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
    numbers = read(visualizer.file, "/env_1/error", "Scalars:scalars")
    assert numbers == [(step, [step]) for step in (1, 3, 6, 9, 11)]  # at 1 it was added
    places = read(visualizer.file, "/env_1/tf", "Transform3D:translation")
    assert [(step, place[0][0]) for step, place in places] == [(0, 0), (1, 1), (3, 3), (6, 5)]


def test_what_belongs_together_stays_together_where_few_steps_are_recorded(opened, read):
    visualizer, factory = opened(every=4), Factory()
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    factory.add_mesh("plate", square[:3], [[0, 1, 2]])
    visualizer.events(1, 0, factory.take_events())
    factory.update_mesh("plate", positions=square)
    factory.update_mesh("plate", cells=[[0, 2, 3]])
    visualizer.events(1, 1, factory.take_events())
    factory.update_mesh("plate", positions=square + 1)
    visualizer.events(1, 2, factory.take_events())
    for _ in range(2):
        factory.add_sphere("ball", 1.0)
        factory.remove("ball")
    factory.add_sphere("ball", 2.0)
    visualizer.events(1, 3, factory.take_events())
    visualizer.close()
    positions = read(visualizer.file, "/env_1/plate", "Mesh3D:vertex_positions")
    assert positions[-1] == (3, (square + 1).tolist())
    cells = read(visualizer.file, "/env_1/plate", "Mesh3D:triangle_indices")
    assert cells[-1] == (3, [[0, 2, 3]])
    third = r"/env_1/ball\ \(3\)"
    assert read(visualizer.file, third, "Ellipsoids3D:half_sizes") == [(3, [[2.0] * 3])]


def test_the_file_lies_in_the_session_and_is_never_overwritten(opened, tmp_path):
    first, second = opened(), None
    ball(first)
    first.close()
    second = opened()
    ball(second)
    second.close()
    assert first.file == tmp_path / "run.rrd"
    assert second.file == tmp_path / "run_2.rrd"


def test_the_run_is_told_of_a_recording_that_is_there(opened, tmp_path):
    visualizer = opened()
    visualizer.close()
    assert list(visualizer.outputs()) == []
    visualizer = opened()
    ball(visualizer)
    visualizer.close()
    file = tmp_path / "run.rrd"
    assert list(visualizer.outputs()) == [f"recording: {file}  (physx view {file})"]


def test_the_file_where_it_is_wanted(opened, tmp_path):
    visualizer = opened(path=str(tmp_path / "deep" / "here.rrd"))
    ball(visualizer)
    visualizer.close()
    assert (tmp_path / "deep" / "here.rrd").is_file()


def test_a_file_that_cannot_be_written(opened, tmp_path):
    (tmp_path / "taken").write_text("")
    visualizer = opened(path=tmp_path / "taken" / "run.rrd")
    with pytest.raises(VisualizerError, match="cannot be written"):
        ball(visualizer)


def test_closing_twice_and_closing_early(opened, tmp_path):
    RerunVisualizer().close()
    visualizer = opened()
    visualizer.close()
    visualizer.close()
    assert not visualizer.file.exists()
    ball(visualizer)
    assert not visualizer.file.exists()


def test_the_file_is_whole_after_close(opened):
    visualizer = opened()
    ball(visualizer)
    visualizer.close()
    reader = rr.chunk.RrdReader(visualizer.file)
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    assert "/env_1/ball" in reader.store().summary()


def test_training_curves(opened, read):
    visualizer = opened()
    for batch in range(4):
        visualizer.scalars({"loss/training": 1 / (batch + 1)}, batch, "batch")
    visualizer.scalars({"loss/validation": 0.5, "duration": 2.0}, 0, "epoch")
    visualizer.close()
    curve = visualizer.file, "/run/loss/training"
    expected = [(0, [1.0]), (1, [0.5]), (2, [1 / 3]), (3, [0.25])]
    assert read(*curve, "Scalars:scalars", "batch") == expected
    assert read(*curve, "SeriesLines:names", "batch") == [(None, ["training"])]
    # The epoch's numbers also lie on the batches' timeline, so that both curves show together.
    validation = visualizer.file, "/run/loss/validation", "Scalars:scalars"
    assert read(*validation, "batch") == [(3, [0.5])]
    assert read(*validation, "epoch") == [(0, [0.5])]
    assert read(visualizer.file, "/run/duration", "Scalars:scalars", "epoch") == [(0, [2.0])]


def test_histograms(opened, read):
    visualizer = opened()
    values = np.array([0.0, 1.0, 1.0, 30.0, np.nan])
    for epoch in (2, 4):
        visualizer.histograms({"weights/layers.0.bias": values}, epoch, "epoch")
    visualizer.close()
    rows = read(visualizer.file, "/run/weights/layers.0.bias", "BarChart:values", "epoch")
    assert [epoch for epoch, _ in rows] == [2, 4]
    counts = rows[0][1][0]["buffer"]
    assert (len(counts), sum(counts), counts[0], counts[-1]) == (30, 4, 1, 1)


def test_equal_scenes_share_a_layout_and_others_do_not(opened, tmp_path):
    def application(name, instance_nb, **look):
        visualizer = opened(instance_nb, path=tmp_path / name)
        factory = ball(visualizer, **look)
        if name == "other.rrd":
            factory.add_scalars("height", ["z"])
            visualizer.events(1, 1, factory.take_events())
        visualizer.close()
        return rr.chunk.RrdReader(tmp_path / name).recordings()[0].application_id

    first = application("first.rrd", 1)
    assert first == application("second.rrd", 1, color="red")
    assert first != application("two.rrd", 2)


def test_events_in_the_order_of_their_arrival(opened, read):
    """Instances over TCP are not in step with each other."""
    visualizer = opened(instance_nb=2)
    factories = {instance: ball(visualizer, instance=instance) for instance in (2, 1)}
    for instance, step in [(1, 1), (1, 2), (2, 1), (1, 3), (2, 2)]:
        factories[instance].update_sphere("ball", position=[step, 0, 0])
        visualizer.events(instance, step, factories[instance].take_events())
    visualizer.close()
    steps = [s for s, _ in read(visualizer.file, "/env_1/tf", "Transform3D:translation")]
    assert steps == [0, 1, 2, 3]


def test_what_is_drawn_has_simulated_time_that_goes_on_after_a_new_episode(opened, read):
    visualizer = opened()
    factory = Factory()
    for step, seconds in enumerate([0.0, 0.5, 1.0, 0.0, 0.5]):
        factory.set_time(seconds)
        if step:
            factory.update_sphere("ball", position=[step, 0, 0])
        else:
            factory.add_sphere("ball", 0.1)
        visualizer.events(1, step, factory.take_events())
    assert visualizer._layout.timeline == "sim_time"
    visualizer.close()
    rows = read(visualizer.file, "/env_1/tf", "Transform3D:translation", "sim_time")
    assert [(time.total_seconds(), xyz[0][0]) for time, xyz in rows] == [
        *((0.0, 0), (0.5, 1), (1.0, 2), (1.0, 3), (1.5, 4))
    ]


@pytest.mark.parametrize("clients", [False, True])
def test_the_steps_of_an_environment_have_the_simulated_time_that_it_says(
    tmp_path, monkeypatch, read, clients
):
    monkeypatch.chdir(tmp_path)
    config = EnvironmentConfig(
        "toy/spring", as_tcp_ip_client=clients, visualizer="rerun", env_kwargs={"period": 0.25}
    )
    DataGeneration(config, batch_nb=1, batch_size=4, quiet=True).execute()
    (path,) = Path("sessions").rglob("*.rrd")
    rows = read(path, "/env_1/tf", "Transform3D:translation", "sim_time")
    assert [time.total_seconds() for time, _ in rows] == [0, 0, 0.25, 0.5, 0.75]


def test_big_updates_do_not_pile_up(opened):
    visualizer = opened()
    factory = Factory()
    factory.add_points("cloud", np.zeros((200_000, 3)))
    for _ in range(8):
        factory.update_points("cloud", positions=np.zeros((200_000, 3)))
        visualizer.events(1, 0, factory.take_events())
        assert visualizer._rows.nbytes < 12_000_000
