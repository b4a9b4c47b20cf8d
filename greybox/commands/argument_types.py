"""What an argument takes, read off how its help writes it: files of a kind, or names of a list."""

from __future__ import annotations

import argparse
from enum import StrEnum


class Kind(StrEnum):
    """What the values of an argument are."""

    VESSEL = "vessel"
    LOG = "log"
    RAW = "raw"
    MODEL = "model"
    PAGE = "page"
    TABLE = "table"
    FILE = "file"
    FOLDER = "folder"
    STRUCTURE = "structure"
    CAUSE = "cause"
    PARAMETER = "parameter"
    OTHER = "other"


_METAVARS = {
    "V": Kind.VESSEL,
    "LOG": Kind.LOG,
    "RAW": Kind.RAW,
    "MODEL": Kind.MODEL,
    ("A", "B"): Kind.MODEL,
    "HTML": Kind.PAGE,
    "CSV": Kind.TABLE,
    "PLAN": Kind.TABLE,
    "F": Kind.FILE,
    "FILE": Kind.FILE,
    "DIR": Kind.FOLDER,
    "NAME=LOW:HIGH": Kind.PARAMETER,
    "NAME=VALUE:STD": Kind.PARAMETER,
    "NAME=STD": Kind.PARAMETER,
}
_NAMED = {
    "structure": Kind.STRUCTURE,
    "compare_structures": Kind.STRUCTURE,
    "causes": Kind.CAUSE,
    "want": Kind.PARAMETER,
}
_PATHS = frozenset(_METAVARS.values()) - {Kind.PARAMETER}
# as greybox.vessel.toml knows them, which takes long to load
EXAMPLE_VESSELS = ("thesis", "ferry")
_OUTPUTS = ("out", "json", "report", "sheet", "legs", "save_model")


def kind_of(action: argparse.Action) -> Kind:
    """Return what the values of an argument are."""
    if action.dest in _NAMED:
        return _NAMED[action.dest]
    if action.type is not None:
        # a number, whatever letter stands for it
        return Kind.OTHER
    return _METAVARS.get(action.metavar or "", Kind.OTHER)


def is_path(action: argparse.Action) -> bool:
    """Whether the values of an argument are names of files or folders."""
    return kind_of(action) in _PATHS


def is_output(action: argparse.Action) -> bool:
    """Whether the argument names what is written."""
    return action.dest in _OUTPUTS
