"""What Tab offers for an argument: names that it knows, or files of its kind."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path

from greybox.commands.argument_types import EXAMPLE_VESSELS, Kind, kind_of
from greybox.commands.parser import sub_parsers
from greybox.registry import entry_points

# written out, since loading them takes longer than one waits for Tab; tests hold them to the truth
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
MOST_BYTES = 5_000_000
_SUFFIXES = {
    Kind.VESSEL: ("toml",),
    Kind.MODEL: ("json",),
    Kind.PAGE: ("html",),
    Kind.LOG: ("csv", "parquet", "pq"),
    Kind.TABLE: ("csv",),
}

Completer = Callable[..., Iterable[str]]


def offer(parser: argparse.ArgumentParser) -> None:
    """Answer the shell that asks, by the protocol of argcomplete, and end the process."""
    import argcomplete

    for command in sub_parsers(parser).values():
        for action in command._actions:
            if action.choices is None and action.nargs != 0:
                action.completer = _completer(kind_of(action))  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser, always_complete_options=False)


def _completer(kind: Kind) -> Completer:
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter

    if kind is Kind.OTHER:
        return _listed(())
    if kind is Kind.FOLDER:
        return DirectoriesCompleter()
    if kind is Kind.STRUCTURE:
        return _listed(STRUCTURES)
    if kind is Kind.CAUSE:
        return _listed((*CAUSES, *(e.name for e in entry_points(group="greybox.causes"))))
    if kind is Kind.PARAMETER:
        return _parameters
    files = FilesCompleter(_SUFFIXES.get(kind, ()))
    if kind is not Kind.VESSEL:
        return files
    return lambda prefix, **_: [*_starting(EXAMPLE_VESSELS, prefix), *files(prefix)]


def _starting(names: Iterable[str], prefix: str) -> list[str]:
    return [n for n in names if n.startswith(prefix)]


def _listed(names: Iterable[str]) -> Completer:
    return lambda prefix, **_: _starting(names, prefix)


def _parameters(
    prefix: str, action: argparse.Action, parsed_args: argparse.Namespace, **_: object
) -> list[str]:
    """Return the parameters of the model that was named, or of (3.51)."""
    given = getattr(parsed_args, "model", None) or getattr(parsed_args, "nominal", None)
    names = _names_in(given) if isinstance(given, str) else ()
    sign = "" if kind_of(action) is Kind.PARAMETER and action.metavar == "NAME" else "="
    return [n + sign for n in _starting(names or PARAMETERS, prefix)]


def _names_in(path: str) -> tuple[str, ...]:
    """Return the parameters of a model file, none where it cannot be read."""
    try:
        if Path(path).stat().st_size > MOST_BYTES:
            return ()
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        return tuple(str(n) for n in data["names"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ()
