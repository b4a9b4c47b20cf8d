"""`greybox completion`: what Tab offers, and the script that lets a shell ask for it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from greybox.commands.common import say
from greybox.commands.parser import FOLDER, endings, sub_parsers
from greybox.registry import entry_points

_INSTALL = {
    "bash": ('eval "$(greybox completion bash)"', "greybox completion bash >> ~/.bash_completion"),
    "zsh": (
        'eval "$(greybox completion zsh)"',
        "echo 'eval \"$(greybox completion zsh)\"' >> ~/.zshrc     (after compinit)",
    ),
    "fish": (
        "greybox completion fish | source",
        "greybox completion fish > ~/.config/fish/completions/greybox.fish",
    ),
}
HELP = "print the script that makes Tab complete commands, options, names and files"
EXAMPLES = "\n".join(
    [
        "examples:",
        *(f"  greybox completion {shell}" for shell in _INSTALL),
        "\nto install it, for this shell only and for those to come:",
        *(f"  {shell:<8}{now}\n{'':10}{ever}" for shell, (now, ever) in _INSTALL.items()),
    ]
)
# written out, since loading them takes longer than one waits for Tab; tests hold them to the truth
VESSELS = ("thesis", "ferry")
STRUCTURES = ("thesis", "surge", "linear", "blanke", "modulus", "abkowitz", "siso")
CAUSES = (
    "current", "wind", "thruster_gain", "thruster_lag", "input_delay", "rate_limit",
    "feedback_sampling", "quadratic_thrust", "advance_speed", "cubic_damping",
    "quadratic_yaw_damping", "crossflow", "inertia_coupling", "side_force", "asymmetry",
    "heading_bias", "lever_arm", "angle_offset", "clock_offset", "sign", "parameter_change",
    "waves",
)  # fmt: skip
PARAMETERS = (
    "Xu", "Xvr", "Xuu", "Wuu", "Xmu", "Xkappa", "Yv", "Yur", "Yvv", "Yvr", "Wvv", "Ymu",
    "Nr", "Nuv", "Nvv", "Nvr", "Wuv", "Nmu",
)  # fmt: skip
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


def offer(parser: argparse.ArgumentParser) -> None:
    """Answer the shell that asks, by the protocol of argcomplete, and end the process."""
    import argcomplete

    for command in sub_parsers(parser).values():
        for action in command._actions:
            if action.choices is None and action.nargs != 0:
                vars(action)["completer"] = _offered
    argcomplete.autocomplete(parser, always_complete_options=False)


def _offered(
    prefix: str, action: argparse.Action, parsed_args: argparse.Namespace, **_: Any
) -> Iterable[str]:
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    names: Iterable[str] = ()
    metavar, found = action.metavar, endings(action)
    if action.dest in ("structure", "compare_structures"):
        names = STRUCTURES
    elif action.dest == "causes":
        names = (*CAUSES, *(e.name for e in entry_points(group="greybox.causes")))
    elif action.dest == "want":
        names = _parameters(parsed_args)
    elif metavar in ("NAME=LOW:HIGH", "NAME=VALUE:STD", "NAME=STD"):
        names = (f"{n}=" for n in _parameters(parsed_args))
    elif found == (FOLDER,):
        return DirectoriesCompleter()(prefix)
    elif found is not None:
        names = (*(VESSELS if metavar == "V" else ()), *FilesCompleter(found)(prefix))
    return [n for n in names if n.startswith(prefix)]


def _parameters(given: argparse.Namespace) -> tuple[str, ...]:
    """Return the parameters of the model that is named, those of (3.51) where it cannot be read."""
    path = Path(getattr(given, "model", None) or getattr(given, "nominal", None) or "")
    try:
        if path.stat().st_size > MOST_BYTES:
            return PARAMETERS
        return tuple(map(str, json.loads(path.read_text(encoding="utf-8"))["names"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return PARAMETERS
