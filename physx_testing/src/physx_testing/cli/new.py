"""``physx new``: create a plugin package that installs and passes the contract kit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata, resources
from pathlib import Path
from string import Template
from typing import Annotated, Literal

import tyro

from physx_core import __version__, plugins
from physx_core.cli import options_from, show
from physx_core.errors import ConfigError
from physx_core.files import create_folder, make_folder, remove_folder, rename

_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_TEMPLATES = resources.files("physx_testing.cli") / "templates"


@dataclass(frozen=True)
class _Part:
    """A component of a new plugin.

    Attributes:
        summary: Short description.
        tried: Commands to try it with.
        check: How the contract kit is called in the test.
        options: The same as options of ``physx check``.
        requires: Distributions that it needs.
        kit: Module of the function that checks it.
    """

    summary: str
    tried: str
    check: str = "check_$kind($class_name)"
    options: str = ""
    requires: tuple[str, ...] = ("physx-core",)
    kit: str = "physx_testing"


_GENERATE = "physx generate $name --batch-nb 10 --batch-size 100 --environment.num-clients 2"
_TRAIN = (
    "physx train sessions/data_generation --network.network $name --network.loss MSELoss \\\n"
    "    --network.optimizer Adam --network.lr 0.01 --epoch-nb 5 --batch-size 50"
)
_SPRING = "physx generate toy/spring --batch-nb 10 --batch-size 100"
_PARTS = {
    "environment": _Part("a simulated cart", _GENERATE),
    "network": _Part(
        "a two-layer network",
        f"{_SPRING}\n{_TRAIN}",
        "check_network($class_name, fields=FIELDS)",
        " --fields state=2 force=1 next_state=2",
        ("physx-core", "physx-torch"),
    ),
    "visualizer": _Part(
        "a visualizer that writes a text file", f"{_SPRING} --environment.visualizer $name"
    ),
    "launcher": _Part(
        "a launcher of clients with a low priority",
        f"{_SPRING} \\\n    --environment.launcher $name --environment.num-clients 2",
    ),
    "format": _Part(
        "a file format for datasets",
        f"{_SPRING}\nphysx export sessions/data_generation spring.txt --to $name\n"
        "physx import spring.txt spring",
        "next(check_plugin('$name', kind='format'))".replace("'", '"'),
        requires=("physx-core", "physx-formats"),
    ),
    "backend": _Part(
        "a physics engine for articulated rigid bodies, without contacts",
        'python -c "\n'
        "from physx_core import plugins\n"
        "from physx_sim import Sphere, World\n\n"
        "world = World(objects=[Sphere(name='ball', radius=0.1, position=(0, 0, 1))])\n"
        "with plugins.resolve('backend', '$name').build(world) as simulation:\n"
        "    simulation.step(100)\n"
        "    print(simulation.body_poses(['ball']))\n"
        '"',
        requires=("physx-core", "physx-sim"),
        kit="physx_sim.conformance",
    ),
}
_FIELDS = """
FIELDS = [Field("state", (2,)), Field("force", (1,)), Field("next_state", (2,))]"""
_KINDS = {kind: (kind,) for kind in _PARTS} | {"plugin": ("environment", "network")}


@dataclass
class New:
    """Create a new plugin's repository, which installs, passes the contract kit, and has a README.

    A `plugin` contains an environment and a network that learns from it. You can add more
    components to any of them.
    """

    kind: tyro.conf.Positional[
        Literal["environment", "network", "visualizer", "launcher", "format", "backend", "plugin"]
    ]
    """What the plugin contains."""
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
    """Name by which users select the plugin, such as wave-tank."""
    folder: Path = Path()
    """Folder in which to create the plugin's folder, physx-NAME."""


def run(words: Sequence[str]) -> None:
    """Write the files and print what to do next."""
    options = options_from(New, words, "new")
    name = options.name
    _check_name(name)
    target = options.folder / f"physx-{name}"
    if target.exists():
        raise ConfigError(f"{target} already exists. Choose another name or --folder.")
    try:
        _write(target, _render(name, _KINDS[options.kind]))
    except OSError as error:
        raise ConfigError(f"{target} cannot be written: {error.strerror or error}.") from error
    show(f'wrote: {target}\nnext: cd {target} && pip install -e ".[test]" && pytest')


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f'NAME is "{name}" but must consist of lowercase letters, digits, and single hyphens '
            "between them, and begin with a letter, as in wave-tank."
        )
    taken = plugins.available()
    if name in taken:
        owners = " and ".join(taken[name].distributions)
        raise ConfigError(f'There is already a plugin "{name}": it is part of {owners}.')
    owner = plugins.official_package(name)
    if owner or _is_installed(owner := f"physx-{name}"):
        raise ConfigError(f'"{name}" is the name of {owner}. Choose another.')


def _is_installed(distribution: str) -> bool:
    try:
        metadata.distribution(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _render(name: str, kinds: Sequence[str]) -> dict[str, str]:
    """Return the plugin's files: path to content."""
    package = f"physx_{name.replace('-', '_')}"
    camel = name.title().replace("-", "")
    parts = [_PARTS[kind] for kind in kinds]
    common = {"name": name, "package": package, "distribution": f"physx-{name}"}
    each = [
        {**common, "kind": kind, "class_name": camel.removesuffix(kind.title()) + kind.title()}
        for kind in kinds
    ]

    def fill(template: str, values: dict[str, str]) -> str:
        text = (_TEMPLATES / f"{template}.template").read_text(encoding="utf-8")
        return Template(text).substitute(values)

    requires = list(dict.fromkeys(one for part in parts for one in part.requires))
    summary = "A physx plugin: " + " and ".join(part.summary for part in parts) + "."
    listed = "\n".join(
        f"| `src/{package}/{kind}.py` | `{values['class_name']}`: {part.summary} |"
        for kind, part, values in zip(kinds, parts, each, strict=True)
    )
    whole = common | {
        "summary": summary,
        "dependencies": ", ".join(f'"{one}>={_since()},<1"' for one in requires),
        "usage": Template(_usage(kinds)).substitute(common),
        "contents": listed,
        "options": "".join(part.options for part in parts),
    }
    tests = [
        fill("test.py", values | {"check": Template(part.check).substitute(values)})
        for part, values in zip(parts, each, strict=True)
    ]
    imports: list[str] = []
    kits: dict[str, list[str]] = {}
    for values, part in zip(each, parts, strict=True):
        kit = "check_plugin" if "check_plugin" in part.check else f"check_{values['kind']}"
        kits.setdefault(part.kit, []).append(kit)
        if "$class_name" in part.check:
            imports += [f"from {package}.{values['kind']} import {values['class_name']}"]
    head = ['"""The components fulfill the contracts that physx and its users rely on."""\n']
    head += ["from physx_core import Field"] if "network" in kinds else []
    head += [f"from {module} import {', '.join(names)}" for module, names in kits.items()]
    head += imports
    head += [_FIELDS] if "network" in kinds else []
    source = f"src/{package}"
    return {
        "pyproject.toml": fill("pyproject.toml", whole),
        "README.md": fill("README.md", whole),
        ".gitignore": fill("gitignore", whole),
        f"{source}/__init__.py": "",
        f"{source}/plugin.py": fill("plugin.py", whole)
        + "".join(fill("hook.py", values) for values in each),
        "tests/test_contract.py": "\n".join(head) + "\n" + "".join(tests),
    } | {f"{source}/{values['kind']}.py": fill(f"{values['kind']}.py", values) for values in each}


def _since() -> str:
    """Return the first version that the plugin works with: this one, without its last number."""
    return __version__.rpartition(".")[0]


def _usage(kinds: Sequence[str]) -> str:
    return f"{_GENERATE}\n{_TRAIN}" if len(kinds) > 1 else _PARTS[kinds[0]].tried


def _write(target: Path, files: dict[str, str]) -> None:
    """Write the files to a hidden folder, and rename it when it is complete."""
    hidden = target.with_name(f".{target.name}.new")
    make_folder(target.parent)
    remove_folder(hidden)  # left by a killed process
    create_folder(hidden)
    try:
        for name, text in files.items():
            make_folder((hidden / name).parent)
            (hidden / name).write_text(text, encoding="utf-8")
        rename(hidden, target)
    except BaseException:
        remove_folder(hidden)
        raise
