"""The options of every command, as `options.json` keeps them: none is lost, none changes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from greybox.commands.main import build_parser
from greybox.commands.parser import sub_parsers

KEPT = json.loads(Path(__file__).with_name("options.json").read_text())


def table(parser):
    """Return what each argument takes, by its option strings or its name."""
    excluded = {
        a.dest: [o.dest for o in g._group_actions if o is not a]
        for g in parser._mutually_exclusive_groups
        for a in g._group_actions
    }
    found = {}
    for action in parser._actions:
        name = ", ".join(action.option_strings) or action.dest
        found[name] = {
            # the library's own kind, whatever this shell adds to it
            "action": next(c.__name__ for c in type(action).__mro__ if c.__module__ == "argparse"),
            "dest": action.dest,
            "nargs": action.nargs,
            "const": action.const,
            "default": action.default,
            "choices": None if action.choices is None else list(action.choices),
            "required": action.required,
            "metavar": action.metavar,
            "type": getattr(action.type, "__name__", None),
            "excludes": excluded.get(action.dest, []),
        }
    return json.loads(json.dumps(found))


def tables():
    parser = build_parser()
    return {"": table(parser)} | {n: table(p) for n, p in sub_parsers(parser).items()}


@pytest.fixture(scope="module")
def now():
    return tables()


@pytest.mark.parametrize("command", KEPT)
def test_every_option_takes_what_it_took(now, command):
    kept, found = KEPT[command], now[command]
    assert {n: found.get(n) for n in kept} == kept
