import pytest

from physx_core import plugins
from physx_core.cli import main
from physx_core.origin import install_hint
from physx_core.plugins import Plugin
from physx_sim import Backend, RobotInfo


class Engine(Backend):
    def build(self, world, seed=None):
        raise NotImplementedError

    def robots(self):
        from pathlib import Path

        broken = RobotInfo("broken", Path("b.urdf"), error="it has no link:\nmore")
        return [RobotInfo("arm", Path("a.urdf"), 7, 12.5, "meshes", ("slow: 3", "odd")), broken]


@pytest.fixture
def only(monkeypatch):
    """Let a plugin with these backends be all that is installed."""

    def only(**backends):
        info = plugins.PluginInfo("own", ("own 1",), "own")
        monkeypatch.setattr(plugins, "available", lambda: {"own": info})
        monkeypatch.setattr(plugins, "load", lambda name: Plugin(info, {"backend": backends}))
        monkeypatch.setattr(plugins, "resolve", lambda kind, name: backends[name[4:]]())

    return only


def test_robots_of_all_backends_are_listed_once(only, capsys):
    only(first=Engine, second=Engine)
    assert main(["robots"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["arm", "7", "12.5", "meshes", "slow:", "3;", "odd"]
    assert lines[2].split(maxsplit=1)[1] == "cannot be loaded: it has no link"
    assert len([line for line in lines if line.startswith("arm")]) == 1


def test_without_backends_it_names_the_package_to_install(only, capsys):
    only()
    assert main(["robots"]) == 0
    assert install_hint("physx-dart") in capsys.readouterr().out


def test_it_takes_no_options(capsys):
    assert main(["robots", "--fast"]) == 1
    assert "takes no arguments" in capsys.readouterr().err
    assert main(["robots", "--help"]) == 0
    assert "usage: physx robots" in capsys.readouterr().out
