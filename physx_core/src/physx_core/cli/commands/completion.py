"""``physx completion``: print a script that lets bash or zsh complete commands and options."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.errors import UsageError

_HELP = """usage: physx completion {bash,zsh}

Prints a script that completes commands, options, and files:
  bash: physx completion bash > ~/.local/share/bash-completion/completions/physx
  zsh:  physx completion zsh > ~/.physx-completion; echo 'source ~/.physx-completion' >> ~/.zshrc
It asks `physx --help` for what there is, so it knows the commands of all installed plugins."""

_KNOWN = r"""# Completes the command physx.
typeset -gA _physx_known
_physx_ask() {  # what may follow "physx", or a command of it
    [ -n "${_physx_known[-$1]}" ] && return
    if [ -z "$1" ]; then
        _physx_known[-]=$(physx --help 2>/dev/null | sed -n 's/^  \([a-z][a-z-]*\)  .*/\1/p')
    else
        _physx_known[-$1]=$(physx "$1" --help 2>/dev/null | grep -oE -- '--[a-z][a-z0-9._-]*' |
            sort -u)
    fi
}
"""

_SCRIPTS = {
    "bash": _KNOWN
    + r"""_physx() {
    local command=""
    [ "$COMP_CWORD" -gt 1 ] && command=${COMP_WORDS[1]}
    _physx_ask "$command"
    COMPREPLY=($(compgen -W "${_physx_known[-$command]}" -- "${COMP_WORDS[COMP_CWORD]}"))
}
complete -o default -F _physx physx
""",
    "zsh": _KNOWN
    + r"""_physx() {
    local command=""
    (( CURRENT > 2 )) && command=$words[2]
    _physx_ask "$command"
    local -a known=(${(f)_physx_known[-$command]})
    compadd -a known
    (( CURRENT == 2 )) || [[ $words[CURRENT] == -* ]] || _files
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _physx physx
""",
}


def run(words: Sequence[str]) -> None:
    """Print the script for a shell."""
    if words and words[0] in ("-h", "--help"):
        print(_HELP)
        return
    if len(words) != 1 or words[0] not in _SCRIPTS:
        raise UsageError(f"physx completion takes bash or zsh, not {' '.join(words) or 'nothing'}.")
    print(_SCRIPTS[words[0]], end="")
