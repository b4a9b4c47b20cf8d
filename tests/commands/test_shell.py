"""The shell around the commands: help, completion, suggestions, quiet, verbose, colours."""

from __future__ import annotations

import json
import os
import pty
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from virtual import virtual_log, write_csv

from greybox.commands import completion
from greybox.commands.main import build_parser, main
from greybox.commands.parser import sub_parsers
from greybox.files import nearest_file
from greybox.vessel.toml import EXAMPLES, example_vessel, load_vessel

SCRIPT = [sys.executable, "-m", "greybox"]
COMMANDS = {n: p for n, p in sub_parsers(build_parser()).items() if n != "help"}
SHELL = {"help", "more_verbose", "quiet", "no_config"}


def own_actions(parser):
    return [a for a in parser._actions if a.dest not in SHELL]


def examples_of(parser):
    """Return the command lines among the examples, continuation lines joined."""
    text = (parser.epilog or "").replace("\\\n", " ")
    return [" ".join(x.split()) for x in text.splitlines() if x.startswith("  greybox ")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shell")
    write_csv(virtual_log(9, 120), folder / "trial.csv")
    (folder / "ship.toml").write_text(example_vessel("thesis").read_text())
    (folder / "model.json").write_text(json.dumps({"names": ["Xu", "Xuuu", "Yv"]}))
    (folder / "logs").mkdir()
    return folder


def plain_environment(**more):
    kept = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "GREYBOX_CONFIG")}
    return kept | {"TERM": "xterm"} | more


# help


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_sentence_and_examples_that_parse(name):
    parser = COMMANDS[name]
    assert parser.description
    assert "\n" not in parser.description
    examples = examples_of(parser)
    assert len(examples) >= 2
    for line in examples:
        given = shlex.split(line)[1:]
        assert given[0] == name
        build_parser(name).parse_args(given)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained_with_its_default(name):
    for action in own_actions(COMMANDS[name]):
        assert action.help, action.dest
        if action.option_strings and action.default not in (None, False, []):
            shown = action.default
            if isinstance(shown, tuple):
                shown = ",".join(f"{v:g}" for v in shown)
            elif isinstance(shown, float):
                shown = f"{shown:g}"
            assert f"({shown}" in action.help, f"{action.dest}: {action.help}"


def test_help_of_a_command_and_help_help(capsys):
    for given in (["help", "estimate"], ["estimate", "--help"]):
        with pytest.raises(SystemExit) as stop:
            main(given)
        assert stop.value.code == 0
        shown = capsys.readouterr().out
        assert shown.startswith("usage: greybox estimate LOG [LOG ...] --vessel V [OPTION ...]")
        assert "examples:" in shown
    with pytest.raises(SystemExit) as stop:
        main(["help"])
    assert stop.value.code == 0
    assert "commands:" in capsys.readouterr().out


def test_without_a_command_the_help_goes_to_stderr(capsys):
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "commands:" in shown.err


def test_the_parser_imports_nothing_heavy():
    code = (
        "import sys; from greybox.commands.main import build_parser; build_parser()\n"
        "heavy = {'casadi', 'numpy', 'pandas', 'matplotlib', 'scipy', 'rich', 'argcomplete'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)


# suggestions


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("estmate", "command 'estmate' is not known. Did you mean 'estimate'?"),
        ("help estmate", "Did you mean 'estimate'?"),
        ("estimate trial.csv --vesel s", "there is no option '--vesel'. Did you mean '--vessel'?"),
        ("--quiett check", "greybox: there is no option '--quiett'. Did you mean '--quiet'?"),
        ("estimate trial.csv --vessel s --metod ls", "Did you mean '--method'?"),
        ("check a.csv --vessel s --fix", "'--fix', which belongs to 'greybox import'."),
        ("--verison", "greybox: there is no option '--verison'. Did you mean '--version'?"),
        ("simulate m.json --logs a.csv", "'--logs': type 'greybox simulate MODEL LOG --out CSV ["),
        ("check a.csv --vessel s --out b", "'--out': greybox check writes with --json, --report."),
        ("check a.csv --vessel s --cluster c", "there is no option '--cluster'. See"),
        ("compare m.json --vessel s", "'--vessel', as MODEL holds its vessel: leave it out."),
        ("estimate trial.csv --vessel s --method ivv", "Did you mean 'iv'? Known: ls, iv, oe."),
        ("estimate trial.csv --vessel s --mass heavy", "--mass: 'heavy' is no positive number."),
        ("estimate trial.csv --vessel s --seed 1.5", "'1.5' is no whole number of at least 0."),
        ("reproduce chapter8", "study 'chapter8' is not known. Did you mean 'chapter"),
        ("simulate m.json a.csv b.csv --out c", "'b.csv' is one argument too many."),
        (
            "estimate trial.csv",
            "--vessel is missing: vessel file (TOML), as 'greybox import",
        ),
        ("predict model.json", "manoeuvre is missing: the manoeuvre to predict (turning, zigzag, "),
        ("completion bsh", "Did you mean 'bash'?"),
        ("simulate m.json a.csv --out c --start -1,0,0,0", "--start has no value: write it behind"),
        ("compare m.json --log", "--log has no value: write it behind"),
        (
            "design --vessel s --between a.json --out p.csv",
            "--between needs 2 values: two models for the trial to tell apart.",
        ),
        ("reproduce chapter4 --workers -2", "'-2' is no whole number of at least 1."),
    ],
)
def test_wrong_usage_is_one_sentence_with_the_nearest_name(capsys, line, message):
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert re.search(r"See 'greybox( \w+)? --help'\.\n$", error)
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "name", "values"),
    [
        ("compare m.json --log a.csv --log b.csv c.csv", "log", ["a.csv", "b.csv", "c.csv"]),
        ("predict m.json zigzag --angle 10 --angle 20/10", "angle", ["10", "20/10"]),
        ("design --vessel V --out p.csv --want Xu --want Yv", "want", ["Xu", "Yv"]),
        ("predict m.json turning", "angle", []),
        ("estimate a.csv --vessel V --validate b.csv --validate c.csv", "validate",
         ["b.csv", "c.csv"]),
        ("estimate a.csv --vessel V --seed 3 --seed 4", "seed", 4),
        ("design --vessel a --out p --between a b --between c d", "between", ["c", "d"]),
    ],
)  # fmt: skip
def test_an_option_that_takes_several_adds_up_when_it_is_repeated(line, name, values):
    parser = build_parser()
    # twice: what a line gave is no part of the next
    for _ in range(2):
        assert getattr(parser.parse_args(line.split()), name) == values


def test_options_that_take_several_all_add_up():
    for name, parser in COMMANDS.items():
        for action in own_actions(parser):
            if action.option_strings and action.nargs in ("+", "*"):
                values = [str((action.choices or ["x", "y"])[k]) for k in (0, 1)]
                option = action.option_strings[-1]
                alone = parser.for_parts()
                both = vars(alone.parse_args([option, values[0], option, values[1]]))
                assert both[action.dest] == values, f"{name} {option}"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("check trail.csv --vessel ship.toml", "Did you mean 'trial.csv'?"),
        ("check trial.csv --vessel shp.toml", "Did you mean 'ship.toml'?"),
        ("check trial.csv --vessel thesys", "Did you mean 'thesis'?"),
        ("simulate modle.json trial.csv --out x.csv", "Did you mean 'model.json'?"),
        ("compare modle.json --log trial.csv", "Did you mean 'model.json'?"),
        ("estimate trial.csv --vessel ship.toml --structure thesys", "Did you mean 'thesis'?"),
        ("diagnose trial.csv --vessel ship.toml --causes curent", "Did you mean 'current'?"),
        ("diagnose trial.csv --vessel ship.toml --causes lag", "Did you mean 'thruster_lag'?"),
        ("diagnose trial.csv --vessel ship.toml --causes wind,waves", "causes apart, with spaces"),
        (
            "estimate trial.csv --vessel ship.toml --structure thesis+N_|r|q",
            "'N_|r|q' cannot be read at 'q'. Did you mean 'vq'?",
        ),
        ("estimate trial.csv --vessel ship.toml --structure thesis+Nrrr", "Did you mean 'Nr'?"),
        ("estimate trial.csv --vessel ship.toml --structure thesis-Xkapa", "mean 'Xkappa'?"),
    ],
)
def test_names_that_nearly_exist_are_suggested(folder, monkeypatch, capsys, line, message):
    monkeypatch.chdir(folder)
    assert main(line.split()) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("replaced", "by", "message"),
    [
        ('angle = "alpha2"', 'angle = "alpa2"', "no column 'alpa2', which moves a thruster"),
        (None, '"psi [dge]" = { name = "psi", unit = "deg" }', "Did you mean 'psi [deg]'?"),
        (None, '"psi" = { name = "psii", unit = "deg" }', "Did you mean 'psi'?"),
        (None, '"psi" = { name = "psi", unit = "degg" }', "Did you mean 'deg'?"),
        (None, '"psi" = { name = "psi", unti = "deg" }', "Did you mean 'unit'?"),
    ],
)  # fmt: skip
def test_names_in_a_vessel_file_are_suggested(
    folder, tmp_path, monkeypatch, capsys, replaced, by, message
):
    monkeypatch.chdir(tmp_path)
    vessel = (folder / "ship.toml").read_text()
    changed = vessel.replace(replaced, by) if replaced else f"{vessel}\n[columns]\n{by}\n"
    (tmp_path / "ship.toml").write_text(changed)
    log = (folder / "trial.csv").read_text()
    written = log.replace("psi", "psi [deg]", 1) if "[dge]" in by else log
    (tmp_path / "trial.csv").write_text(written)
    assert main(["estimate", "trial.csv", "--vessel", "ship.toml"]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "Did you mean '" in error
    assert error.count("\n") == 1


# options that exclude one another


@pytest.mark.parametrize(
    ("line", "one", "other", "status"),
    [
        ("estimate trial.csv --vessel V --reduce --compare-structures thesis",
         "--reduce", "--compare-structures", 2),
        ("estimate trial.csv --vessel V --structure thesis --compare-structures thesis linear",
         "--structure", "--compare-structures", 1),
        ("diagnose trial.csv --vessel V --model m.json --structure linear",
         "--model", "--structure", 2),
        *((f"estimate trial.csv --vessel V {named} {given}", given.split()[0], told, 1)
          for given, methods in {
              "--instruments mean-kept": "ls oe", "--prefilter none": "ls oe",
              "--heading simulated": "ls", "--nominal m.json": "ls",
              "--process-noise": "ls iv", "--wind simulated": "ls iv", "--loss huber": "ls iv",
              "--weights deviation": "ls iv", "--shooting multiple": "ls iv",
              "--bound Xu=-1:0": "ls iv", "--prior Xu=-1:1": "ls iv",
              "--damping enforce": "ls iv",
          }.items() for named, told in (
              ("", "add --method"),
              *((f"--method {m}", f"--method is {m}") for m in methods.split()))),
        ("estimate trial.csv --vessel V --method oe --margin-u 1", "--margin-u", "--method iv", 1),
        ("import trial.csv --vessel V --out o.csv --fix-not sign", "--fix-not", "--fix", 1),
        ("import trial.csv --vessel V --out o.csv --fix-also sign --fix-not sign",
         "--fix-also", "--fix-not", 1),
        ("import trial.csv --vessel V --out o.csv --window 3", "--window", "--velocities", 1),
    ],
)  # fmt: skip
def test_options_that_exclude_one_another_are_refused(
    folder, tmp_path, monkeypatch, capsys, line, one, other, status
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "trial.csv").write_text((folder / "trial.csv").read_text())
    given = line.replace(" V ", f" {folder / 'ship.toml'} ").split()
    if status == 2:
        with pytest.raises(SystemExit) as stop:
            main(given)
        assert stop.value.code == 2
    else:
        assert main(given) == 1
    error = capsys.readouterr().err
    assert one in error
    assert other in error
    assert error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["trial.csv"]


# completion


BASH = """
source ./script
ask() {
  COMP_LINE="$1"; COMP_POINT=${#COMP_LINE}; COMP_TYPE=9
  COMP_WORDS=($COMP_LINE); [[ "$COMP_LINE" == *" " ]] && COMP_WORDS+=("")
  COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
  _python_argcomplete greybox "${COMP_WORDS[COMP_CWORD]}"
  local IFS=,; echo "${COMPREPLY[*]}"
}
while IFS= read -r line; do ask "$line"; done
"""


@pytest.fixture(scope="module")
def ask(folder):
    """Return what bash offers for lines that are being typed."""
    place = folder / "bin"
    place.mkdir()
    (place / "greybox").write_text(f'#!/bin/sh\nexec {shlex.join(SCRIPT)} "$@"\n')
    (place / "greybox").chmod(0o755)
    made = subprocess.run([*SCRIPT, "completion", "bash"], capture_output=True, text=True,
                          check=True, cwd=folder)  # fmt: skip
    (folder / "script").write_text(made.stdout)
    path = f"{place}{os.pathsep}{os.environ['PATH']}"

    def run(*lines):
        done = subprocess.run(["bash", "-c", BASH], input="\n".join(lines) + "\n", text=True,
                              capture_output=True, check=True, cwd=folder,
                              env=plain_environment(PATH=path))  # fmt: skip
        return [[w.strip() for w in row.split(",")] for row in done.stdout.splitlines()]

    return run


@pytest.mark.skipif(not Path("/bin/bash").exists(), reason="no bash")
def test_bash_completes(ask):
    asked = {
        "greybox es": ["estimate"],
        "greybox estimate --compare": ["--compare-structures"],
        "greybox estimate trial.csv --method ": ["ls", "iv", "oe"],
        "greybox -v help des": ["design"],
        "greybox estimate trial.csv --structure th": ["thesis"],
        "greybox diagnose trial.csv --causes current thr": ["thruster_gain", "thruster_lag"],
        "greybox design --model model.json --want Xuu": ["Xuuu"],
        "greybox estimate trial.csv --bound Nu": ["Nuv="],
        "greybox check tr": ["trial.csv"],
        "greybox compare m": ["model.json"],
        "greybox check trial.csv --vessel ": ["thesis", "ferry", "bin/", "logs/", "ship.toml"],
        "greybox reproduce chapter4 --out l": ["logs/"],
    }
    assert [set(found) for found in ask(*asked)] == [set(found) for found in asked.values()]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_says_how_to_install_it(shell, capsys):
    assert main(["completion", shell]) == 0
    shown = capsys.readouterr().out
    assert "greybox" in shown
    assert "# in those to come:" in shown.splitlines()[-1]


def test_vessels_that_completion_has_by_heart_are_true():
    assert completion.VESSELS == EXAMPLES


# quiet, verbose, colours


def test_quiet_shows_errors_only(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for given in (["-q", "check"], ["check", "-q"]):
        assert main([*given, "trial.csv", "--vessel", "ship.toml", "--json", "c.json"]) == 0
        shown = capsys.readouterr()
        assert shown.out == shown.err == ""
        assert json.loads((folder / "c.json").read_text())["findings"] == []
    assert main(["check", "-q", "trial.csv", "--vessel", "ship.toml", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []
    assert main(["check", "-q", "none.csv", "--vessel", "ship.toml"]) == 1
    assert "there is no file" in capsys.readouterr().err
    # and the next command is not quiet any more
    assert main(["check", "trial.csv", "--vessel", "ship.toml"]) == 0
    assert capsys.readouterr().out


def test_verbose_tells_what_is_read_on_stderr(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    given = ["trial.csv", "--vessel", "ship.toml", "--method", "ls", "--predictor", "basic",
             "--structure", "linear", "--json", "-"]  # fmt: skip
    texts = {}
    for words in ("estimate", "-v estimate", "estimate -v", "-v estimate -v", "estimate -vv"):
        main([*words.split(), *given])
        shown = capsys.readouterr()
        json.loads(shown.out)
        texts[words] = shown.err
    assert texts["estimate"] == ""
    told = re.compile(r"\[ +\d+\.\d\d s\] read trial.csv: 120 rows every 1 s")
    assert told.search(texts["-v estimate"])
    assert told.search(texts["estimate -v"])
    assert "read vessel ship.toml: Thesis ship, 2 thruster(s)" in texts["estimate -v"]
    assert "in this order" not in texts["estimate -v"]
    for most in ("-v estimate -v", "estimate -vv"):
        assert "greybox.selection.estimate: in this order" in texts[most]


def test_verbosity_leaves_no_trace_in_records(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    found = []
    for words in ([], ["-v"], ["-q"], ["--no-config"]):
        assert main([*words, "check", "trial.csv", "--vessel", "ship.toml", "--json", "-"]) == 0
        found.append(capsys.readouterr().out)
    assert len(set(found)) == 1


def test_the_library_is_silent_by_itself(folder):
    code = (
        "import greybox as gb; v = gb.load_vessel('ship.toml'); gb.read_log('trial.csv', v)\n"
        "import logging; assert not logging.getLogger().handlers"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          cwd=folder)  # fmt: skip
    assert done.stdout == done.stderr == ""


@pytest.mark.parametrize("more", [[], ["--no-config"]])
def test_a_folder_that_was_deleted_is_one_sentence(tmp_path, monkeypatch, capsys, more):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["check", "trial.csv", "--vessel", "thesis", *more]) == 1
    told = capsys.readouterr().err
    assert "the folder that this is run in was deleted" in told
    assert told.count("\n") == 1
    with pytest.raises(SystemExit) as ended:
        main(["check", "--help"])
    assert ended.value.code == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
@pytest.mark.parametrize("line", ["check trial.csv --vessel ship.toml", "check --help",
                                  "check trial.csv --vessel ship.toml --json -"])  # fmt: skip
def test_a_full_disk_is_one_sentence(folder, line):
    with open("/dev/full", "w") as full:
        done = subprocess.run([*SCRIPT, *line.split()], stdout=full, stderr=subprocess.PIPE,
                              text=True, cwd=folder)  # fmt: skip
    assert done.returncode == 1
    assert "cannot write an output: No space left on device." in done.stderr
    assert done.stderr.count("\n") == 1


def test_closed_and_poor_streams_end_no_command(folder):
    check = f"{shlex.join(SCRIPT)} check trial.csv --vessel ship.toml"
    for ending in (">&-", "2>&-"):
        done = subprocess.run(f"{check} {ending}", shell=True, capture_output=True, cwd=folder)
        assert done.returncode == 0, done.stderr
    done = subprocess.run([*SCRIPT, "reproduce", "--help"], capture_output=True, text=True,
                          env=plain_environment(PYTHONIOENCODING="ascii"))  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Cram\\xe9r" in done.stdout


@pytest.mark.parametrize("module", ["argparse", "greybox.commands.estimate"])
@pytest.mark.parametrize("as_extension", [False, True])
def test_an_interrupt_while_modules_load_is_no_traceback(module, as_extension):
    code = f"""
import runpy, sys

class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt:
                if {as_extension}:
                    # as an extension module says it
                    raise ImportError("initialization failed")
                raise

sys.meta_path.insert(0, Interrupted())
sys.argv[1:] = ["estimate", "trial.csv"]
runpy.run_module("greybox", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "greybox: stopped\n")


def test_a_name_that_no_output_could_hold_is_refused(tmp_path, capsys):
    name = tmp_path / "F\udce4hrt.csv"
    assert main(["import", str(name), "--vessel", "thesis", "--out", str(tmp_path / "o.csv")]) == 1
    error = capsys.readouterr().err
    assert "bytes that are no UTF-8" in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_names_of_a_damaged_file_break_no_line(tmp_path, monkeypatch, capsys):
    from scipy.io import savemat

    monkeypatch.chdir(tmp_path)
    savemat("raw.mat", {"p\r\n\x1b[2J\x85": [[1.0, 2.0]]})
    assert main(["import", "raw.mat", "--vessel", "thesis", "--out", "log.csv"]) == 1
    said = capsys.readouterr().err
    assert (len(said.splitlines()), said.count("\n"), "\x1b" in said) == (1, 1, False)
    assert "p\\r\\n\\x1b[2J" in said
    assert [p.name for p in tmp_path.iterdir()] == ["raw.mat"]


SAY = "from greybox.commands.terminal import complain, say\n"


def on_a_terminal(code, **environment):
    """Run Python with all its output on a pseudo-terminal, and return what was shown."""
    master, slave = pty.openpty()
    try:
        subprocess.run([sys.executable, "-c", SAY + code], stdout=slave, stderr=slave, timeout=60,
                       env=plain_environment(**environment), check=True)  # fmt: skip
        return os.read(master, 10_000).decode()
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Verdict: trust", "Verdict: \x1b[1;32mtrust\x1b[0m"),
        ("Verdict: trust except Xu", "Verdict: \x1b[1;33mtrust except\x1b[0m Xu"),
        ("Verdict: do not trust: x", "Verdict: \x1b[1;31mdo not trust\x1b[0m: x"),
        ("verdict: named", "verdict: \x1b[1;33mnamed\x1b[0m"),
        ("verdict: none", "verdict: \x1b[1;32mnone\x1b[0m"),
        ("no Verdict: trust", "no Verdict: trust"),
        ("Prediction: good", "Prediction: \x1b[1;32mgood\x1b[0m"),
        ("Prediction: limited: x", "Prediction: \x1b[1;33mlimited\x1b[0m: x"),
        ("Coefficients: do not trust: x", "Coefficients: \x1b[1;31mdo not trust\x1b[0m: x"),
    ],
)
def test_a_verdict_is_coloured_on_a_terminal_only(text, shown):
    code = f"say({text!r})"
    assert on_a_terminal(code).replace("\r\x1b[K", "").strip() == shown
    piped = subprocess.run([sys.executable, "-c", SAY + code], capture_output=True, text=True,
                           env=plain_environment(), check=True)  # fmt: skip
    assert piped.stdout == text + "\n"


def test_no_color_and_dumb_terminals_are_heeded():
    code = "say('Verdict: trust'); complain('greybox: stopped')"
    for environment in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
        assert "\x1b[1" not in on_a_terminal(code, **environment)
    assert "\x1b[1;31mgreybox:\x1b[0m stopped" in on_a_terminal(code)
    # an empty variable asks for nothing
    assert "\x1b[1;31m" in on_a_terminal(code, NO_COLOR="")


def test_an_ending_makes_no_names_alike(tmp_path):
    for name in ("fleet.csv", "wed.csv", "monday run.csv"):
        (tmp_path / name).touch()
    assert nearest_file(tmp_path / "nofile.csv") == ""
    assert nearest_file(tmp_path / "nope.csv") == ""
    assert nearest_file(tmp_path / "monday run") == " Did you mean 'monday run.csv'?"
    assert nearest_file(tmp_path / "wedd.csv") == " Did you mean 'wed.csv'?"


def test_the_help_of_import_shows_a_vessel_file(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["import", "--help"])
    shown = re.sub("\x1b[^m]*m", "", capsys.readouterr().out)
    path = tmp_path / "ship.toml"
    path.write_text(textwrap.dedent(shown[shown.index('  name = "') :]))
    assert load_vessel(path).commands == ("n", "delta")
