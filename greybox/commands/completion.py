"""`greybox completion`: what Tab offers, and the script that lets a shell ask for it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from greybox.commands.common import say
from greybox.commands.parser import StoreAction

HELP = "print the script that makes Tab complete commands, options, names and files"
EXAMPLES = """examples:
  greybox completion bash
  greybox completion zsh
  greybox completion fish

to install it, for this shell only and for those to come:
"""
_INSTALL = {
    "bash": ('eval "$(greybox completion bash)"', "greybox completion bash >> ~/.bash_completion"),
    "zsh": ('eval "$(greybox completion zsh)"',
            "echo 'eval \"$(greybox completion zsh)\"' >> ~/.zshrc     (after compinit)"),
    "fish": ("greybox completion fish | source",
             "greybox completion fish > ~/.config/fish/completions/greybox.fish"),
}  # fmt: skip
for _shell, _lines in _INSTALL.items():
    EXAMPLES += f"  {_shell:<8}{_lines[0]}\n{'':10}{_lines[1]}\n"
# written out, since each command asks for a vessel and Tab is to answer at once
VESSELS = ("thesis", "ferry")
_FOLDER = ("/",)
# the files that an argument names, by its metavar: their endings, none where any will do
_ENDINGS: dict[str | tuple[str, ...] | None, tuple[str, ...]] = {
    "V": ("toml",), "LOG": ("csv", "parquet", "pq"), "RAW": (), "MODEL": ("json",),
    ("A", "B"): ("json",), "D": ("json",), "HTML": ("html",), "CSV": ("csv",), "PLAN": ("csv",),
    "F": (), "FILE": (), "DIR": _FOLDER,
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=tuple(_INSTALL), help="the shell to complete in")


def run(options: argparse.Namespace) -> None:
    """Print the script, with how to install it as its last lines."""
    from argcomplete.shell_integration import shellcode

    now, ever = _INSTALL[options.shell]
    script = shellcode(["greybox"], use_defaults=False, shell=options.shell)
    say(f"{script.rstrip()}\n\n# in this shell only:  {now}\n# in those to come:    {ever}")


def endings(action: argparse.Action) -> tuple[str, ...] | None:
    """Return the endings of the files that an argument names, None where it names no file."""
    # with a type it is a number, whatever letter stands for it
    return None if action.type is not None else _ENDINGS.get(action.metavar)


def offer(parser: argparse.ArgumentParser) -> None:
    """Answer the shell that asks, by the protocol of argcomplete, and end the process."""
    from argcomplete import autocomplete
    from argcomplete.completers import BaseCompleter, DirectoriesCompleter, FilesCompleter
    from argcomplete.finders import safe_actions

    # keeping what was typed before the place that is completed has no effect but that
    safe_actions.add(StoreAction)

    class Offered(BaseCompleter):
        def __call__(
            self, *, prefix: str, action: argparse.Action, parsed_args: argparse.Namespace, **_: Any
        ) -> Iterable[str]:
            if action.dest in ("structure", "compare_structures"):
                from greybox.model.catalogue import structure_names

                return structure_names()
            if action.dest == "causes":
                from greybox.diagnosis.causes import known_causes

                return known_causes()
            if action.dest == "want":
                return _parameters(parsed_args)
            if str(action.metavar).startswith("NAME="):
                return [f"{n}=" for n in _parameters(parsed_args)]
            found = endings(action)
            if found is None:
                return ()
            if found == _FOLDER:
                return DirectoriesCompleter()(prefix)
            return (*(VESSELS if action.metavar == "V" else ()), *FilesCompleter(found)(prefix))

    autocomplete(parser, always_complete_options=False, default_completer=Offered())


def _parameters(given: argparse.Namespace) -> Iterable[str]:
    """Return the parameters of the model that is named, those of (3.51) where it cannot be read."""
    from greybox.model.catalogue import get_structure

    path = Path(getattr(given, "model", None) or getattr(given, "nominal", None) or "")
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        return tuple(map(str, json.loads(path.read_text(encoding="utf-8"))["names"]))
    return get_structure("thesis").parameters
