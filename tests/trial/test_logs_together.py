"""Logs of one ship are judged together: what its instruments share, what differs, what asks."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from foreign_ships import presets
from foreign_ships.manoeuvres import kinds
from virtual import as_recording, recorded

from greybox.commands.main import main
from greybox.errors import LogError, UsageError
from greybox.trial.checks.check import check_files, check_recording, check_recordings
from greybox.trial.checks.finding import CheckReport, Finding
from greybox.trial.checks.motion import make_motion
from greybox.trial.checks.sensor_offsets.findings import Tied, find_offsets
from greybox.trial.checks.thruster_response import answer_findings
from greybox.trial.import_files import import_files
from greybox.trial.repair import apply_repairs, repair
from greybox.trial.steps import mend
from greybox.vessel.toml import load_vessel, vessel_from_dict


def logs_of(seeds, how=None, **common):
    """Recordings of one ship by seed; `how` says what each has of its own."""
    made = []
    for k, seed in enumerate(seeds):
        own = {"seconds": 240.0, **common, **((how or {}).get(k, {}))}
        made.append(replace(as_recording(recorded(seed, 2.0, **own)), name=f"run {k}"))
    return made


def offsets(recordings, ship):
    """Findings on clocks, antenna and compass, log by log."""
    return [
        {(f.id, f.channels): f for f in found}
        for found, _ in find_offsets([Tied(r.name, r, make_motion(r)) for r in recordings], ship)
    ]


@pytest.mark.long
def test_instruments_are_estimated_once_over_all_logs(ship):
    recordings = logs_of(range(10, 14), late={"psi": 0.5})
    alone = offsets(recordings[:1], ship)[0]
    reports = check_recordings(recordings, ship)
    (first,) = reports[0].findings
    assert (first.id, first.channels) == ("clock_offset", ("psi",))
    assert first.ci[0] < 0.5 < first.ci[1]
    assert first.logs == ("run 0", "run 1", "run 2", "run 3")
    assert all(r.findings[0].value == first.value for r in reports)
    assert first.to_dict()["logs"] == list(first.logs)
    # four logs know it better than one: half the width, within what four estimates of it vary by
    width = np.diff(first.ci)[0]
    for f in alone.values():
        assert width < 0.75 * np.diff(f.ci)[0]
        assert "logs" not in f.to_dict()
    mended = [repair(r, report)[0] for r, report in zip(recordings, reports, strict=True)]
    assert not any(r.findings for r in check_recordings(mended, ship))


def test_a_log_that_cannot_tell_is_mended_as_the_others_are(ship):
    recordings = logs_of([20, 21, 22], {2: {"seconds": 60.0}}, arm=(3.0, -1.5))
    found = offsets(recordings, ship)
    values = {f.value for each in found for f in each.values() if f.id == "lever_arm"}
    assert len(values) == 1
    np.testing.assert_allclose(values.pop(), (3.0, -1.5), atol=0.3)


def test_campaigns_have_values_of_their_own(ship):
    late = {k: {"late": {"psi": 0.9}} for k in (3, 4)}
    found = offsets(logs_of(range(30, 35), late), ship)
    assert [set(each) for each in found[:3]] == [set()] * 3
    for each in found[3:]:
        (f,) = each.values()
        assert f.channels == ("psi",)
        assert abs(f.value - 0.9) < 0.15
        assert f.logs == ("run 3", "run 4")
        assert "3 other logs of the ship have another value" in f.evidence


def test_frames_and_signs_are_read_over_all_logs(ship):
    recordings = []
    for k, r in enumerate(logs_of([40, 41, 42])):
        reverse = [s.with_value(-s.value) if s.name == "r" and k else s for s in r.signals]
        recordings.append(r.with_signals(reverse))
    reports = check_recordings(recordings, ship)
    assert [[(f.id, f.channels) for f in r.findings] for r in reports] == [
        [], [("sign", ("r",))], [("sign", ("r",))],
    ]  # fmt: skip
    both = check_recordings(recordings[1:], ship)
    assert all(r.findings[0].logs == ("run 1", "run 2") for r in both)


def test_a_reversed_rudder_is_reversed_in_all_logs_of_the_ship(tmp_path):
    """Of a ship by others: logs that cannot tell by themselves are mended, too."""
    preset = presets()["kvlcc2-7m"]
    (tmp_path / "ship.toml").write_text(preset.ship.vessel_toml())
    ship = load_vessel(tmp_path / "ship.toml")
    logs = []
    for kind, rows in (("zigzag-10", 400), ("turn-port", 400), ("zigzag-20", 80)):
        preset.sail(kinds()[kind], seed=1).write_csv(tmp_path / f"{kind}.csv")
        columns = pd.read_csv(tmp_path / f"{kind}.csv")[:rows]
        (rudder,) = ship.rudders
        columns[rudder] *= -1
        made = as_recording({n: columns[n].to_numpy() for n in columns}, ship)
        logs.append(replace(made, name=kind))
    alone = [answer_findings([log], ship, [[]]) for log in logs]
    assert [len(found) for (found,) in alone] == [1, 0, 0]
    together = answer_findings(logs, ship, [[]] * 3)
    assert {f.channels for (f,) in together} == {(rudder,)}
    assert {f.logs for (f,) in together} == {("zigzag-10", "turn-port", "zigzag-20")}
    mended = [apply_repairs(log, found) for log, found in zip(logs, together, strict=True)]
    assert answer_findings(mended, ship, [[]] * 3) == [[]] * 3
    # one log of another sign than the others is read by itself
    apart = answer_findings([logs[0], *mended[1:]], ship, [[]] * 3)
    assert [[f.channels for f in found] for found in apart] == [[(rudder,)], [], []]


@pytest.mark.parametrize(
    ("late", "inputs", "words", "moved"),
    [
        # the thrusters' columns are stamped as late as the velocities
        ({"psi", "u", "v", "r", "n", "alpha1", "alpha2"}, "velocities", "share", ("x_n", "y_n")),
        # the thrusters' columns are on time, as the positions
        ({"psi", "u", "v", "r"}, "the positions", "share", ("psi", "u", "v", "r")),
    ],
)
def test_all_channels_end_on_the_clock_of_the_thrusters(late, inputs, words, moved, ship):
    recordings = logs_of([50, 51], seconds=400.0, late=dict.fromkeys(late, 0.9), noise=0.3)
    found = offsets(recordings, ship)
    (f,) = found[0].values()
    assert f.channels == ("psi", "u", "v", "r")
    assert abs(f.value - 0.9) < 0.15
    assert words in f.evidence
    assert inputs in f.evidence.split("the thrusters' columns")[1]
    assert [s.channels for s in f.repair] == [moved]
    late_by = f.repair[0].number("late")
    assert late_by == pytest.approx(f.value if "psi" in moved else -f.value)


def test_without_thrusters_the_positions_are_moved(ship):
    (r,) = logs_of([52], late=dict.fromkeys(("psi", "u", "v", "r"), 0.9))
    r = r.with_signals(s for s in r.signals if s.name not in ship.commands)
    (f,) = offsets([r], ship)[0].values()
    assert "unknown" in f.evidence
    assert f.repair[0].channels == ("x_n", "y_n")


@pytest.mark.parametrize("seed", [0, 3])
def test_a_regular_zigzag_of_a_ship_that_hardly_drifts_has_no_late_clock(seed, tmp_path):
    """Of ships by others: steps that fit the noise of one alignment only are taken back."""
    preset = presets()["survey-catamaran-2m"]
    file = tmp_path / "zigzag.csv"
    preset.sail(kinds()["zigzag-10"], seed=seed).write_csv(file)
    (tmp_path / "ship.toml").write_text(preset.ship.vessel_toml())
    (report,) = check_files([file], load_vessel(tmp_path / "ship.toml"))
    assert not {"clock_offset", "lever_arm", "heading_bias"} & {f.id for f in report.findings}


def test_what_a_ship_cannot_have_is_asked(ship):
    far = logs_of([60], arm=(40.0, 0.0), seconds=400.0)
    (arm,) = (f for f in check_recording(far[0], ship).findings if f.id == "lever_arm")
    assert not arm.safe
    assert "m is more than 24.0 m" in arm.evidence
    late = logs_of([61], late={"psi": 7.0}, seconds=400.0)
    (clock,) = (f for f in check_recording(late[0], ship).findings if f.id == "clock_offset")
    assert not clock.safe
    assert "s is more than 5 s" in clock.evidence


def planted(*steps, ids=("clock_offset",)):
    return CheckReport(
        "log",
        tuple(
            Finding(i, "psi", 1.0, (1.0, 1.0), "s", "late", "shift", ("psi",), (step,), safe=True)
            for i, step in zip(ids * len(steps), steps, strict=False)
        ),
        (),
    )


def test_mends_that_contradict_are_refused_with_both_values(ship):
    (r,) = logs_of([70], seconds=60.0)
    two = planted(mend("shift", ("psi",), late=0.5), mend("shift", ("psi",), late=0.9))
    with pytest.raises(LogError, match=r"psi moved by -0\.5 s.*psi moved by -0\.9 s.*--fix-not"):
        repair(r, two)
    left = repair(r, two, without=("clock_offset",))
    assert not left[1]
    assert len(left[2]) == 2


def test_a_mend_that_would_leave_too_little_is_refused_with_both_numbers(ship):
    (r,) = logs_of([70], seconds=60.0)
    times = tuple(float(t) for t in r["psi"].t[2:])
    with pytest.raises(LogError, match=r"of psi .* leave 2 of its 121 samples"):
        repair(r, planted(mend("drop", ("psi",), times=times), ids=("outlier",)))
    with pytest.raises(LogError, match=r"of psi .* leave 0 of its 121 samples"):
        repair(r, planted(mend("shift", ("psi",), late=600.0)))


def test_ids_are_known_and_not_asked_for_twice(ship):
    (r,) = logs_of([70], seconds=60.0)
    with pytest.raises(UsageError, match="no check 'clock'"):
        repair(r, planted(), without=("clock",))
    with pytest.raises(UsageError, match="'gap' stands in --fix-also and in --fix-not"):
        repair(r, planted(), also=("gap",), without=("gap",))


@pytest.fixture
def trials(tmp_path):
    paths = []
    for k, seed in enumerate((80, 81)):
        columns = recorded(seed, 2.0, seconds=240.0, late={"u": 0.8, "v": 0.8})
        paths.append(tmp_path / f"run{k}.csv")
        pd.DataFrame(columns).to_csv(paths[-1], index=False)
    return paths


def test_a_folder_takes_one_log_a_file_mended_alike(trials, tmp_path, ship, capsys):
    out = tmp_path / "logs"
    arguments = [*map(str, trials), "--vessel", "thesis", "--fix", "--json"]
    assert main(["import", *arguments, str(tmp_path / "r.json"), "--out", f"{out}/"]) == 0
    assert {p.name for p in out.iterdir()} == {
        "run0.csv", "run0.csv.json", "run1.csv", "run1.csv.json",
    }  # fmt: skip
    said = capsys.readouterr().out
    assert said.count("mended: clock_offset of u, v") == 2
    records = json.loads((tmp_path / "r.json").read_text())["logs"]
    steps = [[s for s in r["steps"] if s["operation"] == "shift"] for r in records]
    assert steps[0][0]["parameters"] == steps[1][0]["parameters"]
    after = check_files(sorted(out.glob("*.csv")), ship)
    assert not any(f.id == "clock_offset" for r in after for f in r.findings)


def test_what_is_not_to_be_fixed_is_left(trials, tmp_path, ship):
    said = import_files(trials, ship, tmp_path / "new", fix=True, fix_not=("clock_offset",))
    assert said.count("left as it is: clock_offset") == 2
    assert "mended: clock_offset" not in said
    assert (tmp_path / "new" / "run1.csv").exists()


def test_a_folder_is_left_as_it_was_where_one_file_fails(trials, tmp_path, ship):
    bad = tmp_path / "bad.csv"
    bad.write_text("t,x_n\n0,1\n")
    with pytest.raises(LogError):
        import_files([*trials, bad], ship, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "run0.csv").write_text("as it was")
    with pytest.raises(LogError):
        import_files([*trials, bad], ship, tmp_path / "old")
    (left,) = (tmp_path / "old").iterdir()
    assert left.read_text() == "as it was"
    with pytest.raises(LogError, match="would both become"):
        import_files([trials[0], trials[0]], ship, tmp_path / "new")
    with pytest.raises(LogError, match="is also the log to write"):
        import_files(trials, ship, tmp_path)
    with pytest.raises(LogError, match="there is no folder"):
        import_files(trials, ship, tmp_path / "no" / "new")


def test_several_files_and_one_log_are_one_trial(tmp_path, ship):
    columns = recorded(82, 2.0, seconds=60.0)
    names = list(columns)
    for k, part in enumerate((names[:4], ["t", *names[4:]])):
        pd.DataFrame({n: columns[n] for n in part}).to_csv(tmp_path / f"{k}.csv", index=False)
    import_files([tmp_path / "0.csv", tmp_path / "1.csv"], ship, tmp_path / "one.csv")
    assert set(names) <= set(pd.read_csv(tmp_path / "one.csv").columns)


@pytest.mark.long
def test_pooled_intervals_cover_and_clean_logs_are_clean(ship):
    """Of 80 intervals of 95 % all but nine cover (binomial chance of less: 2e-3)."""
    hits = []
    for k in range(20):
        late = np.random.default_rng([31, k]).uniform(0.5, 1.5)
        seeds = range(5000 + 10 * k, 5004 + 10 * k)
        assert not any(offsets(logs_of(seeds), ship))
        recordings = logs_of(
            seeds, late={"u": late, "v": late}, arm=(1.5, -1.0), heading_bias=np.radians(3.0)
        )
        found = offsets(recordings, ship)[0]
        assert [f.id for f in found.values()] == ["clock_offset", "lever_arm", "heading_bias"]
        clock, arm, bias = found.values()
        assert clock.channels == ("u", "v")
        for f, truth in ((clock, (late,)), (arm, (1.5, -1.0)), (bias, (np.radians(3.0),))):
            cis = f.ci if isinstance(f.value, tuple) else (f.ci,)
            hits += [c[0] <= t <= c[1] for c, t in zip(cis, truth, strict=True)]
    assert sum(hits) >= len(hits) - 9


ESSO = vessel_from_dict(
    {
        "name": "Esso Osaka model", "length": 3.0,
        "thruster": [
            {"type": "propeller_rudder", "x": -1.5, "speed": "n_prop [rps]",
             "rudder": "delta_rudder [rad]"}
        ],
    }
)  # fmt: skip


@pytest.mark.long
def test_fifteen_runs_of_the_tanker_model_agree(data_folder, tmp_path):
    paths = sorted((data_folder / "esso_osaka").glob("*.csv"))
    reports = check_files(paths, ESSO)
    november = ["12-Nov-2020" in p.name for p in paths]
    assert len(paths) == 15
    assert sum(november) == 3
    for late_rate, report in zip(november, reports, strict=True):
        clocks = {f.channels: f for f in report.findings if f.id == "clock_offset"}
        assert not any(f.id == "lever_arm" for f in report.findings)
        shared = next(f for c, f in clocks.items() if {"psi", "u", "v"} <= set(c))
        assert 0.8 < shared.value < 1.0
        if late_rate:
            assert 0.7 < clocks["r",].value < 0.95
            assert len(clocks["r",].logs) == 3
        else:
            assert "r" in shared.channels
            assert len(shared.logs) == 12
    import_files(paths, ESSO, tmp_path / "logs", fix=True)
    after = check_files(sorted((tmp_path / "logs").glob("*.csv")), ESSO)
    kinds = {f.id for r in after for f in r.findings}
    assert not kinds & {"clock_offset", "lever_arm", "heading_bias"}
