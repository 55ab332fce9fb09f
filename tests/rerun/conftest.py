from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from physx_core.components import Factory
from physx_core.errors import VisualizerError
from physx_rerun.viewer.headless import render_picture
from physx_rerun.viewer.viewer import Viewer
from physx_rerun.visualizer import RerunVisualizer

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <material name="amber"><color rgba="1 0.5 0 1"/></material>
  <link name="base">
    <visual><geometry><box size="0.2 0.2 0.1"/></geometry></visual>
    <collision><geometry><box size="9 9 9"/></geometry></collision>
  </link>
  <link name="upper">
    <visual>
      <origin xyz="0 0 0.15" rpy="0 0 1.5707963267948966"/>
      <geometry><cylinder radius="0.03" length="0.3"/></geometry>
      <material name="amber"/>
    </visual>
  </link>
  <link name="tool">
    <visual>
      <geometry><mesh filename="package://arm_meshes/tool.obj" scale="2 2 2"/></geometry>
    </visual>
    <visual><geometry><sphere radius="0.05"/></geometry></visual>
  </link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.05"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="upper"/><child link="tool"/><origin xyz="0 0 0.3"/>
  </joint>
</robot>
"""
TETRAHEDRON = """v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    """Rerun only warns of bad data unless it is told to raise."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tool.obj").write_text(TETRAHEDRON)
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., RerunVisualizer]]:
    """Return a function that opens a visualizer; they are closed at the end."""
    visualizers: list[RerunVisualizer] = []

    def open_one(instance_nb: int = 1, **options: Any) -> RerunVisualizer:
        visualizer = RerunVisualizer(**options)
        visualizers.append(visualizer)
        visualizer.open(run_name="run", session_dir=tmp_path, instance_nb=instance_nb)
        return visualizer

    yield open_one
    for visualizer in visualizers:
        visualizer.close()


@pytest.fixture
def read() -> Callable[..., list[tuple[Any, Any]]]:
    """Return a function that gives (position, value) of a component; position None: static."""

    def column(
        path: Path, entity: str, component: str, timeline: str = "step"
    ) -> list[tuple[Any, Any]]:
        rows: list[tuple[Any, Any]] = []
        for chunk in rr.chunk.RrdReader(path).stream().filter(content=entity):
            batch = chunk.to_record_batch()
            if component not in batch.schema.names:
                continue
            values = batch.column(component).to_pylist()
            names = batch.schema.names
            times = (
                batch.column(timeline).to_pylist() if timeline in names else [None] * len(values)
            )
            rows += zip(times, values, strict=True)
        return sorted(rows, key=lambda row: -1 if row[0] is None else row[0])

    return column


@pytest.fixture
def entities() -> Callable[[Path], set[str]]:
    def of(path: Path) -> set[str]:
        return {chunk.entity_path for chunk in rr.chunk.RrdReader(path).stream()}

    return of


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[tuple[Viewer, Path]]:
    """A viewer process that only writes what it gets to a file; needs no graphics."""
    path = tmp_path / "received.rrd"
    viewer = Viewer(0, ("--save", str(path)))
    viewer.wait_until_ready()
    yield viewer, path
    viewer.end()


@pytest.fixture(scope="session")
def vulkan(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Skip where there is nothing to draw with; continuous integration must have a driver."""
    folder = tmp_path_factory.mktemp("probe")
    visualizer = RerunVisualizer()
    visualizer.open("probe", folder, 1)
    factory = Factory()
    factory.add_points("points", np.zeros((1, 3)))
    visualizer.events(1, 0, factory.take_events())
    visualizer.close()
    try:
        render_picture(visualizer.file, folder / "probe.png", size=(128, 128))
    except VisualizerError as error:
        if "Vulkan" not in str(error) or os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


@pytest.fixture
def python() -> str:
    return sys.executable
