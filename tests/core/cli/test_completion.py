import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from physx_core.cli import main

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
compadd() {{ print -rl -- ${{(M)${{(P)2}}:#$words[CURRENT]*}}; }}
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


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("physx gen", ["generate"]),
        ("physx com", ["completion"]),
        ("physx stats --te", ["--tensorboard"]),
        ("physx generate --environment.num", ["--environment.num-clients"]),
        ("physx stats sess", []),
    ],
)
def test_a_shell_completes_commands_and_options(complete, words, found):
    assert complete(words) == found


def test_other_shells_are_named_as_unknown(capsys):
    assert main(["completion", "fish"]) == 1
    assert "bash or zsh, not fish" in capsys.readouterr().err
