"""Creates a pipeline from a TOML file and the options of the command line."""

from __future__ import annotations

import copy
import dataclasses
import functools
import textwrap
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from physx_core.cli.arguments import argument_registry, take_changes
from physx_core.cli.options import docstrings, set_help
from physx_core.config import configuration_in, from_plain, read_toml, set_option
from physx_core.errors import (
    ConfigFileError,
    SessionError,
    UnknownOptionError,
    UsageError,
    listed,
)
from physx_core.pipelines.pipeline import Pipeline
from physx_core.session import Session

P = TypeVar("P", bound=Pipeline)

_ONE_ARGUMENT = """\
NAME=VALUE ... gives all arguments of a component. `--{option}.NAME VALUE`
changes one, and the others stay. Values are written as in TOML; words need no quotes."""


def pipeline_from(
    make: type[P],
    verb: str,
    places: Sequence[str],
    words: Sequence[str],
    given: Mapping[str, Any] | None = None,
    *,
    arguments: str,
    examples: Sequence[str],
) -> P:
    """Create a pipeline from the words of a command line.

    Args:
        make: The pipeline's class.
        verb: The command, for messages.
        places: Options that take the leading words without a dash, for example
            ``environment.environment``.
        words: The words after the command. ``--config FILE`` names a TOML file, or a session that
            has one. The table of the pipeline's kind contains options; words override them, and
            ``--network.network-kwargs.NAME VALUE`` overrides one argument.
        given: Table of options that apply unless the file contains them.
        arguments: Names of the leading words without a dash, for the help.
        examples: Typical command lines without the command, for the help.
    """
    table, rest = _take_file(make, list(words))
    table = {**(given or {}), **table}
    rest = _name_positionals(verb, places, rest)
    defaults = _nested_defaults(make, table, rest)
    options = _options_of(make, defaults, rest)
    changes, rest = take_changes(rest, functools.partial(_argument_path, make))
    known = {name for name, _, _ in options} | defaults.keys()
    unknown = table.keys() - known
    if unknown:
        raise UnknownOptionError(f"The table [{make.kind}]", unknown, known)
    form = dataclasses.make_dataclass(verb, options, kw_only=True)
    about = textwrap.dedent(make.__doc__ or "").split("\n\n")[0].replace("``", "")
    lines = "\n".join(f"  physx {verb} {example}" for example in examples)
    kwargs = "network.network-kwargs" if "network" in known else "environment.env-kwargs"
    about += f"\n\nexamples:\n{lines}\n\n{_ONE_ARGUMENT.format(option=kwargs)}"
    asks = not {"-h", "--help"}.isdisjoint(rest)
    with argument_registry():
        prog = f"physx {verb} {arguments}" if asks else f"physx {verb}"
        chosen: Any = tyro.cli(form, args=rest, prog=prog, description=about)
    values = {name: getattr(chosen, name) for name, _, _ in options}
    for place in dict.fromkeys(path[0] for _, path, _ in changes):
        tables = _opened(values[place])
        for option, path, value in changes:
            if path[0] == place:
                set_option(option, tables, path[1:], value)
        values[place] = _closed(values[place], tables)
    return make(**{_python_name(make, name): value for name, value in values.items()})


def _argument_path(make: type[Any], option: str) -> tuple[str, ...] | None:
    """Return the path of the argument that ``--OPTION.NAME`` names; None: it names none.

    The path consists of the pipeline's option, those of its configurations if it is one, and the
    argument, followed by names in its table, if any.
    """
    first, *others = option.removeprefix("--").split(".")
    place, path = first.replace("-", "_"), others
    hints = {_option_name(name): hint for name, hint in typing.get_type_hints(make).items()}
    found = [place]
    while (configuration := configuration_in(hints.get(found[-1]))) is not None and path:
        found.append(path.pop(0).replace("-", "_"))
        hints = typing.get_type_hints(configuration)
    hint = hints.get(found[-1])
    takes_table = any(typing.get_origin(h) is dict for h in (hint, *typing.get_args(hint)))
    if not takes_table or not path:
        return None
    if not all(path):
        raise UsageError(f"{option} names no argument: write {option.rstrip('.')}.NAME VALUE.")
    return (*found, path[0].replace("-", "_"), *path[1:])


def _opened(config: Any) -> Any:
    """Return a copy of a table, or the options of a configuration, nested ones too, as a table."""
    if not dataclasses.is_dataclass(config):
        return copy.deepcopy(config)
    names = [option.name for option in dataclasses.fields(config) if option.init]
    return {name: _opened(getattr(config, name)) for name in names}


def _closed(config: Any, tables: Any) -> Any:
    """Return a table, or a configuration with the options in a table."""
    if not dataclasses.is_dataclass(config):
        return tables
    given = {name: _closed(getattr(config, name), value) for name, value in tables.items()}
    return dataclasses.replace(config, **given)  # type: ignore[type-var]


def take_session(words: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Return the session folder that the first word names, if any, and the words as options.

    Args:
        words: The words after the command.
    """
    if not words or words[0].startswith("-"):
        return None, list(words)
    folder = Path(words[0])
    folder = folder if folder.name not in ("", "..") else folder.resolve()
    named = ["--session-dir", str(folder.parent), "--session-name", folder.name]
    return folder, [*words[1:], *named]


def resumed(words: Sequence[str]) -> list[str]:
    """Return the words of a command that resumes the session that the first of them names.

    Args:
        words: The words after the command, one of which is ``--resume``.

    Raises:
        SessionError: If the session does not exist, or has nothing to resume.
    """
    session, words = take_session(words)
    if session is None:
        return list(words)
    path = Session.existing(session.parent, session.name).path
    if not (path / "config.toml").exists():
        raise SessionError(
            f"The run of {path} ended before it began, so there is nothing to go on with: start it "
            "again with the same options, without --resume."
        )
    given = [] if "--config" in words else ["--config", str(session)]
    return [*given, *words]


def _take_file(make: type[Pipeline], words: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Return the pipeline's table in the ``--config`` file, and the words without that option."""
    words = [part for w in words for part in (w.split("=", 1) if w[:9] == "--config=" else [w])]
    if "--config" not in words:
        return {}, words
    place = words.index("--config")
    if place + 1 == len(words):
        raise UsageError("--config needs the path of a TOML file or a session.")
    path = Path(words[place + 1])
    path = path / "config.toml" if path.is_dir() else path
    tables = read_toml(path)
    if not isinstance(tables.get(make.kind), dict):
        names = [name for name, table in tables.items() if isinstance(table, dict)]
        raise ConfigFileError(f"{path} has no table [{make.kind}]. It has: {listed(names)}.")
    return dict(tables[make.kind]), words[:place] + words[place + 2 :]


def _name_positionals(verb: str, places: Sequence[str], words: list[str]) -> list[str]:
    named: list[str] = []
    count = 0
    while count < len(words) and not words[count].startswith("-"):
        if count == len(places):
            raise UsageError(f'Unexpected argument "{words[count]}": see physx {verb} --help.')
        named += [f"--{places[count].replace('_', '-')}", words[count]]
        count += 1
    return named + words[count:]


def _nested_defaults(
    make: type[Pipeline], table: Mapping[str, Any], words: Sequence[str]
) -> dict[str, Any]:
    """Return the file's configurations, by option name."""
    defaults: dict[str, Any] = {}
    for option in _dataclass_fields(make):
        name = _option_name(option.name)
        if name != option.name and name in table:
            if not isinstance(table[name], Mapping):
                raise ConfigFileError(
                    f'The option "{name}" of the table [{make.kind}] is {table[name]!r} but must '
                    f"be a table: [{make.kind}.{name}]."
                )
            plain = dict(table[name])
            flag = f"--{name}.{name}"  # --environment.environment, --network.network
            if name not in plain and flag in words[:-1]:
                plain[name] = words[words.index(flag) + 1]
            defaults[name] = from_plain(_configuration(make, option.name), plain)
        elif name in table:
            defaults[name] = table[name]
    return defaults


def _options_of(
    make: type[Pipeline], defaults: Mapping[str, Any], words: Sequence[str]
) -> list[tuple[str, Any, Any]]:
    """Return name, type, and default of each option for `dataclasses.make_dataclass`."""
    hints, docs = typing.get_type_hints(make), docstrings(make)
    options: list[tuple[str, Any, Any]] = []
    for option in _dataclass_fields(make):
        name = _option_name(option.name)
        default = option.default
        if option.default_factory is not dataclasses.MISSING:
            default = option.default_factory()
        default = defaults.get(name, default)
        hint = hints[option.name]
        if name != option.name:
            hint = _configuration(make, option.name)
            set_help(hint)
            if default is None:
                asked = any(word.startswith(f"--{name}.") for word in words)
                if name == "environment" and not asked:
                    continue  # optional, but one of its own options is required
                default = dataclasses.MISSING if name == "environment" else hint()
        help_text = tyro.conf.arg(help=docs.get(option.name, ""))
        annotated = Annotated[hint, help_text] if name == option.name else hint
        if isinstance(default, (list, dict)):
            options.append((name, annotated, dataclasses.field(default_factory=default.copy)))
        else:
            options.append((name, annotated, dataclasses.field(default=default)))
    return options


def _dataclass_fields(make: type[Any]) -> list[dataclasses.Field[Any]]:
    return [option for option in dataclasses.fields(make) if option.init]


def _option_name(python_name: str) -> str:
    return python_name.removesuffix("_config")


def _python_name(make: type[Pipeline], name: str) -> str:
    names = [option.name for option in _dataclass_fields(make)]
    return name if name in names else f"{name}_config"


def _configuration(make: type[Pipeline], python_name: str) -> Any:
    hint = typing.get_type_hints(make)[python_name]
    return configuration_in(hint) or hint
