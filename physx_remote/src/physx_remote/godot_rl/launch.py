"""The command ``physx-godot-rl``, and launcher files with which a trainer starts it.

``GodotEnv(env_path=FILE)`` runs a file whose name ends with ``.x86_64``, with the flags of a Godot
application. `write_launcher` writes such a file for any environment.
"""

from __future__ import annotations

import shlex
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core import PhysxError
from physx_core.config import reference_of
from physx_core.errors import ConfigError, UsageError
from physx_remote.endpoints import serve
from physx_remote.godot_rl.protocol import PORT, GodotRL
from physx_remote.serving.service import poll_until_interrupted

SUFFIX = ".x86_64"
"""Suffix of the applications that godot-rl starts on Linux."""

COMMAND = "physx-godot-rl"

USAGE = f"""usage: {COMMAND} ENVIRONMENT [FLAGS]

Connects an environment to a godot-rl trainer that listens on this machine, and serves it until the
trainer exits. ENVIRONMENT: "gym/CartPole-v1", "toy/spring", "script.py:Class" ...

  --port=N            port at which the trainer listens, {PORT} by default
  --env_seed=N        seed of the first episodes
  --action_repeat=N   environment steps per step of the trainer, 1 by default
  --num_worlds=N      number of agents, each with its own world, 1 by default
  --timeout=S         time in s to keep trying to reach the trainer, 60 by default
  --NAME=VALUE        any other name: an argument of the environment
  --headless, --disable-render-loop, --fixed-fps N, --speedup=X
                      accepted because godot-rl passes them, without effect: no window is opened,
                      and physics runs as fast as possible, in the environment's own time steps
"""

_WITHOUT_EFFECT = ("headless", "disable-render-loop", "fixed-fps", "speedup")
_NUMBERS = {
    "port": ("port", int),
    "env_seed": ("seed", int),
    "action_repeat": ("action_repeat", int),
    "num_worlds": ("num_worlds", int),
    "timeout": ("timeout", float),
    "fixed-fps": ("fixed-fps", float),
    "speedup": ("speedup", float),
}
"""Flags with a number: the option of `serve` and its type."""


def parse_flags(words: Sequence[str]) -> dict[str, Any]:
    """Parse the flags that godot-rl passes to an application; the last one of each name counts.

    Args:
        words: ``--name=value``, ``--name value`` for a known name, or ``--name``.

    Returns:
        Keyword arguments of `serve`.
    """
    env_kwargs: dict[str, Any] = {}
    given: dict[str, Any] = {"env_kwargs": env_kwargs}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        name, equals, text = word.removeprefix("--").partition("=")
        if not word.startswith("--") or not name:
            raise UsageError(
                f'"{word}" is not a flag: flags are --name=value. See {COMMAND} --help.'
            )
        if name in _NUMBERS:
            option, convert = _NUMBERS[name]
            if not equals:
                text = rest.pop(0) if rest else ""
            try:
                given[option] = convert(text)
            except ValueError:
                raise UsageError(f'--{name} takes a number, not "{text}".') from None
        elif name not in _WITHOUT_EFFECT:
            env_kwargs[name] = _value(text) if equals else True
    for option in _WITHOUT_EFFECT:
        given.pop(option, None)
    return given


def _value(text: str) -> Any:
    """Parse a value written by Python: a TOML value, True, False, None, or a string."""
    words = {"True": True, "False": False, "None": None}
    if text in words:
        return words[text]
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def write_launcher(
    path: str | Path,
    environment: str | type[Any],
    *,
    num_worlds: int = 1,
    action_repeat: int = 1,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Path:
    """Write a file for godot-rl's ``env_path``; flags passed at its start take precedence.

    Args:
        path: File to write; the name must end with ``.x86_64``.
        environment: Reference or class of the environment.
        num_worlds: Number of agents.
        action_repeat: Environment steps per step of the trainer.
        env_kwargs: Arguments of the environment: numbers, booleans and strings.

    Returns:
        The absolute path.

    Raises:
        ConfigError: If godot-rl cannot start a file with this path.
        UsageError: If other processes cannot import the class.
    """
    path = Path(path).absolute()
    if path.suffix != SUFFIX or " " in str(path):
        raise ConfigError(
            f'godot-rl only starts files whose name ends with "{SUFFIX}" and whose path has no '
            f'space, unlike "{path}".'
        )
    reference = reference_of(environment)
    place, colon, name = reference.rpartition(":")
    if colon and place.endswith(".py"):
        reference = f"{Path(place).absolute()}:{name}"
    flags = {"num_worlds": num_worlds, "action_repeat": action_repeat, **(env_kwargs or {})}
    words = [
        *(sys.executable, "-m", __name__, reference),
        *(f"--{key}={value}" for key, value in flags.items()),
    ]
    path.write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n', encoding="utf-8")
    path.chmod(0o755)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status: 0, 1 after an error, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE, end="")  # noqa: T201 - it is a command
        return 0
    try:
        with serve(words[0], GodotRL, **parse_flags(words[1:])) as service:
            poll_until_interrupted(service.poll)
    except PhysxError as error:
        print(f"{COMMAND}: {type(error).__name__}: {error}", file=sys.stderr)  # noqa: T201
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
