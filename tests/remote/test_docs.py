"""The page about environments as servers: each of its programs runs."""

from __future__ import annotations

import contextlib
import os
import random
import re
import secrets
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from physx_remote import serve
from physx_remote.godot_gym.communication import Communication
from physx_remote.godot_rl.protocol import GodotRL
from physx_remote.physx.protocol import Physx
from physx_remote.serving.client_link import RequestLink
from physx_remote.serving.protocol import find_protocol

pytestmark = pytest.mark.processes

PAGE = Path(__file__).parents[2] / "docs" / "remote.md"
README = Path(__file__).parents[2] / "physx_remote" / "README.md"
TEXT = PAGE.read_text(encoding="utf-8")
PROJECT = Path(__file__).parent / "programs" / "godot"
SEEN = """
assert seen["positions"].shape == (2,) and seen["positions"].any()
assert env.action_space.contains(env.action_space.sample()) and isinstance(terminated, bool)
"""


def blocks(page):
    """Return the programs of a page."""
    text = page.read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def block(word, address=None, page=PAGE):
    """Return the only program with a word in it, for another address than the page's."""
    (found,) = (each for each in blocks(page) if word in each)
    if address is not None:
        host, port = address
        found, places = re.subn(r'"127\.0\.0\.1:\d+"', f'"{host}:{port}"', found)
        assert places == 1
    return found


def run(text):
    names = {"__name__": "page"}
    exec(compile(text, str(PAGE), "exec"), names)  # noqa: S102 - it is the project's own page
    return names


def test_there_are_no_other_programs():
    words = ("class Pole", "env.reset(seed=1)", "service.poll", "worlds.reset", "write_launcher")
    assert {block(word) for word in (*words, "godot.reset")} == set(blocks(PAGE))
    assert len(blocks(PAGE)) == 6


@pytest.fixture
def pole(in_thread, tmp_path):
    script = tmp_path / "pole.py"
    script.write_text(block("class Pole"), encoding="utf-8")
    return in_thread(f"{script}:Pole")


def test_a_world_of_ones_own_and_its_clients(pole):
    run(block("env.reset(seed=1)", pole.address) + SEEN)
    environment = pole.environment
    assert environment.repeat_action == 1, "configured in the end"
    assert environment.frame_steps == 4
    assert environment.simulation.frame == (2 + 1) * 4
    assert "repeated double positions = 1;" in environment.messages.proto


def test_a_gymnasium_environment(capsys):
    run(block("service.poll"))
    assert "listening at 127.0.0.1" in capsys.readouterr().out


def test_several_worlds(tmp_path, monkeypatch, worlds_in_thread):
    token = tmp_path / "token"
    token.touch(0o600)
    token.write_text(secrets.token_hex(32))
    monkeypatch.chdir(tmp_path)
    service = worlds_in_thread("gym/CartPole-v1", num_worlds=16, token_file="token")
    for page in (PAGE, README):
        names = run(block("worlds.reset", service.address, page))
        assert names["observations"].shape == (16, 4)
        assert names["worlds"].closed


@pytest.fixture
def worlds_in_thread():
    with contextlib.ExitStack() as stack:

        def start(*words, **options):
            service = stack.enter_context(serve(*words, **options))
            thread = threading.Thread(target=service.run)
            thread.start()
            stack.callback(thread.join, 30)
            stack.callback(service.close)
            return service

        yield start


def test_a_trainer_of_godot_rl(tmp_path):
    while True:  # below the ports that the system gives away by itself
        port = random.SystemRandom().randrange(12_000, 30_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            break
    text = block("write_launcher").replace("11008", str(port))
    text += "import os\nprint('saw', len(observations), flush=True)\n"
    text += "os._exit(0)  # without godot-rl's farewell, which takes a second\n"
    done = subprocess.run(
        [sys.executable, "-c", text],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "saw 2" in done.stdout, done.stderr


def test_a_real_godot_application(tmp_path):
    binary = shutil.which("godot3-server")
    if binary is None and os.environ.get("CI"):
        pytest.fail("godot3-server must be there: .ci/run installs Debian's package of that name")
    if binary is None:
        pytest.skip("godot3-server is not installed: it is Debian's package of that name")
    for _ in range(5):  # another program may take the port first: then it ends at once
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        process = subprocess.Popen(
            [binary, "--path", str(PROJECT), f"--port={port}"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path)},
        )
        try:
            if b"listening\n" in iter(process.stdout.readline, b""):
                names = run(block("godot.reset", ("127.0.0.1", port)))
                assert names["seen"]["position"][0] > 0
                return
        finally:
            process.kill()
            process.communicate()
    pytest.fail("the application does not listen")


def test_the_table_of_options_is_complete():
    told = dict(re.findall(r"`?(\w+)=([^,`]*)`", TEXT.split("## Options")[1].split("\n## ")[0]))
    kinds = {
        "godot-gym": Communication,
        "godot-rl": GodotRL,
        "physx": Physx,
        "clients": RequestLink,
    }
    for kind in kinds.values():
        for name, default in kind.__init__.__kwdefaults__.items():
            assert name in told, name
            if told[name]:
                assert told[name].strip('"') == str(default), name
    for protocol in ("godot-gym", "godot-rl", "physx"):
        assert f"`{protocol}`" in TEXT
        assert find_protocol(protocol).name == protocol
