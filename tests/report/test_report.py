"""Reports: one page of a session, from its results, its data, and its network."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Parameter,
    Prediction,
    Result,
    Training,
    View,
    Visualizer,
    evaluate,
)
from physx_core.cli import main
from physx_core.errors import SessionError
from physx_core.pipelines import load_learner
from physx_core.results import PolicyResult, read_results, store_result
from physx_report import Figure, Section, Table, Text, drawing, film, page, write_report
from physx_report.errors import ReportError

pytestmark = pytest.mark.slow

WINDOWS = View(window={"past": ("state", 0), "next": ("state", 1)})


class Painter(Visualizer):
    """Draws a column of pixels for each object, whose height is where it is."""

    @classmethod
    def offscreen(cls, size):
        return cls()

    def open(self, run_name, session_dir, instance_nb):
        self.places = {}

    def events(self, instance_id, step, events):
        for event in (one for several in events for one in several.each()):
            if event.action == "remove":
                del self.places[event.name]
            elif "position" in event.values:
                self.places[event.name] = event.values["position"]

    def capture(self):
        picture = np.zeros((256, 32, 3), np.uint8)
        for column, place in enumerate(self.places.values()):
            picture[: 128 + int(100 * place[0]), 8 * column : 8 * column + 8] = 255
        return picture


class Spring(Environment):
    """A mass on a spring, whose field has a unit that looks like HTML."""

    episode_steps = 12

    def create(self):
        self.define_parameters([Parameter("stiffness", 5.0, 30.0, unit="N/m")])

    def init_database(self):
        self.define_training_fields([Field("state", (2,), unit="<b>m")])

    def init_visualization(self):
        self.factory.add_sphere("mass", radius=0.1)

    def reset_parameters(self, stiffness):
        self.stiffness = stiffness
        self.state = np.array([self.rng.uniform(0.5, 1.0), 0.0])

    def step(self):
        x, v = self.state
        v -= 0.02 * self.stiffness * x
        self.state = np.array([x + 0.02 * v, v])
        self.set_training_data(state=self.state)
        self.factory.update_sphere("mass", position=[self.state[0], 0, 0])


class Angle(Spring):
    """Draws what does not follow from its field by a factor."""

    def step(self):
        super().step()
        self.factory.update_sphere("mass", position=[np.sin(3 * self.state[0]), 0, 0])


class Drawing(Spring):
    """Draws predictions itself."""

    def apply_prediction(self, prediction):
        self.factory.update_sphere("mass", position=[prediction["state"][0], 0, 0])


@pytest.fixture(autouse=True)
def sessions(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def generate(episodes=40, kind=Spring):
    environment = EnvironmentConfig(kind, as_tcp_ip_client=False, seed=1)
    with DataGeneration(environment, episodes=episodes, session_name="data", quiet=True) as run:
        run.execute()


def train(data="sessions/data", view=WINDOWS, reads="past", learns="next", **options):
    network = NetworkConfig("toy/linear", {"net_fields": reads, "opt_fields": learns})
    config = DatasetConfig(existing_dir=data, view=view, normalize=True)
    with Training(
        network, config, epoch_nb=2, batch_size=16, seed=0, session_name="net", quiet=True,
        **options,
    ) as run:  # fmt: skip
        run.execute()


def written(session, **options):
    return write_report(session, **options).read_text()


def text_of(written):
    return re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]+>", " ", written, flags=re.S))


def captions(written):
    return re.findall(r"<figcaption>(.*?)</figcaption>", written)


def test_report_of_a_training_says_how_good_its_network_is_beside_its_rivals():
    generate()
    train()
    written_page = written("sessions/net")
    told = text_of(written_page)
    assert "next: relative error" in told and "against the best rival" in told
    assert "88 samples of 8 of 40 episodes" in told
    assert any(
        all(f"{which} episode: " in text for which in ("Best", "Median", "Worst"))
        for text in captions(written_page)
    )
    assert "next. Error of each episode by parameter (validation)" in captions(written_page)
    assert re.search(r"network predicted [\d,]+ samples per s, their simulation generated", told)
    assert "physx train --config sessions/net/config.toml --session-name again" in told


def test_the_commands_on_a_page_repeat_its_runs():
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
    DataGeneration(spring, batch_nb=2, batch_size=20, session_name="data", quiet=True).execute()
    train(view=View(), reads=["state", "force"], learns="next_state")
    Prediction(NetworkConfig(), spring, session_name="net", step_nb=3, quiet=True).execute()
    told = text_of(written("sessions/data")) + text_of(written("sessions/net"))
    commands = re.findall(r"physx (\w+ --config \S+(?: --session-name again)?)", told)
    assert [each.partition(" ")[0] for each in commands] == ["generate", "train", "predict"]
    for command in commands:
        assert main(command.split()) == 0


def films(written):
    """Return the sizes and numbers of pictures of the films and pictures of a page."""
    found = re.findall(r"data:image/webp;base64,([^\"]+)", written)
    opened = [Image.open(io.BytesIO(base64.b64decode(each))) for each in found]
    return [(each.size, getattr(each, "n_frames", 1)) for each in opened]


def test_a_film_shows_predictions_beside_the_truth(monkeypatch):
    monkeypatch.setattr(film, "_visualizers", lambda: [Visualizer, Painter])
    generate()
    train()
    first = written("sessions/net", trust=True)
    (size, count), *pictures = films(first)
    assert size == (64, 256) and count > 6  # equal pictures in a row are one
    assert pictures == [((64, 256), 1), ((64, 256), 1)]
    known = [text for text in captions(first) if "left: truth; right: prediction" in text]
    assert known[0].startswith("Film of the median episode") and "11 rows" in known[0]
    assert known[1].startswith("Best episode") and known[2].startswith("Worst episode")
    assert written("sessions/net", path="other.html", trust=True) == first
    assert "make the page with --trust" in text_of(written("sessions/net"))


def test_a_page_says_why_there_is_no_film(monkeypatch):
    monkeypatch.setattr(film, "_visualizers", lambda: [Painter])
    generate(kind=Angle)
    train()
    told = text_of(written("sessions/net", trust=True))
    assert "Predictions are not drawn: nothing that the environment draws" in told
    monkeypatch.setattr(film, "_visualizers", list)
    generate()
    train("sessions/data_1")
    told = text_of(written("sessions/net_1", trust=True))
    assert "no plugin is installed that draws pictures without a display" in told


def test_an_environment_that_draws_predictions_is_filmed(monkeypatch):
    monkeypatch.setattr(film, "_visualizers", lambda: [Painter])
    generate(kind=Drawing)
    train(view=View(), reads="state", learns="state")
    first = written("sessions/net", trust=True)
    (size, count), *pictures = films(first)
    assert size == (32, 256) and count > 6  # equal pictures in a row are one
    assert pictures == [((32, 256), 1), ((32, 256), 1)]
    assert "truth and prediction, as the environment draws them" in text_of(first)


def energy(values):
    x, v = values["state"].T
    return values["stiffness"] * x**2 + v**2


def test_report_of_an_evaluation_draws_the_error_of_what_is_fed_back():
    generate()
    train()
    evaluate("sessions/net", invariants=[energy])
    first = written("sessions/net")
    told = text_of(first)
    assert "What becomes of it over time" in told and "the first error" in told
    caption = "next. Error of predictions that are fed back, by row after the beginning of 8"
    assert any(text.startswith(caption) for text in captions(first))
    assert any(text.startswith("energy. How far it moves") for text in captions(first))
    assert written("sessions/net", path="other.html") == first


def test_the_film_of_an_evaluation_shows_predictions_that_are_fed_back(monkeypatch):
    monkeypatch.setattr(film, "_visualizers", lambda: [Painter])
    generate()
    train()
    result = evaluate("sessions/net")
    about = result.rollouts["next"].episode_errors["median"]
    page = written("sessions/net", trust=True)
    shown = next(each for each in page.split("<figure") if "predicted from the first" in each)
    assert f"Film of the median episode, {about.text}" in shown
    learner = load_learner("sessions/net", trust=True)
    with Dataset.open("sessions/data") as dataset:
        state = np.asarray(dataset["training"]["state"][about.about["first_row"]])[None]
    for _ in range(11):
        state = learner.predict({"past": state})["next"]
    content = base64.b64decode(re.search(r"image/webp;base64,([^\"]+)", shown)[1])
    picture = Image.open(io.BytesIO(content))
    picture.seek(picture.n_frames - 1)
    white = np.asarray(picture.convert("L"))[:, 32:36].mean(axis=1) > 128
    assert abs(np.count_nonzero(white) - (128 + 100 * state[0, 0])) < 3


def test_report_of_a_generation_says_what_was_simulated():
    generate()
    told = text_of(written("sessions/data"))
    assert "40 of 40 episodes" in told and "finished 40" in told
    assert "How often parameters, and durations in s, occurred" in told
    assert "physx generate --config sessions/data/config.toml" in told


class Fragile(Spring):
    """Breaks if it is stiff."""

    def step(self):
        if self.stiffness > 20:
            raise ValueError("the spring breaks")
        super().step()


def test_report_of_a_generation_says_why_episodes_failed_and_shows_one(monkeypatch):
    monkeypatch.setattr(film, "_visualizers", lambda: [Painter])
    environment = EnvironmentConfig(Fragile, as_tcp_ip_client=False, seed=1)
    options = {"episodes": 20, "max_failed": 20, "session_name": "data", "quiet": True}
    with DataGeneration(environment, **options) as run:
        run.execute()
    first = written("sessions/data", trust=True)
    told = text_of(first)
    reason = r"step\(\) at step 0: ValueError: the spring breaks \([^)]*\)*\)"
    assert re.search(rf"{reason} \d+ [\d, ]+", told)
    assert re.search(r"[\d,]+ samples per s", told)
    [(size, count)] = films(first)
    assert size == (32, 256) and count > 6
    assert any(re.match(r"Episode \d+, 12 rows, as the environment", t) for t in captions(first))
    assert written("sessions/data", path="other.html", trust=True) == first


def test_report_of_a_policy_shows_rewards_by_seed_beside_actions_without_one(capsys):
    environment = EnvironmentConfig("gym/Pendulum-v1", seed=0, as_tcp_ip_client=False)
    with DataGeneration(
        environment, batch_nb=1, batch_size=50, session_name="data", quiet=True
    ) as run:
        run.execute()
    train(view=View(), reads="observation", learns="action")
    words = ["evaluate", "sessions/net", "--env", "Pendulum-v1"]
    assert main([*words, "--episodes", "8"]) == 0
    assert "random actions: " in capsys.readouterr().out
    assert main([*words, "--episodes", "2", "--rivals", "none", "--json"]) == 0
    assert not json.loads(capsys.readouterr().out)["rivals"]
    assert main(["evaluate", "sessions/net", "--env", "gym/Pendulum-v1", "--episodes", "8"]) == 0
    found = read_results("sessions/net")["evaluation"]
    assert {name: len(each.rewards) for name, each in found.policies.items()} == {
        "Pendulum-v1": 2, "gym/Pendulum-v1": 8,
    }  # fmt: skip
    policy = found.policies["gym/Pendulum-v1"]
    assert policy.seeds == tuple(range(10_000, 10_008))
    assert policy.rivals.keys() == {"zero actions", "random actions"}
    assert found["gym/Pendulum-v1/reward"] == np.mean(policy.rewards)
    first = written("sessions/net")
    told = text_of(first)
    assert "gym/Pendulum-v1: mean reward" in told and "in an episode" in told
    assert any(text.startswith("gym/Pendulum-v1. Reward of each") for text in captions(first))
    assert "physx evaluate sessions/net --env gym/Pendulum-v1 --film sessions/net/film.webp" in told


def test_the_film_of_an_evaluation_is_on_the_page():
    generate(4)
    Image.new("RGB", (8, 8)).save("sessions/data/film.webp")
    rewards = {"seed": [1, 2], "reward": [0.0, 1.0]}
    policy = PolicyResult.of("Swing-v0", "", "network_1", rewards, {}, film="film.webp")
    store_result(
        Path("sessions/data"),
        Result("evaluation", "sessions/data", 1.0, policies={"Swing-v0": policy}),
    )
    assert 'src="data:image/webp;base64,' in written("sessions/data")
    Path("sessions/data/film.webp").unlink()
    assert "Its film: sessions/data/film.webp" in text_of(written("sessions/data"))


def test_report_of_a_sweep_compares_its_trials():
    generate(8)
    Path("sweep.toml").write_text(
        """
        [study]
        seeds = [0, 1]
        [parameters]
        training.batch_size = [8, 16]
        [pipelines.linear.training]
        epoch_nb = 2
        [pipelines.linear.training.dataset]
        existing_dir = "sessions/data"
        [pipelines.linear.training.dataset.view.window]
        past = { field = "state", at = 0 }
        next = { field = "state", at = 1 }
        [pipelines.linear.training.network]
        network = "toy/linear"
        network_kwargs = { net_fields = "past", opt_fields = "next" }
        """
    )
    assert main(["sweep", "sweep.toml"]) == 0
    found = read_results("studies/sweep")["sweep"].sweep
    assert [dict(each.parameters) for each in found.settings] == [
        {"training.batch_size": 8}, {"training.batch_size": 16},
    ]  # fmt: skip
    assert all(each.values.keys() == {"0", "1"} for each in found.settings)
    first = written("studies/sweep")
    told = text_of(first)
    assert "Best: linear, batch_size" in told and "mean of 2 seeds" in told
    assert any("of each trial by parameter" in text for text in captions(first))
    assert "physx sweep studies/sweep/study.toml --study again" in told
    assert written("studies/sweep", path="other.html") == first


def test_equal_sessions_give_equal_pages_without_scripts():
    generate()
    train()
    first = written("sessions/net")
    assert written("sessions/net", path="other.html") == first
    assert "<script" not in first and "http" not in text_of(first)
    for content in re.findall(r"base64,([^\"]+)", first):
        assert "<script" not in base64.b64decode(content).decode()


def test_text_is_never_read_as_html():
    generate()
    train()
    for session in ("sessions/data", "sessions/net"):
        content = written(session)
        assert "<b>" not in content and "&lt;b&gt;m" in content


def test_a_page_says_that_the_samples_are_gone():
    generate()
    train()
    for file in list(Path("sessions/data/dataset").iterdir()):
        file.unlink()
    assert "cannot be run on its samples any more" in text_of(written("sessions/net"))


def test_fields_of_many_components_are_pictures():
    random = np.random.default_rng(0)
    with Dataset.create("grids") as dataset:
        step = np.arange(200)
        fields = [Field("a", (3,)), Field("u", (8, 9)), Field("w", (20,))]
        numbers = [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
        dataset.define_fields("training", [*fields, *numbers])
        rows = {"a": random.normal(size=(200, 3)), "episode": step // 10, "step": step % 10}
        rows["u"] = rows["a"][:, :1, None] * np.ones((8, 9))
        rows["w"] = rows["a"][:, 1:2] * np.ones(20)
        dataset.append("training", rows)
    train("grids", View(), "a", ["u"])
    assert sum(" episode: " in text for text in captions(written("sessions/net"))) == 3


def test_a_section_of_a_plugin_is_on_the_page(monkeypatch):
    generate(4)
    own = Section("Mine <i>", lambda run: [Text([run.path.name]), Table(["x"], [["1"]])], 5)
    monkeypatch.setattr(page, "all_sections", lambda: [own])
    content = written("sessions/data")
    assert "<h2>Mine &lt;i&gt;</h2>" in content and "<td>1</td>" in content


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        (lambda run: 1 / 0, 'section "Mine" of the report failed: ZeroDivisionError'),
        (lambda run: ["text"], "which is no block"),
    ],
)
def test_a_failing_section_is_named(monkeypatch, blocks, message):
    generate(4)
    monkeypatch.setattr(page, "all_sections", lambda: [Section("Mine", blocks)])
    with pytest.raises(ReportError, match=message):
        write_report("sessions/data")


def test_mistakes_are_named(capsys):
    generate(4)
    with pytest.raises(SessionError, match='does not exist. Did you mean "data"'):
        write_report("sessions/dta")
    with pytest.raises(SessionError, match="has no result: .* The folder contains: data"):
        write_report("sessions")
    with pytest.raises(SessionError, match="cannot be written"):
        write_report("sessions/data", "nowhere/else/page.html")
    assert main(["report", "sessions/data", "--output", "page.html"]) == 0
    assert "report: page.html" in capsys.readouterr().out
    read_results("sessions/data")["data_generation"].show()
    assert capsys.readouterr().out == "report: sessions/data/report.html\n"


def test_a_figure_depends_on_its_numbers_alone():
    made = []
    for _ in range(2):
        with drawing.figure("a line") as (found, (axes,)):
            axes.plot([1, 2, 3])
        made += found
    assert made[0] == made[1] == Figure(made[0].svg, "a line")
