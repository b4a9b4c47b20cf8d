"""`greybox completion`: what Tab offers, and the script that lets a shell ask for it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from greybox.commands.common import say
from greybox.registry import entry_points

_INSTALL = {
    "bash": ('eval "$(greybox completion bash)"', "greybox completion bash >> ~/.bash_completion"),
    "zsh": ('eval "$(greybox completion zsh)"',
            "echo 'eval \"$(greybox completion zsh)\"' >> ~/.zshrc     (after compinit)"),
    "fish": ("greybox completion fish | source",
             "greybox completion fish > ~/.config/fish/completions/greybox.fish"),
}  # fmt: skip
HELP = "print the script that makes Tab complete commands, options, names and files"
EXAMPLES = (
    "examples:\n"
    + "".join(f"  greybox completion {shell}\n" for shell in _INSTALL)
    + "\nto install it, for this shell only and for those to come:\n"
    + "\n".join(f"  {shell:<8}{now}\n{'':10}{ever}" for shell, (now, ever) in _INSTALL.items())
)
# written out, since loading them takes longer than one waits for Tab; tests hold them to the truth
VESSELS = ("thesis", "ferry")
STRUCTURES = ("thesis", "surge", "linear", "blanke", "modulus", "abkowitz", "siso")
CAUSES = tuple("""
    current wind thruster_gain thruster_lag input_delay rate_limit feedback_sampling
    quadratic_thrust advance_speed cubic_damping quadratic_yaw_damping crossflow inertia_coupling
    side_force asymmetry heading_bias lever_arm angle_offset clock_offset sign parameter_change
    waves
""".split())  # fmt: skip
PARAMETERS = tuple(
    "Xu Xvr Xuu Wuu Xmu Xkappa Yv Yur Yvv Yvr Wvv Ymu Nr Nuv Nvv Nvr Wuv Nmu".split()
)
_FOLDER = ("/",)
# the files that an argument names, by its metavar: their endings, none where any will do
_ENDINGS: dict[str | tuple[str, ...] | None, tuple[str, ...]] = {
    "V": ("toml",), "LOG": ("csv", "parquet", "pq"), "RAW": (), "MODEL": ("json",),
    ("A", "B"): ("json",), "D": ("json",), "HTML": ("html",), "CSV": ("csv",), "PLAN": ("csv",),
    "F": (), "FILE": (), "DIR": _FOLDER,
}  # fmt: skip
# a model has thousands; whoever names a log as one still waits no second for Tab
MOST_BYTES = 5_000_000


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

    class Offered(BaseCompleter):
        def __call__(
            self, *, prefix: str, action: argparse.Action, parsed_args: argparse.Namespace, **_: Any
        ) -> Iterable[str]:
            found = endings(action)
            if action.dest in ("structure", "compare_structures"):
                return STRUCTURES
            if action.dest == "causes":
                return (*CAUSES, *(e.name for e in entry_points(group="greybox.causes")))
            if action.dest == "want":
                return _parameters(parsed_args)
            if str(action.metavar).startswith("NAME="):
                return [f"{n}=" for n in _parameters(parsed_args)]
            if found is None or found == _FOLDER:
                return DirectoriesCompleter()(prefix) if found else ()
            return (*(VESSELS if action.metavar == "V" else ()), *FilesCompleter(found)(prefix))

    autocomplete(parser, always_complete_options=False, default_completer=Offered())


def _parameters(given: argparse.Namespace) -> Iterable[str]:
    """Return the parameters of the model that is named, those of (3.51) where it cannot be read."""
    path = Path(getattr(given, "model", None) or getattr(given, "nominal", None) or "")
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        if path.stat().st_size <= MOST_BYTES:
            return tuple(map(str, json.loads(path.read_text(encoding="utf-8"))["names"]))
    return PARAMETERS
