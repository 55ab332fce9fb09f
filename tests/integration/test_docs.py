"""The READMEs and the pages in docs/: their code runs, and what they claim to be complete is."""

import importlib
import inspect
import re

import engines
import figures
import plain_pages
import public_names
import pytest
import run_pages
import troubles

from physx_core import PhysxError, checkpoint

pytestmark = [pytest.mark.slow, pytest.mark.processes]

pytest.importorskip("torch")


LONG = {
    "docs/gym.md", "docs/online.md", "docs/sweep.md", "docs/testing.md", "docs/howto/network.md",
    "docs/howto/film.md", "docs/howto/other_tools.md", "docs/learn/9_scale.md",
    "physx_rerun/README.md",
}  # fmt: skip
"""Pages whose commands take many seconds; they run with the campaigns."""

GENERATED = {"figures.md", "gallery.md", "troubles.md"}
"""Pages that scripts write."""

WIDTH = 92
"""Longest line of code that the site shows without cutting it off."""


def books():
    """Each page, with those that it builds on."""
    for pages in run_pages.BOOKS:
        name = str(pages[-1].relative_to(run_pages.ROOT))
        yield pytest.param(pages, id=name, marks=[pytest.mark.faults] if name in LONG else [])


def test_each_block_is_run_or_says_by_what():
    for page in run_pages.PAGES:
        run_pages.check(run_pages.read(page))
    assert {str(page.relative_to(run_pages.ROOT)) for page in run_pages.PAGES} >= LONG


@pytest.mark.parametrize("pages", list(books()))
def test_the_code_of_a_page_runs(pages, tmp_path):
    run_pages.run(pages, tmp_path)


@pytest.mark.parametrize("page", run_pages.LEARN, ids=lambda page: page.stem)
def test_a_page_to_learn_from_is_short(page):
    assert sum(len(block.text.splitlines()) for block in run_pages.read(page)) <= 40


def test_code_fits_the_page():
    written = [
        page
        for page in run_pages.PAGES
        if page.name not in GENERATED and page.parent.name != "gallery"
    ]
    blocks = [block for page in written for block in run_pages.read(page)]
    code = [block for block in blocks if block.language not in ("", "text")]
    assert [
        f"{block.page.relative_to(run_pages.ROOT)}, line {block.line + number}: {line}"
        for block in code
        for number, line in enumerate(block.text.splitlines(), 1)
        if len(line) > WIDTH
    ] == []


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("```python\n1 / 0\n```", "line 1: .*ZeroDivisionError"),
        ("```sh\nfalse\necho\n```", "exit status 1"),
        ("<!-- fails -->\n```sh\ntrue\n```", "exit status 0"),
        ("```console\n$ echo one\ntwo\n```", "prints\none\n\nand not\ntwo"),
        ("```\nphysx info\n```", "commands are sh or console"),
        ("```c\nmain(){}\n```", "c is not run"),
        ("<!-- file: a.py -->\n```python\n1\n```", "names a.py"),
        ("<!-- tested by tests/none.py -->\n```sh\nrm\n```", "does not exist"),
        ("<!-- tested by tests/conftest.py::test_no -->\n```sh\nrm\n```", "has no test_no"),
    ],
)
def test_a_page_that_says_what_is_not_so(text, error, tmp_path, monkeypatch):
    monkeypatch.setattr(run_pages, "ROOT", tmp_path)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/conftest.py").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(run_pages.PageError, match=f"(?s){error}"):
        run_pages.run([tmp_path / "page.md"], tmp_path / "folder")


def test_blocks_of_all_kinds(tmp_path, monkeypatch):
    monkeypatch.setattr(run_pages, "ROOT", tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "page.md").write_text(
        "<!-- file: a.txt -->\n```toml\none = 1\n```\n"
        "<!-- file: a.txt -->\n```toml\ntwo = 2\n```\n"
        "```python\nx = open('a.txt').read()\n```\n\n```python\nopen('b.txt', 'w').write(x)\n```\n"
        "```console\n$ cat b.txt\none...\ntwo = 2\n$ echo \\\n  end\nend\n```\n"
        "<!-- not run: not ours -->\n```sh\nfalse\n```\n```text\n1\n```\n```{note}\nmore\n```\n"
    )
    assert run_pages.run([tmp_path / "page.md"], tmp_path / "folder") == 5


def test_a_new_user_starts_the_program_three_times(root, run, tmp_path):
    """The first time with a mistake, the last time with another simulation."""
    script, sessions = tmp_path / "pendulum.py", tmp_path / "sessions"
    [code] = [
        each.text for each in run_pages.read(root / "README.md") if each.file == "pendulum.py"
    ]
    code = re.sub("batch_nb=[0-9]+, batch_size=[0-9]+", "batch_nb=4, batch_size=25", code)
    code = re.sub("epoch_nb=[0-9]+", "epoch_nb=1", code)

    def learned(run_name):
        """Mean of what the network was trained on."""
        found = checkpoint.find(sessions / run_name, None, -1)
        return found.normalization["state"].mean[0]

    script.write_text(code.replace("state=before", "states=before"))
    failed = run(script, ok=False).stderr
    assert 'Did you mean "state"?' in failed
    assert "session: sessions/pendulum was removed: the run stored nothing in it" in failed
    assert list(sessions.iterdir()) == []

    script.write_text(code)
    said = run(script).stderr
    assert "session: sessions/pendulum\n" in said and "session: sessions/pendulum_network\n" in said
    assert said.count("samples: 100 training in sessions/pendulum/dataset") == 2
    assert "checkpoint: sessions/pendulum_network/network/network_0" in said
    assert abs(learned("pendulum_network")) < 10

    script.write_text(code.replace("self.rng.uniform(", "100 + self.rng.uniform("))
    said = run(script).stderr
    assert 'session: sessions/pendulum_1 ("pendulum" exists)' in said
    assert 'session: sessions/pendulum_network_1 ("pendulum_network" exists)' in said
    assert said.count("samples: 100 training in sessions/pendulum_1/dataset") == 2
    assert learned("pendulum_network_1") > 50


def test_every_public_name_is_documented():
    assert public_names.undocumented() == []


def test_every_error_is_named_where_it_is_raised():
    assert public_names.unnamed_errors() == []


def test_the_reference_shows_every_face(root):
    pages = [root / f"docs/reference/{name}.md" for name in public_names.FACES]
    shown = "".join(page.read_text() for page in pages)
    assert re.findall(r"^\.\. face:: ([\w.]+)$", shown, re.MULTILINE) == public_names.MODULES
    text = (root / "docs/architecture.md").read_text()
    paragraph = re.sub(r"\s+", " ", text.split("**Faces.**")[1].split("\n\n")[0])
    for name in re.findall(r"`(?:physx_core)?\.(\w+)`", paragraph.split("Everything below")[0]):
        assert f"physx_core.{name}" in public_names.MODULES
    packages = {path.parent.name for path in root.glob("physx_*/pyproject.toml")}
    assert set(public_names.FACES) == packages


def test_every_error_has_a_cause_and_a_cure(root):
    text = (root / "docs/howto/mistakes.md").read_text()
    rows = re.findall(r"^\| `(\w+)`[^|]*\| ([^|]+) \| ([^|]+) \|$", text, re.MULTILINE)
    classes = {
        name: value
        for module in public_names.MODULES
        if module.endswith(".errors")
        for name, value in vars(importlib.import_module(module)).items()
        if inspect.isclass(value) and issubclass(value, PhysxError) and value is not PhysxError
    }
    assert sorted(name for name, *_ in rows) == sorted(classes)
    told = dict(re.findall(r"^\| `(\w+)` \(([^)]*)\) \|", text, re.MULTILINE))
    for name, listed in told.items():
        for attribute in re.findall(r"`(\w+)`", listed):
            assert re.search(rf"^ +{attribute}:", inspect.getdoc(classes[name]), re.MULTILINE)


def test_the_page_of_figures_is_what_the_benchmarks_say():
    [(path, text)] = figures.PAGE.texts().items()
    assert path.read_text() == text
    for page, table in figures.tables().items():
        assert page.read_text() == figures.with_table(page, table)


def test_the_page_of_troubles_has_all_tests_that_are_marked():
    assert troubles.PAGE.read_text() == troubles.page()
    assert len(list(troubles.reports())) > 30


def test_llms_txt_lists_every_page_and_each_page_is_plain_markdown(root, tmp_path):
    plain_pages.write(tmp_path)
    text = (tmp_path / "llms.txt").read_text()
    assert text.startswith("# physx\n\n> physx connects")
    listed = re.findall(r"^- \[.+\]\((.+\.md)\): \S.+\.$", text, re.MULTILINE)
    pages = {str(page.relative_to(root)) for page in root.glob("docs/**/*.md")}
    pages -= {name for name in pages if name.startswith("docs/_build")}
    assert pages - {"docs/index.md"} <= set(listed)
    for name in listed:
        plain = (tmp_path / name).read_text()
        assert plain.startswith("# ") and not re.search(r"^```\{", plain, re.MULTILINE)
    reference = plain_pages.plain(root / "docs/reference/physx_core.md")
    assert "### Environment(" in reference and "#### Dataset.append(" in reference


def test_the_table_of_engines_is_what_they_say():
    assert engines.PAGE.read_text() == engines.page()
