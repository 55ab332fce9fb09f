"""What a study looks like: its figure, and its curves in the viewer."""

from pathlib import Path
from typing import ClassVar

import pytest

from physx_cluster.errors import StudyError
from physx_cluster.sweep import Definition, Study, run_study
from physx_cluster.sweep.show import draw_figure, record_curves, show_status, summary
from physx_core import Visualizer
from physx_core.errors import UsageError

pytestmark = pytest.mark.processes


class Noted(Visualizer):
    """Keeps what it is given."""

    received: ClassVar[list] = []

    def open(self, run_name, session_dir, instance_nb):
        self.received.append(("open", run_name, Path(session_dir).name))

    def scalars(self, values, step, timeline):
        self.received.append((dict(values), step, timeline))

    def note(self, text):
        self.received.append(text)

    def close(self):
        self.received.append("close")

    def outputs(self):
        return ["noted"]


@pytest.fixture
def study(write):
    definition = Definition.read(write(parameters={"training.network.lr": [0.1, 1e6]}))
    return run_study(definition, Path("study"), lambda line: None)


def test_a_visualizer_gets_the_numbers_of_all_trials_as_one_run(study):
    Noted.received.clear()
    assert record_curves(study, Noted) == ["noted"]
    first, *curves, state, best, session, last = Noted.received
    assert first == ("open", "sweep", "study")
    assert [step for _, step, _ in curves] == [1, 2, 3, 4]
    assert {timeline for *_, timeline in curves} == {"epoch"}
    assert curves[3][0]["loss/validation/trial_0001"] == study.results[1].numbers[4]
    assert (state, last) == ("trials: 1 complete, 1 failed", "close")
    assert best.startswith("best*: linear, lr 0.1: loss/validation")
    assert session == "session: study/trial_0001"


@pytest.mark.slow
def test_curves_are_one_recording_in_the_viewer(study, physx):
    rerun = pytest.importorskip("rerun")
    assert rerun is not None
    said = physx("sweep", "study", "--view")
    assert "recording: study/study.rrd" in said
    assert Path("study/study.rrd").stat().st_size > 1000


@pytest.mark.slow
def test_the_figure_shows_the_results(study):
    pytest.importorskip("matplotlib")
    draw_figure(study, Path("study.svg"))
    text = Path("study.svg").read_text()
    for part in ("best so far", "loss/validation", "training.network.lr"):
        assert f"<!-- {part} -->" in text
    with pytest.raises(UsageError, match=r"cannot be written"):
        draw_figure(study, Path("study.what"))


def test_curves_are_as_short_as_the_columns_beside_them_need(write, training, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    name = "a_pipeline_whose_name_leaves_so_little_room"
    definition = Definition.read(
        write(pipelines={name: {"training": training}}, parameters={"training.network.lr": [0.1]})
    )
    show_status(run_study(definition, Path("study"), lambda line: None))
    _, line, *_ = capsys.readouterr().out.splitlines()
    words = line.split()
    assert words[:5] == ["*1", name, "0.1", "0", "complete"]
    assert len(words[-1]) < 4 and len(line) <= 100, "the curve of 4 epochs"


def test_a_study_without_results_has_neither(write, training):
    training["dataset"]["existing_dir"] = "nowhere"
    definition = Definition.read(write())
    with pytest.raises(StudyError, match="There is no dataset in nowhere"):
        run_study(definition, Path("study"), lambda line: None)
    study = Study.read(Path("study"))
    assert list(summary(study)) == ["trials: 2 without a result"]
    with pytest.raises(StudyError, match="has recorded a number yet"):
        record_curves(study, Noted)
    pytest.importorskip("matplotlib")
    with pytest.raises(StudyError, match="has a result yet"):
        draw_figure(study, Path("study.png"))
