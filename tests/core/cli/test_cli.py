import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from physx_core import DataGeneration
from physx_core.cli import main
from physx_core.cli.pipeline_options import pipeline_from

pytestmark = pytest.mark.processes

GENERATE = ["generate", "toy/spring", "--batch-nb", "2", "--batch-size", "10"]
TRAIN = ["train", "nowhere", "--network.network", "toy/linear"]
LOCAL = ["--environment.no-as-tcp-ip-client"]
KEEPS = """
import json
from pathlib import Path
from physx_core import Environment

class Keeps(Environment):
    def __init__(self, *, given, **kwargs):
        super().__init__(**kwargs)
        Path("given.json").write_text(json.dumps(given))
    def create(self):
        pass
    def init_database(self):
        self.define_training_fields([("x", float)])
    def step(self):
        self.set_training_data(x=1.0)
"""


def test_the_main_job_by_commands(capsys):
    assert (
        main([*GENERATE, *LOCAL, "--environment.env-kwargs", "mass=2", "--environment.seed", "3"])
        == 0
    )
    assert "samples: 20 training" in capsys.readouterr().err
    train = ["train", "sessions/data_generation", "--network.network", "toy/linear"]
    assert main([*train, "--epoch-nb", "1", "--batch-size", "5"]) == 0
    assert "training loss" in capsys.readouterr().err
    predict = ["predict", "sessions/training", "toy/spring", "--step-nb", "3", "--record"]
    assert main(predict) == 0
    assert "3 steps with toy/linear" in capsys.readouterr().err
    assert main(["info", "sessions/data_generation"]) == 0
    text = capsys.readouterr().out
    assert "toy/spring" in text and "m, m/s" in text and "{'mass': 2}" in text
    assert main(["info", "sessions/training"]) == 0
    assert "checkpoint network_0: toy/linear, 1 epochs" in capsys.readouterr().out


def test_a_file_gives_options_and_words_replace_them(capsys, tmp_path):
    (tmp_path / "job.toml").write_text(
        "[data_generation]\nbatch_nb = 3\nbatch_size = 4\nsession_name = 'mine'\n"
        "[data_generation.environment]\nenvironment = 'toy/spring'\nas_tcp_ip_client = false\n"
    )
    assert main(["generate", "--config", "job.toml", "--batch-size", "5"]) == 0
    text = capsys.readouterr().err
    assert "samples: 15 training" in text and "sessions/mine" in text
    assert main(["generate", "--config", "sessions/mine/config.toml"]) == 0
    assert "sessions/mine_1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["generat"], 'Did you mean "generate"'),
        ([*GENERATE, "--environment.num-client", "2"], "num-clients"),
        ([*GENERATE, "--environment.num-clients", "0"], "must be at least 1"),
        (["generate", "toy/sprin", *GENERATE[2:]], 'Did you mean "spring"'),
        (["generate", "tooy/spring", *GENERATE[2:]], "install the package"),
        (["generate", *GENERATE[2:]], "environment"),
        ([*GENERATE, "--environment.env-kwargs", "masss=1"], 'Did you mean "mass"'),
        ([*GENERATE, "--config", "none.toml"], "no configuration file"),
        (["generate", "--config"], "needs the path"),
        (["info", "nowhere"], "nowhere"),
        (["info", "--verify"], "needs a folder"),
        (["predict", "sessions/none", "toy/spring"], "no session"),
        ([*TRAIN, "--epoch-nb", "1", "--batch-size", "1"], "nowhere"),
        ([*GENERATE, "--environment.env-kwargs", "mass=[1,", "2]"], "quote it"),
    ],
)  # fmt: skip
def test_mistakes_end_with_one_clear_error(words, message, capsys):
    words = [*words, *LOCAL] if words[0] == "generate" and "--config" not in words else words
    assert main(words) == 1
    text = capsys.readouterr()
    assert message in text.err + text.out
    assert "Traceback" not in text.err


@pytest.mark.parametrize(
    ("table", "environment", "name"),
    [("batch_n = 3", "", "batch_n"), ("", "num_client = 3", "num_client")],
)
def test_misspelt_keys_in_a_file_are_named(table, environment, name, capsys, tmp_path):
    (tmp_path / "job.toml").write_text(
        f"[data_generation]\nbatch_nb = 1\nbatch_size = 1\n{table}\n"
        f"[data_generation.environment]\nenvironment = 'toy/spring'\n{environment}\n"
    )
    assert main(["generate", "--config", "job.toml"]) == 1
    assert f'no option "{name}"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('["state","force"]', ["state", "force"]),
        ("[state,force]", ["state", "force"]),  # what a shell leaves of it
        ("[state, 2, true]", ["state", 2, True]),
        ("[state]", ["state"]),
        ("[3,32,2]", [3, 32, 2]),
        ("state", "state"),
        ("[]", []),
        ("[a,[b]]", "[a,[b]]"),
        ("[a", "[a"),
    ],
)
def test_values_on_the_command_line(text, value):
    Path("kept.py").write_text(KEEPS)
    words = ["generate", "kept.py:Keeps", *LOCAL, "--batch-nb", "1", "--batch-size", "1"]
    assert main([*words, "--environment.env-kwargs", f"given={text}"]) == 0
    assert json.loads(Path("given.json").read_text()) == value


def test_debug_shows_the_traceback(capsys):
    assert main(["info", "nowhere", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_help_ends_well_though_a_library_has_replaced_sys_exit(monkeypatch, capsys):
    leave = sys.exit

    class Hooks:
        def exit(self, code=0):
            leave(code)

    monkeypatch.setattr(sys, "exit", Hooks().exit)
    assert main(["generate", "--help"]) == 0
    assert "usage: physx generate" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("verb", "arguments"),
    [
        ("generate", "[ENVIRONMENT]"),
        ("train", "[DATASET]"),
        ("predict", "[SESSION] [ENVIRONMENT]"),
        ("replay", "[DATASET] [ENVIRONMENT]"),
    ],
)
def test_help_shows_the_arguments_without_names_and_examples(verb, arguments, capsys):
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: physx {verb} {arguments} [-h]")
    assert sum(line.startswith(f"  physx {verb} ") for line in text.splitlines()) == 3


@pytest.mark.parametrize(
    ("verb", "text"),
    [
        ("generate", "None: `num_clients`, which the launcher starts."),
        ("train", "if the dataset has a validation mode or"),
    ],
)
def test_help_breaks_lines_only_where_they_are_full(verb, text, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert main([verb, "--help"]) == 0
    assert text in capsys.readouterr().out


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from physx_core.cli import main; main(['--help']); "
        "heavy = ('torch', 'dartpy', 'pinocchio', 'rerun', 'h5py', 'numpy'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip().endswith("[]")
    code = code.replace("main(['--help'])", "main(['generate', '--help'])").replace(
        ", 'h5py', 'numpy'", ""
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--environment.num-clients" in out.stdout
    assert out.stdout.splitlines()[-1] == "[]"


def test_import_of_the_core_is_light():
    code = (
        "import sys, physx_core; "
        "heavy = ('torch', 'dartpy', 'pinocchio', 'rerun', 'h5py', 'gymnasium', 'numpy'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_module_is_the_command():
    words = [sys.executable, "-m", "physx_core", "--version"]
    out = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ)
    assert out.stdout.startswith("physx 0.")


@pytest.mark.parametrize(
    ("words", "expected"), [([], True), (["True"], True), (["False"], False), (["None"], None)]
)
def test_an_option_that_may_be_left_open_is_switched_on_by_its_name(words, expected):
    made = pipeline_from(
        DataGeneration, "generate", ["environment.environment"],
        ["toy/spring", "--environment.independent-episodes", *words, "--episodes", "2"],
        arguments="ENVIRONMENT", examples=[],
    )  # fmt: skip
    assert made.environment_config.independent_episodes is expected


def test_a_switch_that_is_neither_on_nor_off_is_an_error(capsys):
    assert main(["generate", "toy/spring", "--environment.independent-episodes", "maybe"]) != 0
    assert "neither True nor False" in " ".join(capsys.readouterr().err.split())


FAILS = """
from physx_core import Dataset, Environment

class Fails(Environment):
    def create(self):
        pass
    def init_database(self):
        self.define_training_fields([("x", float)])
    def step(self):
        self.set_training_data(x=[1.0][self.step_index])
"""


@pytest.mark.parametrize("clients", [1, 2])
def test_an_error_names_the_line_of_the_users_own_code(capsys, clients):
    Path("fails.py").write_text(FAILS)
    words = ["generate", "fails.py:Fails", "--batch-nb", "2", "--batch-size", "4"]
    assert main([*words, "--environment.num-clients", str(clients)]) == 1
    line = "self.set_training_data(x=[1.0][self.step_index])"
    said = capsys.readouterr().err
    assert f"IndexError: list index out of range (fails.py:10: {line})" in said
    Path("fails.py").write_text(FAILS.replace("[1.0][self.step_index]", 'Dataset.open("nowhere")'))
    assert main([*words, *LOCAL]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "in step() of instance 1, at fails.py:10" in said


@pytest.mark.slow  # imports all commands
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train x --lr 3", "physx: --lr: did you mean --network.lr?"),
        ("verify x --epoch_nb 3", "physx: --epoch-nb is an option of physx train."),
    ],
)
def test_an_option_of_another_command_or_configuration_is_suggested(capsys, words, said):
    assert main(words.split()) == 1
    assert said in capsys.readouterr().err


def test_info_without_a_folder_names_the_doctor(capsys):
    assert main(["info"]) == 1
    assert "physx doctor" in capsys.readouterr().err


def test_the_list_of_commands_fits_into_80_columns(capsys):
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 20 and max(map(len, lines)) <= 80
