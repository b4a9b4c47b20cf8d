"""Directives that show commands and their options as the parsers have them.

``options NAME`` shows one command, ``commands`` lists all that are installed, ``other-commands``
shows those that have no page under howto, and ``exclusions`` the options of ``design`` that do not
go together.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from experiment_design.request.exclusions import RULES, spelt
from greybox.commands.main import build_parser


@lru_cache(maxsize=1)
def _commands() -> dict[str, argparse.ArgumentParser]:
    for action in build_parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _written(action: argparse.Action) -> str:
    """Return an argument as one types it."""
    value = "" if action.nargs == 0 else _value(action)
    if not action.option_strings:
        return value
    return f"{', '.join(action.option_strings)} {value}".rstrip()


def _value(action: argparse.Action) -> str:
    name = action.metavar or (
        "|".join(map(str, action.choices)) if action.choices else action.dest.upper()
    )
    if isinstance(name, tuple):
        return " ".join(name)
    return {"+": f"{name} …", "*": f"[{name} …]", "?": f"[{name}]"}.get(str(action.nargs), name)


def _meaning(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    text = parser._get_formatter()._expand_help(action) if action.help else ""
    said = [text] if text else []
    if action.required and action.option_strings:
        said.append("needed")
    if isinstance(action.default, str | int | float) and action.default is not argparse.SUPPRESS:
        default = action.default
        shown = f"{default:g}" if isinstance(default, float) else str(default)
        told = shown in text or isinstance(default, bool)
        if not told:
            said.append(f"default {shown}")
    if isinstance(action, argparse._AppendAction) and "repeat" not in text:
        said.append("may be repeated")
    return "; ".join(said)


def _table(
    head: tuple[str, ...], rows: list[tuple[str, ...]], widths: tuple[int, ...]
) -> nodes.table:
    group = nodes.tgroup("", *(nodes.colspec(colwidth=w) for w in widths), cols=len(widths))
    top, body = nodes.thead(), nodes.tbody()
    for part, lines in ((top, [head]), (body, rows)):
        for left, *others in lines:
            first = nodes.Text(left) if part is top else nodes.literal("", left)
            cells = [
                nodes.entry("", nodes.paragraph("", "", n))
                for n in (first, *map(nodes.Text, others))
            ]
            part += nodes.row("", *cells)
    group += [top, body]
    return nodes.table("", group, classes=["options"])


class Options(SphinxDirective):
    """The arguments of one command, group by group, and its examples."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return tables and examples."""
        name = self.arguments[0]
        if name not in _commands():
            raise self.error(f"there is no command '{name}'")
        return list(_shown(_commands()[name]))


def _shown(parser: argparse.ArgumentParser) -> Iterator[nodes.Node]:
    for group in parser._action_groups:
        rows = [
            (_written(a), _meaning(a, parser))
            for a in group._group_actions
            if a.help is not argparse.SUPPRESS and not isinstance(a, argparse._HelpAction)
        ]
        if rows:
            title = {"positional arguments": "argument", "options": "option"}
            yield _table((title.get(group.title or "", group.title or ""), "meaning"), rows, (2, 5))
    if parser.epilog:
        yield nodes.paragraph("", "Examples:")
        text = parser.epilog.removeprefix("examples:\n").rstrip()
        indent = min(len(x) - len(x.lstrip()) for x in text.splitlines() if x.startswith(" "))
        lines = [x[indent:] if x.startswith(" " * indent) else x for x in text.splitlines()]
        yield nodes.literal_block("", "\n".join(lines), language="console")


class Commands(SphinxDirective):
    """Every installed command with what it does."""

    def run(self) -> list[nodes.Node]:
        """Return one table."""
        rows = [(f"greybox {n}", p.description or "") for n, p in _commands().items()]
        return [_table(("command", "does"), rows, (2, 5))]


class Exclusions(SphinxDirective):
    """The options of ``design`` that are refused beside others, or without what they act on."""

    def run(self) -> list[nodes.Node]:
        """Return one table."""
        rows: list[tuple[str, ...]] = []
        for rule in RULES:
            options, against, needs = (
                " or ".join(map(spelt, names)) for names in (rule.options, rule.against, rule.needs)
            )
            beside = f"beside {against}" if against else f"without {needs}"
            rows.append((options, beside, rule.told(options, against)))
        return [_table(("option", "is refused", "because, and what to do"), rows, (2, 3, 5))]


class OtherCommands(SphinxDirective):
    """The arguments of every installed command without a page under howto."""

    def run(self) -> list[nodes.Node]:
        """Return a section a command."""
        found: list[nodes.Node] = []
        for name, parser in _commands().items():
            if f"howto/{name}" in self.env.found_docs:
                continue
            section = nodes.section("", nodes.title("", name), ids=[f"greybox-{name}"])
            section += [nodes.paragraph("", parser.description or ""), *_shown(parser)]
            found.append(section)
        return found or [nodes.paragraph("", "There are none.")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("options", Options)
    app.add_directive("commands", Commands)
    app.add_directive("exclusions", Exclusions)
    app.add_directive("other-commands", OtherCommands)
    return {"parallel_read_safe": True}
