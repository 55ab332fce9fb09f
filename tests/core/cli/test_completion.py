import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from physx_core.cli import main

pytestmark = pytest.mark.processes

BASH = """
COMP_WORDS=({words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
_physx; printf '%s\\n' "${{COMPREPLY[@]}}"
"""
ZSH = """
words=({words}); CURRENT=$#words
_physx
"""
COMPSYS = """
compdef() {{ :; }}
compadd() {{
    local -a fitting=(${{(M)${{(P)2}}:#$words[CURRENT]*}})
    print -rl -- $fitting
    (( $#fitting ))
}}
_files() {{ :; }}
"""


@pytest.fixture(params=["bash", "zsh"])
def complete(request, capsys):
    """Return what a shell proposes for the last of some words."""
    shell = request.param
    if shutil.which(shell) is None:
        assert not os.environ.get("CI"), f"{shell} is missing"
        pytest.skip(f"{shell} is not installed")
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out

    def propose(words):
        before, call = ("", BASH) if shell == "bash" else (COMPSYS.format(), ZSH)
        flags = ["--norc"] if shell == "bash" else ["-f"]
        text = before + script + call.format(words=words)
        folder = Path(sys.executable).parent  # where `physx` is, which the script asks
        path = {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}
        done = subprocess.run(
            [shell, *flags, "-c", text], capture_output=True, text=True, env=os.environ | path
        )
        assert done.stderr == ""
        return done.stdout.split()

    return propose


KINDS = ["backend", "environment", "format", "launcher", "network", "plugin", "visualizer"]
FORMATS = ["npz", "parquet", "csv", "safetensors", "vtkhdf", "minari", "lerobot", "zarr"]
FORMATS += ["hdf5-single"]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("physx gen", ["generate"]),
        ("physx comple", ["completion"]),
        ("physx stats --te", ["--tensorboard"]),
        ("physx generate --environment.num", ["--environment.num-clients"]),
        ("physx new ba", ["backend"]),
        ("physx generate toy/", ["toy/spring"]),
        ("physx train sessions/a --online physx/f", ["physx/fifo"]),
        ("physx stats sess", []),
        ("physx stats ''", []),
    ],
)
def test_a_shell_completes_commands_options_and_values(complete, words, found):
    assert complete(words) == found


@pytest.fixture
def after(capsys):
    """Return what may follow some words, by what `physx completion after` prints."""

    def after(words):
        assert main(["completion", "after", *words.split()]) == 0
        return capsys.readouterr().out.split()

    return after


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("completion", ["bash", "zsh"]),
        ("new", KINDS),
        ("export --to", FORMATS),
        ("export --to =", FORMATS),
        ("train --on-nan", ["stop", "continue"]),
        ("train --checkpoint-every", ["epoch"]),
        ("train --network.optimizer-kwargs a=1 b=2 --on-nan", ["stop", "continue"]),
        ("train --network.optimizer-kwargs a=1", []),
        ("train --epoch-nb", []),
        ("train --network.loss", []),
        ("train --online", ["physx/stream", "physx/reservoir", "physx/window", "physx/fifo"]),
    ],
)
def test_only_values_follow_an_option_that_takes_some(after, words, found):
    assert [word for word in after(words) if not word.startswith("--")] == found
    assert words in ("completion", "new") or not any("--" in word for word in after(words))


def test_arguments_follow_commands_and_options_that_are_complete(after):
    assert {"generate", "completion"} <= {*after("")}
    assert {"toy/spring", "external/program", "--batch-nb"} <= {*after("generate")}
    assert "toy/spring" not in after("generate toy/spring")
    assert "formats/npz" in after("import file folder --from")
    assert {"toy/spring", "--resume"} - {*after("train --online physx/fifo")} == {"toy/spring"}
    assert "toy/spring" in after("predict sessions/training --no-record")
    assert "toy/linear" in after("train --resume --network.network")
    assert {"toy", "toy/linear", "physx/sobol", "--kind"} <= {*after("check")}
    assert "sampler" in after("check --kind")
    assert after("nonsense") == []


@pytest.mark.slow
def test_each_option_that_takes_a_component_is_known(after, capsys):
    """What their help calls a reference is a component, or of the network's library."""
    others = {"loss", "metrics", "optimizer", "scheduler"}
    for command in after(""):
        main([command, "--help"])
        found = re.findall(r"(--[\w.-]+) \[?REFERENCE", capsys.readouterr().out)
        for option in found:
            if option.rpartition(".")[2].removeprefix("--") not in others:
                assert after(f"{command} {option}") or "visualizer" in option, (command, option)


def test_other_shells_are_named_as_unknown(capsys):
    assert main(["completion", "fish"]) == 1
    assert "bash or zsh, not fish" in capsys.readouterr().err
