"""Options that stand in greybox.toml."""

from __future__ import annotations

import json

import pytest
from virtual import virtual_log, write_csv

from greybox.commands.configuration import MOST_BYTES, find_configuration
from greybox.commands.main import build_parser, main
from greybox.errors import GreyboxError
from greybox.files import sha256
from greybox.vessel.toml import example_vessel


@pytest.fixture(scope="module")
def small_log():
    return virtual_log(9, 120)


@pytest.fixture
def folder(tmp_path, monkeypatch, small_log):
    """A working folder with a log and a vessel, and nobody's configuration above it."""
    write_csv(small_log, tmp_path / "trial.csv")
    (tmp_path / "ship.toml").write_text(example_vessel("thesis").read_text())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("GREYBOX_CONFIG", raising=False)
    return tmp_path


def write(folder, text):
    (folder / "greybox.toml").write_text(text)


@pytest.fixture
def options(monkeypatch):
    """Run a command line without its work, and return the options that it would work with."""
    seen = []

    def run(*arguments):
        monkeypatch.setattr("greybox.commands.main._run", seen.append)
        status = main([str(a) for a in arguments])
        return seen[-1] if status == 0 else status

    return run


def test_required_options_may_come_from_the_file(folder, options):
    write(folder, '[all]\nvessel = "ship.toml"\n[estimate]\nmethod = "iv"\nsample-time = 2\n')
    given = options("estimate", "trial.csv")
    assert (given.vessel, given.method, given.sample_time) == ("ship.toml", "iv", 2.0)
    assert given.predictor is None
    assert given.configuration["file"] == "greybox.toml"
    assert given.configuration["options"] == ["vessel", "method", "sample_time"]
    assert len(given.configuration["sha256"]) == 64


def test_the_command_line_wins(folder, options):
    write(
        folder,
        '[estimate]\nvessel = "ship.toml"\nmethod = "iv"\nreduce = true\nbound = "Xu=-1:0"\n',
    )
    given = options("estimate", "trial.csv", "--method", "ls", "--bound", "Xv=0:1")
    assert (given.method, given.bound, given.reduce) == ("ls", ["Xv=0:1"], True)
    assert given.configuration["options"] == ["vessel", "reduce"]
    # one of two that exclude one another
    given = options("estimate", "trial.csv", "--compare-structures", "thesis", "linear")
    assert given.reduce is False
    assert given.compare_structures == ["thesis", "linear"]


def test_what_a_use_of_a_command_does_not_heed_may_stand_for_others(folder, capsys, monkeypatch):
    def stop(options):
        raise GreyboxError(f"goes on with {', '.join(options.configuration['options'])}")

    monkeypatch.setattr("greybox.commands.reproduce._run", stop)
    write(folder, '[all]\nvessel = "ship.toml"\nsample-time = 2\nseed = 3\n')
    for study in ("chapter4", "chapter7"):
        assert main(["reproduce", study]) == 1
        assert capsys.readouterr().err == "greybox reproduce: goes on with seed\n"
    bounded = '[estimate]\nvessel = "ship.toml"\nbound = "Xu=-1:0"\n'
    for more, word in (("", "there is no file"), ('method = "oe"\n', "there is no file")):
        write(folder, bounded + more)
        assert main(["estimate", "none.csv", "--method", "ls"]) == 1
        assert word in capsys.readouterr().err
    write(folder, bounded + 'method = "ls"\n')
    assert main(["estimate", "none.csv"]) == 1
    assert "--bound applies to --method oe only" in capsys.readouterr().err


def test_options_that_repeat_are_replaced_as_a_whole(folder, options):
    write(folder, '[import]\nvessel = "thesis"\nsmooth = ["r=2", "psi=1"]\n')
    assert options("import", "a.csv", "--out", "b.csv").smooth == ["r=2", "psi=1"]
    given = options("import", "a.csv", "--out", "b.csv", "--smooth", "u=3")
    assert given.smooth == ["u=3"]


def test_paths_are_relative_to_the_file(folder, options, monkeypatch):
    write(folder, '[all]\nvessel = "ship.toml"\n[diagnose]\nvalidate = ["a.csv", "/b.csv"]\n')
    (folder / "day" / "one").mkdir(parents=True)
    monkeypatch.chdir(folder / "day" / "one")
    given = options("diagnose", "trial.csv")
    assert given.vessel == "../../ship.toml"
    assert given.validate[0] == "../../a.csv"
    assert given.validate[1].endswith("/b.csv")
    assert given.logs == ["trial.csv"]
    assert given.configuration["file"] == "../../greybox.toml"


def test_a_vessel_of_the_package_is_named_as_ever(folder, options):
    write(folder, '[all]\nvessel = "thesis"\n')
    assert options("check", "trial.csv").vessel == "thesis"


def test_numbers_in_a_list(folder, options):
    write(folder, '[design]\nvessel = "thesis"\nout = "p.csv"\nstart = [1.5, 1.2, 0, 0]\n'
                  'between = ["a.json", "b.json"]\nposition = "1,2"\n')  # fmt: skip
    given = options("design")
    assert given.start == [1.5, 1.2, 0.0, 0.0]
    assert given.between == ["a.json", "b.json"]
    assert given.position == (1.0, 2.0)


def test_an_option_of_another_command_is_passed_over(folder, options):
    write(folder, '[all]\nvessel = "ship.toml"\nmethod = "iv"\n[estimate]\nmethod = "oe"\n')
    assert options("check", "trial.csv").configuration["options"] == ["vessel"]


def test_no_configuration(folder, options):
    write(folder, "[estimate]\nmethod = 3\n")
    assert options("estimate", "trial.csv", "--vessel", "v", "--no-config").method is None
    assert options("--no-config", "estimate", "trial.csv", "--vessel", "v").method is None
    with pytest.raises(SystemExit):
        main(["estimate", "--help"])


def test_the_variable_names_another_file(folder, options, monkeypatch, capsys):
    (folder / "mine").mkdir()
    (folder / "mine" / "my.toml").write_text('[all]\nvessel = "boat.toml"\n')
    monkeypatch.setenv("GREYBOX_CONFIG", str(folder / "mine" / "my.toml"))
    write(folder, "[all]\nvessel = 3\n")
    assert options("check", "trial.csv").vessel == "mine/boat.toml"
    monkeypatch.setenv("GREYBOX_CONFIG", "none.toml")
    assert options("check", "trial.csv") == 1
    assert "GREYBOX_CONFIG names 'none.toml', which is no file" in capsys.readouterr().err


def test_a_mistyped_variable_is_told(folder, options, monkeypatch, capsys):
    monkeypatch.setenv("GREYBOX_DATA", "logs")
    given = ("check", "trial.csv", "--vessel", "ship.toml")
    assert options(*given).vessel == "ship.toml"
    monkeypatch.setenv("GREYBOX_CONFG", "my.toml")
    assert options(*given) == 1
    assert capsys.readouterr().err == (
        "greybox: the environment gives GREYBOX_CONFG, which no program reads. Did you mean "
        "'GREYBOX_CONFIG'? Correct or unset the variable.\n"
    )


def test_where_the_file_is_looked_for(tmp_path):
    home, inner = tmp_path / "home", tmp_path / "home" / "work" / "trial"
    inner.mkdir(parents=True)
    at = {"HOME": str(home)}
    (tmp_path / "greybox.toml").write_text("")
    assert find_configuration(inner, at) is None
    (home / "greybox.toml").write_text("")
    assert find_configuration(inner, at) == home / "greybox.toml"
    (home / "work" / ".git").mkdir()
    assert find_configuration(inner, at) is None
    (home / "work" / "greybox.toml").write_text("")
    assert find_configuration(inner, at) == home / "work" / "greybox.toml"
    # neither a repository nor a home above: the folder alone
    (tmp_path / "shared").mkdir()
    assert find_configuration(tmp_path / "shared", {}) is None
    assert find_configuration(tmp_path, {}) == tmp_path / "greybox.toml"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[all]\nvesel = 'x'", "[all], vesel: there is no option 'vesel'. Did you mean 'vessel'"),
        ("[check]\nmethod = 'x'", "[check], method: there is no option 'method'."),
        ("[chek]\n", "has the table [chek], and there is no such command. Did you mean 'check'?"),
        ("vessel = 'x'", "gives 'vessel' outside a table: put it under [all]"),
        ("[all]\nvessel = 3", "cannot read the vessel file '3'"),
        ("[all]\nvessel = true", "[all], vessel is True, a word or a number is needed"),
        ("[all]\nvessel = {a = 1}", "[all], vessel is {'a': 1}, a word or a number is needed"),
        ("[estimate]\nmethod = 'ivv'", "'ivv' is not known. Did you mean 'iv'? Known: ls, iv, oe."),
        ("[estimate]\nmass = -3", "[estimate], mass: '-3' is no positive number."),
        ("[estimate]\nseed = 1.5", "seed: '1.5' is no whole number of at least 0."),
        ("[estimate]\nreduce = 'yes'", "reduce is 'yes': write true or false"),
        ("[estimate]\nbound = []", "bound is an empty list"),
        ("[estimate]\nreduce = true\ncompare-structures = ['a']", "exclude one another"),
        ("[estimate]\nout = '../m.json'", "outside the file's own folder"),
        ("[estimate]\nout = '/etc/m.json'", "outside the file's own folder"),
        ("[estimate]\nverbose = 1", "there is no option 'verbose'"),
        ("[design]\nbetween = ['a']\n", None),
        ("[all\n", "is not TOML: "),
        ("#" * (MOST_BYTES + 1), f"has more than {MOST_BYTES} bytes"),
        ("\x00\x01", "is not TOML: "),
        ("[" * 5000, "is not TOML: "),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_one_sentence(folder, capsys, text, message):
    write(folder, text)
    given = ["estimate" if "check]" not in text else "check", "trial.csv"]
    if message is None:
        given, message = ["design"], "between has 1 value, 2 are needed"
    if "vessel" not in text:
        given += ["--vessel", "none.toml"]
    assert main(given) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_record_of_an_output_tells_the_file(folder, capsys):
    write(folder, '[all]\nvessel = "ship.toml"\n')
    assert main(["check", "trial.csv", "--json", "c.json"]) == 0
    assert json.loads((folder / "c.json").read_text())["provenance"]["configuration"] == {
        "file": "greybox.toml", "options": ["vessel"], "sha256": sha256(folder / "greybox.toml"),
    }  # fmt: skip
    assert (
        main(["check", "trial.csv", "--no-config", "--vessel", "thesis", "--json", "c.json"]) == 0
    )
    assert "configuration" not in json.loads((folder / "c.json").read_text())["provenance"]


def test_every_option_of_every_command_can_stand_in_a_file():
    from greybox.commands.configuration import configurable
    from greybox.commands.parser import sub_parsers

    for name, parser in sub_parsers(build_parser()).items():
        if name not in ("help", "completion"):
            assert configurable(parser), name


def test_a_letter_that_stands_for_a_number_is_no_file():
    import argparse

    from greybox.commands.common import positive
    from greybox.commands.completion import endings

    parser = argparse.ArgumentParser()
    assert endings(parser.add_argument("--vessel", metavar="V")) == ("toml",)
    assert endings(parser.add_argument("--speed", metavar="V", type=positive)) is None
