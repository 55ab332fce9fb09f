"""Plots of what was recorded."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from physx_core.errors import MissingLibraryError
from physx_gym import Log, RobotEnv, plot
from physx_gym.errors import LogError

pytestmark = pytest.mark.processes


def log_of(*names, rows=5, units=None):
    variables = {"time": np.arange(rows) * 0.1}
    variables |= {name: np.arange(rows) * (1.0 + number) for number, name in enumerate(names)}
    return Log({"environment": "Env", "units": units or {}}, variables)


def titles(figure):
    return [axes.get_title() for axes in figure.axes]


def labels(axes):
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def test_columns_are_grouped_and_named():
    figure = plot(
        log_of(
            "mine.0",
            "mine.1",
            "height",
            "action.hinge",
            "motor.torque.hinge",
            "sensor.Imu.torso.acceleration.0",
            "sensor.Imu.torso.acceleration.1",
            "sensor.Imu.head.acceleration.0",
            "sensor.Encoder.hinge.position",
            "state.q.robot.x",
            "state.q.robot.hinge",
            units={"state.q.robot.x": "m"},
        )
    )
    assert titles(figure) == [
        "state.q.robot.base",
        "state.q.robot",
        "sensor.Imu.acceleration",
        "sensor.Encoder.position",
        "motor.torque",
        "action",
        "mine",
        "height",
    ]
    base, joints, imu, encoder, *_ = figure.axes
    assert labels(base) == ["x"]
    assert base.get_ylabel() == "m"
    assert labels(joints) == ["hinge"]
    assert labels(imu) == ["torso.0", "torso.1", "head.0"]
    assert labels(encoder) == ["hinge"]
    assert base.get_xlabel() == "time (s)"
    np.testing.assert_allclose(joints.lines[0].get_xdata(), np.arange(5) * 0.1)
    np.testing.assert_array_equal(joints.lines[0].get_ydata(), np.arange(5) * 11.0)


def test_states_of_blocks_are_shown_on_request():
    log = log_of("pd.state.0", "pd.action.0", "state.q.robot.hinge")
    assert titles(plot(log)) == ["state.q.robot", "pd.action"]
    assert titles(plot(log, enable_block_states=True)) == ["state.q.robot", "pd.state", "pd.action"]


def test_chosen_columns():
    log = log_of("motor.torque.a", "motor.command.a", "state.q.robot.a")
    assert titles(plot(log, columns="motor")) == ["motor.torque", "motor.command"]
    assert titles(plot(log, columns=["state.q", "motor.t"])) == ["state.q.robot", "motor.torque"]
    with pytest.raises(LogError, match=r"no column begins with engine\. .*motor, state"):
        plot(log, columns="engine")


def test_several_logs_are_compared(tmp_path):
    first, second = log_of("a.0", "b.0"), log_of("a.0", rows=9)
    second.write(tmp_path / "second.h5")
    figure = plot([first, tmp_path / "second.h5"], compare=[first], path=tmp_path / "new" / "a.png")
    shared, alone = figure.axes
    assert [len(line.get_xdata()) for line in shared.lines] == [5, 9, 5]
    assert len({line.get_linestyle() for line in shared.lines}) == 3
    assert len(alone.lines) == 2
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["1: Env", "2: second", "3: Env"]
    assert (tmp_path / "new" / "a.png").read_bytes()[:4] == b"\x89PNG"


def test_an_environment_plots_its_episode(tmp_path):
    env = RobotEnv("cartpole", 0.02)
    with pytest.raises(LogError, match="Nothing was recorded: no episode has run"):
        env.plot()
    env.reset(seed=0)
    env.step([1.0, 0.0])
    assert {axes.get_title() for axes in env.plot(show=False).axes} >= {"state.q.robot"}
    env.stop()
    env.eval()
    env.reset(seed=0)
    for _ in range(5):
        env.step(env.action_space.sample())
    figure = env.plot(path=tmp_path / "a.pdf")
    assert titles(figure)[0] == "state.q.robot"
    assert len(figure.axes[0].lines[0].get_xdata()) == 6
    assert (tmp_path / "a.pdf").read_bytes()[:4] == b"%PDF"


def test_the_error_of_missing_matplotlib_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingLibraryError, match=r'pip install .*physx.gym\[plot\]"'):
        plot(log_of("a"))


def test_sources_that_are_not_logs():
    with pytest.raises(LogError, match="is neither a log"):
        plot(3)
    with pytest.raises(LogError, match="No log was given"):
        plot([])
