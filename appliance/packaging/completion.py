"""Shell completion as plain words, for bash, zsh and fish.

`appliance --show-completion` asks the command at each key press, which the single file takes a
second for: it is unpacked first. These scripts know the commands and options by themselves.
"""

from __future__ import annotations

import shlex
from pathlib import Path

from appliance.packaging.commands import NAME, Command, Option, tree

_COMMENT = "# Completion of appliance(1), made from its commands."

#: The command that has been typed so far is the longest one that these words name.
_BASH = """\
{comment}
_appliance() {{
    local current=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD-1]}}
    local place={name} words='' i
    for ((i = 1; i < COMP_CWORD; i++)); do
        case "$place ${{COMP_WORDS[i]}}" in
            {places}) place="$place ${{COMP_WORDS[i]}}" ;;
        esac
    done
    COMPREPLY=()
    case "$place $previous" in
{values}
    esac
    case "$place" in
{cases}
    esac
    mapfile -t COMPREPLY < <(compgen -W "$words" -- "$current")
}}
complete -o default -F _appliance {name}
"""

_ZSH = """\
#compdef {name}
{comment}
_appliance() {{
    local place={name}
    local -a commands options
    local -i i
    for ((i = 2; i < CURRENT; i++)); do
        case "$place $words[i]" in
            ({places}) place="$place $words[i]" ;;
        esac
    done
    case "$place $words[CURRENT-1]" in
{values}
    esac
    case $place in
{cases}
    esac
    if [[ $words[CURRENT] == -* ]]; then
        _describe option options
    elif (( $#commands )); then
        _describe command commands
    else
        _files
    fi
}}
_appliance "$@"
"""

_FISH = """\
{comment}
function __appliance_at
    set -l place {name}
    for word in (commandline --tokenize --cut-at-cursor --current-process)[2..]
        contains -- "$place $word" {places}; and set place "$place $word"
    end
    test "$place" = "$argv"
end
"""


def scripts() -> dict[Path, str]:
    """Where Debian's shells look for the script of a package, and its text."""
    share, whole = Path("/usr/share"), tree()
    return {
        share / "bash-completion/completions" / NAME: _bash(whole),
        share / "zsh/vendor-completions" / f"_{NAME}": _zsh(whole),
        share / "fish/vendor_completions.d" / f"{NAME}.fish": _fish(whole),
    }


def _bash(whole: Command) -> str:
    cases, values = [], []
    for command in whole.walk():
        options = " ".join(name for option in command.options for name in option.names)
        below = " ".join(each.name for each in command.commands)
        cases.append(f"        '{command.path}') words='{below}'")
        cases.append(f"            [[ $current == -* ]] && words='{options}' ;;")
        for option in _with_value(command):
            choices = " ".join(option.choices)
            give = f"""mapfile -t COMPREPLY < <(compgen -W '{choices}' -- "$current"); """
            values.append(f"        {_typed(command, option)}) {give if choices else ''}return ;;")
    return _BASH.format(
        comment=_COMMENT,
        name=NAME,
        places=_places(whole, "|"),
        values="\n".join(values),
        cases="\n".join(cases),
    )


def _zsh(whole: Command) -> str:
    cases, values = [], []
    for command in whole.walk():
        cases.append(f"        ('{command.path}')")
        below = [_described(each.name, each.summary) for each in command.commands]
        names = [
            _described(name, option.help) for option in command.options for name in option.names
        ]
        for kind, entries in {"commands": below, "options": names}.items():
            lines = "".join(f"\n                {entry}" for entry in entries)
            cases.append(f"            {kind}=({lines})")
        cases.append("            ;;")
        for option in _with_value(command):
            files = "_files" if option.is_file else f"_message {shlex.quote(option.help)}"
            give = f"compadd {' '.join(option.choices)}" if option.choices else files
            values.append(f"        ({_typed(command, option)}) {give}; return ;;")
    return _ZSH.format(
        comment=_COMMENT,
        name=NAME,
        places=_places(whole, "|"),
        values="\n".join(values),
        cases="\n".join(cases),
    )


def _fish(whole: Command) -> str:
    lines = []
    for command in whole.walk():
        start = f"complete -c {NAME} -n '__appliance_at {command.path}'"
        if command.commands:
            lines.append(f"{start} -f")
        for each in command.commands:
            lines.append(f"{start} -a {each.name} -d {_fish_quoted(each.summary)}")
        for option in command.options:
            names = " ".join(
                f"-l {name[2:]}" if name.startswith("--") else f"-s {name[1:]}"
                for name in option.names
            )
            value = " -r -F" if option.is_file else " -x" if option.value else ""
            if option.choices:
                value += f" -a {_fish_quoted(' '.join(option.choices))}"
            lines.append(f"{start} {names}{value} -d {_fish_quoted(option.help)}")
    script = _FISH.format(comment=_COMMENT, name=NAME, places=_places(whole, " "))
    return script + "\n".join(lines) + "\n"


def _places(whole: Command, between: str) -> str:
    return between.join(f"'{command.path}'" for command in whole.walk() if command is not whole)


def _with_value(command: Command) -> list[Option]:
    return [option for option in command.options if option.value]


def _typed(command: Command, option: Option) -> str:
    return "|".join(f"'{command.path} {name}'" for name in option.names)


def _described(word: str, explained: str) -> str:
    """An entry of zsh's `_describe`, where a colon ends the word."""
    return shlex.quote(word.replace(":", "\\:") + ":" + explained)


def _fish_quoted(text: str) -> str:
    """In single quotes fish takes a backslash before a quote or another, and for nothing else."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
