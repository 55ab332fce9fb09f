"""``physx completion``: print a completion script for bash or zsh."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence

from physx_core import plugins
from physx_core.cli.arguments import METAVAR
from physx_core.cli.command import main
from physx_core.cli.help_texts import help_of, options_in
from physx_core.errors import PhysxError, UsageError
from physx_core.plugins.kinds import kind_names

_HELP = """usage: physx completion {bash,zsh}

Prints a script that completes commands, options, their values, component
names, and files:
  bash: physx completion bash > ~/.local/share/bash-completion/completions/physx
  zsh:  physx completion zsh > ~/.physx-completion
        echo 'source ~/.physx-completion' >> ~/.zshrc
It calls  physx completion after WORD ...  to learn what may follow, and so
knows all plugins."""

_ASK = r"""# Completes the command physx.
typeset -gA _physx_known
_physx_ask() {  # what may follow "physx" and some words
    [ -n "${_physx_known[-$*]+known}" ] ||
        _physx_known[-$*]=$(physx completion after "$@" 2>/dev/null)
}
"""

_SCRIPTS = {
    "bash": _ASK
    + r"""_physx() {
    local word=${COMP_WORDS[COMP_CWORD]}
    local -a before=("${COMP_WORDS[@]:1:COMP_CWORD-1}") hidden=(-X '-*')
    [ "$word" = "=" ] && word=""
    [[ $word == -* ]] && hidden=()
    _physx_ask "${before[@]}"
    COMPREPLY=($(compgen -W "${_physx_known[-${before[*]}]}" "${hidden[@]}" -- "$word"))
}
complete -o default -F _physx physx
""",
    "zsh": _ASK
    + r"""_physx() {
    local -a before=(${words[2,CURRENT-1]})
    _physx_ask $before
    local -a known=(${(f)_physx_known[-$before]})
    [[ $words[CURRENT] == -* ]] || known=(${known:#-*})
    compadd -a known || (( CURRENT == 2 )) || _files
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _physx physx
""",
}

_KIND_OF = {"online": "buffer", "statistics": "visualizer", "from": "format"}
"""Name of an option to the kind of component that it takes, where the two differ."""
_WORD = re.compile(r"[\w.][\w./@+-]*|--[\w.-]+")
"""Text that a shell takes as a literal word: names in metadata are not trusted."""
_GROUP = re.compile(r"\[-[^][]*(?:\[[^][]*(?:\[[^][]*\])?\])?[^][]*\]|\[OPTIONS\]")


def run(words: Sequence[str]) -> None:
    """Print the script for a shell, or what may follow some words."""
    if words and words[0] in ("-h", "--help"):
        print(_HELP)
    elif words and words[0] == "after":
        found = dict.fromkeys(_after(words[1:]))
        print("\n".join(word for word in found if _WORD.fullmatch(word)))
    elif len(words) == 1 and words[0] in _SCRIPTS:
        print(_SCRIPTS[words[0]], end="")
    else:
        raise UsageError(f"physx completion takes bash or zsh, not {' '.join(words) or 'nothing'}.")


def _after(words: Sequence[str]) -> Iterator[str]:
    """Yield what may follow the command ``physx`` and some words: values, and options."""
    if not words:
        yield from re.findall(r"^  ([a-z][a-z-]*)  ", _help(), re.MULTILINE)
        return
    text = _help(words[0])
    options = dict(options_in(text))
    arguments = [f"{name}." for name, (metavar, _) in options.items() if metavar == METAVAR]
    options |= {f"{name}NAME": ("VALUE", "") for name in arguments}
    option, place = "", 0
    for word in words[1:]:
        if word.startswith("-"):
            parent = next((each for each in arguments if word.startswith(each)), "")
            word = f"{parent}NAME" if parent else word
            option = word if options.get(word, ("", ""))[0] else ""
        elif option and word != "=":
            option = option if "..." in options[option][0] else ""
        else:
            place += word != "="
    if option:
        yield from _values(option, *options[option])
        return
    usage = _GROUP.sub("", text.partition("\n\n")[0]).split()[3:]
    for name in usage[place : place + 1]:
        yield from _values(name.strip("[]").lower(), name, "")
    yield from options


def _help(*command: str) -> str:
    """Return the output of ``--help``."""
    return help_of(lambda words: main([*command, *words]))


def _values(name: str, metavar: str, description: str) -> Iterator[str]:
    """Yield an argument's possible values: choices, components, and words quoted in its help."""
    choices = {each for group in re.findall(r"\{(.*?)\}", metavar) for each in group.split(",")}
    yield from sorted(choices - {"None"})
    name = name.lstrip("-").rpartition(".")[2]
    if name == "kind":
        yield from sorted(kind_names())
    elif (kind := _KIND_OF.get(name, name)) in kind_names():
        yield from _components(kind)
    elif "reference" in name:
        yield from plugins.available()
        for kind in kind_names():
            yield from _components(kind)
    if "STR" in metavar:
        yield from re.findall(r'"([a-z][\w-]*)"', description)


def _components(kind: str) -> Iterator[str]:
    """Yield the references of the components of a kind."""
    for name in plugins.available():
        with contextlib.suppress(PhysxError):  # a broken plugin breaks only itself
            for component in plugins.load(name).components.get(kind, ()):
                yield name if component == name else f"{name}/{component}"
