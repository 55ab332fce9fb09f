"""Notebooks: classes of cells run in clients; what cells show is short."""

from html import unescape
from pathlib import Path

import pytest
import run_pages

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

pytestmark = [pytest.mark.slow, pytest.mark.processes]

PAGE = run_pages.ROOT / "docs/howto/notebook.md"


def run(folder, *cells):
    """Run cells in a kernel; return what each shows, as text of stdout, of stderr, and else."""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(each) for each in cells])
    resources = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(
        notebook, timeout=120, resources=resources, kernel_name="python3", allow_errors=True
    ).execute()
    return [shown(cell.outputs) for cell in notebook.cells]


def shown(outputs):
    found = {"stdout": "", "stderr": "", "result": "", "html": "", "error": "", "widget": ""}
    for each in outputs:
        if each.output_type == "stream":
            found[each.name] += each.text
        elif each.output_type == "error":
            found["error"] += "\n".join(each.traceback)
        else:
            found["result"] += each.data.get("text/plain", "")
            found["html"] += each.data.get("text/html", "")
            found["widget"] += str(each.data.get("application/vnd.jupyter.widget-view+json", ""))
    return found


def test_the_page_runs_as_a_notebook(tmp_path):
    cells = [block.text for block in run_pages.read(PAGE)]
    *others, dataset, pipeline = run(tmp_path, *cells, "training")
    _, generated, trained, report = others
    assert [each["error"] for each in (*others, dataset)] == [""] * 5
    assert "samples: 1,000 training in sessions/pendulum/dataset" in generated["stdout"]
    assert generated["stderr"] == ""
    assert "<table>" in trained["html"]
    assert 'srcdoc="&lt;!doctype html&gt;' in report["html"] and report["stdout"] == ""
    assert "next_state" in report["html"] and "<script" not in unescape(report["html"])
    assert dataset["widget"] and dataset["stdout"] == ""
    assert dataset["result"].endswith("<Dataset sessions/pendulum/dataset: 1,000 training>")
    assert pipeline["result"].startswith("Training(") and len(pipeline["result"]) < 400


CLASS = """
from physx_core import DataGeneration, Environment, EnvironmentConfig
import numpy
SIZE, THING = 3, object()

class Base(Environment):
    def create(self):
        pass
    def init_database(self):
        self.define_training_fields([("x", numpy.ndarray)])

class Own(Base):
    def step(self):
        self.set_training_data(x=numpy.full(SIZE, value()))

def value():
    return 1.0

def go(cls):
    config = EnvironmentConfig(cls, num_clients=2, seed=0)
    return DataGeneration(config, batch_nb=2, batch_size=4, quiet=True).execute()
"""


def test_cells_that_change_or_fail_say_so_in_a_line(tmp_path):
    changed = "def value():\n    return numpy.array([1.0])[5]\ngo(Own)"
    thing = "def value():\n    return float(THING is None)\ngo(Own)"
    _, first, failed, foreign = run(tmp_path, CLASS, "go(Own)", changed, thing)
    assert first["error"] == "" and "8 training" in first["result"] + first["html"]
    assert "IndexError" in failed["error"] and "return numpy.array([1.0])[5]" in failed["error"]
    assert len(failed["error"].splitlines()) == 1
    assert "value uses THING of the notebook" in foreign["error"]
    assert "create()" in foreign["error"] and len(foreign["error"].splitlines()) == 1
    assert list(Path(tmp_path).rglob("*.py")) == []
