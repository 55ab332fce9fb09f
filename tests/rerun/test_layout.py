"""The windows that a recording opens with."""

from __future__ import annotations

import numpy as np
import pytest
import rerun as rr

from physx_core.scene import Factory
from physx_rerun.layout import Layout
from physx_rerun.rows import TIME


def columns_of(blueprint, tmp_path):
    """Return (entity path, column name, value) for all that a layout says."""
    recording = rr.RecordingStream("layout")
    recording.save(tmp_path / "layout.rrd")
    recording.send_blueprint(blueprint)
    recording.disconnect()
    reader = rr.chunk.RrdReader(tmp_path / "layout.rrd")
    (store,) = reader.blueprints()
    return [
        (chunk.entity_path, name, chunk.to_record_batch().column(name)[0].as_py())
        for chunk in reader.stream(store=store)
        for name in chunk.to_record_batch().schema.names
        if ":" in name
    ]


def views_of(columns, kind):
    paths = {path for path, name, value in columns if name.endswith(":class_identifier")
             and value == [kind]}  # fmt: skip
    return {
        value[0]: path
        for path, name, value in columns
        if path in paths and name.endswith(":display_name")
    }


@pytest.fixture
def layout():
    layout = Layout(2)
    for instance in (1, 2):
        layout.add_object(instance, "robot", "arm")
        layout.place(instance, "arm", np.array([[0, 0, 0], [0, 0, 1.0]]))
        layout.place(instance, "floor", np.array([[-50, -50, 0], [50, 50, 0.0]]))
        layout.add_plot("error", f"env_{instance}/error", "step", 3)
        layout.add_text(instance, "notes", f"env_{instance}/notes")
    return layout


def test_one_scene_for_each_instance_and_one_plot_for_all(layout, tmp_path):
    columns = columns_of(layout.blueprint(), tmp_path)
    assert set(views_of(columns, "3D")) == {"environment 1", "environment 2"}
    assert set(views_of(columns, "TextDocument")) == {"notes 1", "notes 2"}
    (plot,) = views_of(columns, "TimeSeries").values()
    (query,) = [value for path, name, value in columns if path == f"{plot}/ViewContents"
                and name.endswith(":query")]  # fmt: skip
    assert query == ["env_1/error", "env_2/error"]
    assert "TimePanelBlueprint:timeline" in [name for _, name, _ in columns]


def test_the_camera_looks_at_the_objects_and_not_at_the_floor(layout, tmp_path):
    columns = columns_of(layout.blueprint(), tmp_path)
    targets = [value for _, name, value in columns if name == "EyeControls3D:look_target"]
    eyes = [value for _, name, value in columns if name == "EyeControls3D:position"]
    assert targets == [[pytest.approx([0, 0, 0.5])]] * 2
    assert all(0.5 < np.linalg.norm(np.subtract(eye[0], [0, 0, 0.5])) < 3 for eye in eyes)


def test_changes_are_noticed_once(layout):
    assert layout.changed
    layout.blueprint()
    layout.add_object(1, "box", "crate")
    assert not layout.changed
    layout.add_plot("torque", "env_1/torque", "step", 1)
    assert layout.changed


def test_the_digest_knows_the_objects_and_the_number_of_instances():
    def digest(instance_nb, *names):
        layout = Layout(instance_nb)
        for name in names:
            layout.add_object(1, "box", name)
        return layout.digest

    assert digest(1, "a", "b") == digest(1, "b", "a")
    assert len({digest(1, "a"), digest(2, "a"), digest(1, "b")}) == 3


@pytest.mark.parametrize(
    ("has_scene", "timelines", "expected"),
    [
        (True, [], "step"),
        (True, ["step"], "step"),
        (True, ["batch"], TIME),
        (False, ["batch", "epoch"], "batch"),
        (False, ["epoch"], "epoch"),
        (False, ["step"], "step"),
    ],
)
def test_everything_is_visible_on_the_first_timeline(has_scene, timelines, expected):
    layout = Layout(1)
    if has_scene:
        layout.add_object(1, "box", "crate")
    for timeline in timelines:
        layout.add_plot(timeline, f"run/{timeline}", timeline, 1)
    assert layout.timeline == expected


def test_a_recording_brings_its_layout(opened):
    visualizer, factory = opened(), Factory()
    factory.add_sphere("ball", 0.1)
    visualizer.events(1, 0, factory.take_events())
    visualizer.close()
    reader = rr.chunk.RrdReader(visualizer.file)
    assert len(reader.blueprints()) == 1
