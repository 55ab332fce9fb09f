"""Results as a session keeps them: one of each pipeline, in a file that people can read too."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from physx_core import files
from physx_core.errors import SessionError
from physx_core.parsing import parse_json, parse_toml
from physx_core.results.result import Result

FILE = "results.json"
_LARGEST, _LARGEST_FINDING = 2**24, 2**26
_WRONG = ValueError, TypeError, AttributeError, LookupError
T = TypeVar("T")


def store_result(session: str | Path, result: Result) -> None:
    """Write a result to a session, in place of that of the last run of the same pipeline.

    Args:
        session: Its folder.
        result: The result.

    Raises:
        SessionError: If the session cannot be written to.
    """
    session = Path(session)
    known = {}
    with contextlib.suppress(OSError, ValueError, AttributeError):  # none yet, or damaged
        for name, each in parse_json(files.read_content(session / FILE, _LARGEST)).items():
            with contextlib.suppress(*_WRONG):  # of another version: the new one matters more
                known[name] = from_plain(Result, each).to_plain()
    try:
        text = json.dumps({**known, result.kind: result.to_plain()}, indent=1, allow_nan=False)
        files.replace(session / FILE, f"{text}\n".encode())
    except OSError as error:
        raise SessionError(f"{session / FILE} cannot be written: {error}.") from error


def read_results(session: str | Path) -> dict[str, Result]:
    """Return the results of a session by the kind of pipeline; empty if there are none.

    Args:
        session: The session's folder.

    Raises:
        SessionError: If the file is damaged.
    """
    path = Path(session) / FILE
    if not path.exists():
        return {}
    try:
        plain = parse_json(files.read_content(path, _LARGEST))
        return {name: from_plain(Result, each) for name, each in plain.items()}
    except (OSError, *_WRONG) as error:
        raise SessionError(f"{path} is damaged: {error}. Remove it.") from error


def store_finding(session: str | Path, name: str, found: Any, seconds: float = 0.0) -> None:
    """Keep what a command found in a session: in a file of its own, and as a result in words.

    Args:
        session: The session's folder, which is made if it does not exist.
        name: Name of the file, as of `write_finding`; without its ending, that of the result.
        found: A dataclass of plain values, in place of what was there; its text becomes the result.
        seconds: How long it took, in s.

    Raises:
        SessionError: If the session cannot be written to.
    """
    path = Path(session) / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_finding(path, found)
    except OSError as error:
        raise SessionError(f"{path} cannot be written: {error}.") from error
    store_result(session, Result(path.stem, path.parent.name, seconds, str(found).splitlines()))


def write_finding(path: str | Path, found: Any) -> None:
    """Write a dataclass of plain values to a file, as JSON if it is called ``*.json``, else TOML.

    Raises:
        OSError: If it cannot be written.
    """
    text = json.dumps(dataclasses.asdict(found), indent=1)
    if not _is_json(path):
        import tomli_w

        text = tomli_w.dumps(_without_none(json.loads(text)))
    files.replace(Path(path), f"{text.rstrip()}\n".encode())


def read_finding(kind: type[T], path: str | Path) -> T:
    """Return what `write_finding` wrote.

    Args:
        kind: The dataclass.
        path: The file.

    Raises:
        ValueError: If it cannot be read, or is no such value.
    """
    parse = parse_json if _is_json(path) else parse_toml
    try:
        found: T = from_plain(kind, parse(files.read_content(Path(path), _LARGEST_FINDING)))
    except (OSError, *_WRONG) as error:
        raise ValueError(f"{error}") from error
    return found


def _is_json(path: str | Path) -> bool:
    return Path(path).suffix == ".json"


def _without_none(plain: Any) -> Any:
    """Return plain data without what TOML has no word for."""
    if isinstance(plain, Mapping):
        return {key: _without_none(each) for key, each in plain.items() if each is not None}
    return [_without_none(each) for each in plain] if isinstance(plain, list) else plain


def from_plain(hint: Any, value: Any) -> Any:
    """Return plain data as a value of a type, of those that results are made of.

    Args:
        hint: A dataclass, or the type of one of its fields: plain types, sequences, mappings.
        value: What `dataclasses.asdict` returned, as JSON keeps it; None stands for NaN.

    Raises:
        ValueError: If it is no such value; also TypeError, AttributeError or LookupError.
    """
    kinds = typing.get_args(hint)
    match typing.get_origin(hint) or hint:
        case typing.Any:
            return value
        case made if dataclasses.is_dataclass(made):
            hints = typing.get_type_hints(made)
            return made(**{name: from_plain(hints[name], each) for name, each in value.items()})  # type: ignore[operator]
        case made if made in (typing.Union, types.UnionType):
            [kind] = [kind for kind in kinds if kind is not type(None)]
            return None if value is None else from_plain(kind, value)
        case made if isinstance(made, type) and issubclass(made, Mapping):
            return {str(name): from_plain(kinds[1], each) for name, each in value.items()}
        case made if isinstance(made, type) and issubclass(made, Sequence) and kinds:
            each_kind = kinds if made is tuple else kinds[:1] * len(value)
            return tuple(from_plain(k, each) for k, each in zip(each_kind, value, strict=True))
        case typing.Literal:
            if value not in kinds:
                raise ValueError(f"{value!r} is none of {kinds}")
        case made if made is float:
            return math.nan if value is None else float(value)
        case made if isinstance(made, type) and not isinstance(value, made):
            raise TypeError(f"{value!r} is not {made.__name__}")
    return value
