"""Headings across the wrap, positions that jump or are held: found, named, placed and mended."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from foreign_ships import presets
from foreign_ships.manoeuvres import kinds
from virtual import as_recording, recorded

from greybox import check_files, import_files, read_segments
from greybox.trial.checks.check import check_recording
from greybox.trial.checks.heading_wrap import wrap_findings
from greybox.trial.checks.position_hold import hold_findings
from greybox.trial.checks.position_jump import jump_findings
from greybox.trial.checks.signal_quality import coarse_findings, spike_findings
from greybox.trial.convert.convert import import_recording
from greybox.trial.convert.derived_signals import continuous
from greybox.trial.convert.merge import merge
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.repair import apply_repairs
from greybox.trial.steps import mend
from greybox.trial.trial_summary import describe_recording
from greybox.vessel.toml import vessel_from_dict

TURN = 2 * np.pi


def wrapped(psi, low=0.0):
    return (psi - low) % TURN + low


def crossings(psi):
    return np.flatnonzero(np.abs(np.diff(psi)) > np.pi)


def copied(seed, rate=2.0, **options):
    return {k: v.copy() for k, v in recorded(seed, rate, **options).items()}


def heading(values, rate=10.0):
    return as_recording({"t": np.arange(len(values)) / rate, "psi": np.asarray(values, float)})


def times(finding):
    return finding.repair[0].numbers("times")


def between(t, finding):
    """Rows of a log that a finding leaves out."""
    return np.flatnonzero(np.isin(t, times(finding))).tolist()


# heading across the wrap


@pytest.mark.parametrize(("low", "factor"), [(0.0, 1.0), (-np.pi, 1.0), (0.0, 180 / np.pi)])
def test_one_interpolated_sample_is_found_alone_and_mended(low, factor, ship):
    d = copied(5)
    psi = wrapped(d["psi"], low)
    k = int(crossings(psi)[0])
    psi[k] = 0.4 * psi[k - 1] + 0.6 * psi[k + 1]
    log = as_recording(d | {"psi": psi * factor})
    findings = check_recording(log, ship).findings
    first = findings[0]
    assert [f.id for f in findings] == ["heading_wrap", "unit"][: 1 + (factor != 1)]
    assert (first.channels, first.value, first.safe) == (("psi",), 1.0, True)
    assert times(first) == (d["t"][k],)
    assert f"at t = {d['t'][k]:.6g} s" in first.evidence
    mended = apply_repairs(log, findings)
    assert not check_recording(mended, ship).findings
    turned = np.unwrap(mended["psi"].value)
    true = np.delete(d["psi"], k)
    assert np.ptp(turned - true) < 1e-9


def test_several_samples_between_the_sides():
    said = [330, 340, 350, 260, 170, 80, 8, 18, 28]
    course = [*range(0, 330, 5), *said, *range(32, 200, 5)]
    (found,) = wrap_findings(heading(np.radians(course)))
    first = course.index(350) + 1
    assert between(np.arange(len(course)) / 10, found) == [first, first + 1, first + 2]


def test_a_heading_resampled_before_it_was_unwrapped(ship):
    d = copied(11, 2.0)
    t = np.arange(0, d["t"][-1], 0.1)
    psi = np.interp(t, d["t"], wrapped(d["psi"]))
    (found,) = wrap_findings(as_recording({"t": t, "psi": psi}))
    off = np.abs(wrapped(psi - np.interp(t, d["t"], d["psi"]), -np.pi))
    wrong = set(np.flatnonzero(off > np.radians(5)).tolist())
    assert wrong
    assert wrong <= set(between(t, found))
    assert off[between(t, found)].min() > np.radians(0.9)


@pytest.mark.parametrize("glitch", [99.0, -9.99])
def test_one_glitch_leaves_the_rest_of_a_heading_unwrapped(glitch):
    psi = 0.025 * np.arange(400)
    at = wrapped(psi, -np.pi)
    at[37] = glitch
    rest = np.arange(400) != 37
    np.testing.assert_allclose(continuous(at)[rest], psi[rest], atol=1e-12)
    assert continuous(at)[37] == glitch


def test_a_fast_turn_the_long_way_round_is_no_wrap():
    """A boat that spins through 340 deg in four seconds, from rest to rest."""
    t = np.arange(0, 120, 0.1)
    share = np.clip((t - 60) / 4, 0, 1)
    psi = np.radians(350) - np.radians(342) * (share - np.sin(TURN * share) / TURN)
    rng = np.random.default_rng(1)
    noisy = wrapped(psi + 0.005 * rng.standard_normal(len(t)))
    assert not wrap_findings(as_recording({"t": t, "psi": noisy}))


def test_a_heading_that_wavers_about_the_wrap_crosses_it_and_comes_back(ship):
    """Both neighbours of a sample lie on one side; between them the heading was on the other."""
    rng = np.random.default_rng(94)
    t = np.arange(0, 300, 0.5)
    course = wrapped(0.02 * np.sin(t / 9) + 0.005 * rng.standard_normal(len(t)))
    inner = range(10, len(t) - 10)
    k = next(k for k in inner if np.ptp(course[k - 1 : k + 2]) < 0.1 and course[k] < 0.01)
    course[k] = 0.6 * course[k] + 0.4 * TURN
    log = as_recording({"t": t, "psi": course})
    (found,) = check_recording(log, ship).findings
    assert (found.id, between(t, found)) == ("heading_wrap", [k])
    assert not wrap_findings(apply_repairs(log, [found]))


def test_an_outlier_away_from_the_wrap_is_an_outlier(ship):
    d = copied(5, 5.0)
    psi = wrapped(d["psi"])
    k = int(np.argmin(np.abs(psi - np.radians(200))))
    psi[k] -= np.radians(120)
    ids = [f.id for f in check_recording(as_recording(d | {"psi": psi}), ship).findings]
    assert ids == ["outlier"]


# positions that jump


@pytest.mark.parametrize(
    ("rate", "sensors"), [(1.0, ("u", "v")), (2.0, ("v_n", "v_e")), (5.0, ("u", "v"))]
)
def test_a_jump_of_the_origin_is_found_alone_with_its_place(rate, sensors, ship):
    d = copied(21, rate)
    if sensors == ("v_n", "v_e"):
        c, s = np.cos(d["psi"]), np.sin(d["psi"])
        u, v = d.pop("u"), d.pop("v")
        d |= {"v_n": c * u - s * v, "v_e": s * u + c * v}
    k = len(d["t"]) // 3
    d["x_n"][k:] += 0.6
    d["y_n"][k:] -= 0.8
    log = as_recording(d)
    (found,) = check_recording(log, ship).findings
    assert (found.id, found.channels, found.safe) == ("position_jump", ("x_n", "y_n"), True)
    assert not jump_findings(apply_repairs(log, [found]))
    for value, (low, high), true in zip(found.value, found.ci, (0.6, -0.8), strict=True):
        assert abs(value - true) < 3 * (high - low) / 3.92
    assert times(found) == (d["t"][k],)
    assert apply_repairs(log, [found]).cuts == (d["t"][k],)


def test_a_jump_shows_in_positions_alone():
    d = copied(22, 5.0)
    d["y_n"][1000:] += 0.6
    (found,) = jump_findings(as_recording({k: d[k] for k in ("t", "x_n", "y_n")}))
    assert times(found) == (d["t"][1000],)


def test_a_jump_that_returns_at_once_is_an_outlier(ship):
    d = copied(23, 5.0)
    for k, count in ((500, 1), (1500, 3)):
        d["x_n"][k : k + count] += 2.0
    ids = [f.id for f in check_recording(as_recording(d), ship).findings]
    assert ids == ["outlier"]


def test_a_jump_that_returns_later_is_two_jumps():
    d = copied(24, 5.0)
    d["x_n"][1000:1020] += 1.0
    found = jump_findings(as_recording(d))
    assert [times(f) for f in found] == [(d["t"][1000],), (d["t"][1020],)]
    assert found[0].value[0] == pytest.approx(1.0, abs=0.2)
    assert found[1].value[0] == pytest.approx(-1.0, abs=0.2)


def test_no_stretch_of_the_log_reaches_over_a_cut(ship, tmp_path):
    d = copied(25)
    d["x_n"][600:] += 4.0
    raw, out = tmp_path / "raw.csv", tmp_path / "mended.csv"
    rows = np.column_stack(list(d.values()))
    np.savetxt(raw, rows, delimiter=",", header=",".join(d), comments="", fmt="%.17g")
    said = import_files([raw], ship, out, fix=True)
    assert "mended: position_jump of x_n, y_n" in said
    first, second = read_segments(out, ship)
    assert first.t[-1] < d["t"][600] <= second.t[0]
    # who reads it again finds it cut, and nothing else wrong with it
    (again,) = check_files([out], ship)
    assert {f.id for f in again.findings} <= {"gap"}
    assert again.recording.cuts == (d["t"][600],)
    (step,) = [s for s in first.provenance.steps if s.operation == "cut"]
    assert step.decided_by == "check"
    # without its record, too
    out.with_name("mended.csv.json").unlink()
    (bare,) = check_files([out], ship)
    assert {f.id for f in bare.findings} <= {"gap"}
    assert len(read_segments(out, ship)) == 2


def test_a_cut_moves_with_its_positions():
    d = copied(26, 5.0)
    log = as_recording(d)
    d["x_n"][1500:] += 4.0
    (found,) = jump_findings(as_recording(d))
    cut = apply_repairs(log, [found])
    late = apply_repairs(cut, [_shift(("x_n", "y_n"), 0.8)])
    assert late.cuts == pytest.approx((d["t"][1500] - 0.8,))
    assert apply_repairs(cut, [_shift(("u", "v"), 0.8)]).cuts == cut.cuts


def test_a_cut_moves_with_the_file_that_is_merged():
    t = np.arange(100.0)
    first = replace(as_recording({"t": t, "u": 0 * t}), epoch=1000.0)
    cut = replace(mend("cut", ("x_n", "y_n"), times=(50.0,)), interval=(40.0, 60.0))
    later = replace(first, name="later", epoch=2000.0, steps=(cut,))
    merged = merge([first, later])
    assert merged.cuts == (1050.0,)
    assert merged.steps[0].interval == (1040.0, 1060.0)


def test_a_cut_moves_with_the_positions_of_its_own_file():
    t = np.arange(100.0)
    cut, late = mend("cut", ("x_n", "y_n"), times=(50.0,)), mend("shift", ("x_n", "y_n"), late=2.0)
    both = [replace(as_recording({"t": t, "u": 0 * t}), epoch=e) for e in (1000.0, 2000.0)]

    def cuts(*steps):
        of_files = (replace(r, steps=s) for r, s in zip(both, steps, strict=True))
        return merge(list(of_files)).cuts

    assert cuts((cut,), (late,)) == (50.0,)
    # as often as a file was moved, even by the same step
    assert cuts((cut, late), (cut, late)) == (48.0, 1048.0)
    assert cuts((late,), (cut,)) == (1050.0,)


def _shift(channels, late):
    from greybox.trial.checks.finding import Finding

    repair = (mend("shift", channels, late=late),)
    return Finding("clock_offset", channels[0], late, (late, late), "s", "", "", channels, repair)


RUDDER = vessel_from_dict(
    {
        "name": "boat", "length": 3.0,
        "thruster": [{"type": "propeller_rudder", "x": -1.5, "speed": "n", "rudder": "delta"}],
    }
)  # fmt: skip


def zigzags():
    """Two zig-zags of 20 deg, each begun on a straight course, 5 Hz."""
    t = np.arange(0, 400, 0.2)
    period = 40.0
    delta, psi = np.zeros(len(t)), np.zeros(len(t))
    for start in (40.0, 240.0):
        inside = (t >= start) & (t < start + 3 * period)
        phase = (t[inside] - start) / period * TURN
        delta[inside] = np.radians(20) * np.where(np.cos(phase) >= 0, 1, -1)
        psi[inside] = np.radians(25) * np.sin(phase)
    r = np.gradient(psi, t)
    u, v = np.full(len(t), 1.0), -0.05 * np.sign(r)
    rng = np.random.default_rng(3)
    north, east = np.cos(psi) * u - np.sin(psi) * v, np.sin(psi) * u + np.cos(psi) * v
    return {
        "t": t, "x_n": np.cumsum(north) * 0.2 + 0.005 * rng.standard_normal(len(t)),
        "y_n": np.cumsum(east) * 0.2 + 0.005 * rng.standard_normal(len(t)), "psi": psi,
        "u": u + 0.005 * rng.standard_normal(len(t)), "v": v, "r": r, "delta": delta,
        "n": np.full(len(t), 10.0),
    }  # fmt: skip


def test_a_manoeuvre_that_begins_on_a_jump_is_none():
    d = zigzags()
    whole = describe_recording(as_recording(d), RUDDER).manoeuvres
    assert [round(m.start) for m in whole] == [40, 240]
    # recordings were joined where the second begins
    k = int(np.searchsorted(d["t"], whole[1].start))
    d["y_n"][k:] += 5.0
    log = as_recording(d)
    found = jump_findings(log)
    assert [times(f) for f in found] == [(d["t"][k],)]
    left = describe_recording(apply_repairs(log, found), RUDDER).manoeuvres
    assert [round(m.start) for m in left] == [40]


# positions that are held


@pytest.mark.parametrize("rate", [1.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_held_positions_are_found_alone_and_mended(rate, ship, tmp_path):
    d = copied(31, rate)
    rows = [100, 230, 231, 400]
    for k in rows:
        for name in ("x_n", "y_n"):
            d[name][k] = d[name][k - 1]
    log = as_recording(d)
    (found,) = check_recording(log, ship).findings
    assert (found.id, found.channels, found.safe) == ("position_hold", ("x_n", "y_n"), True)
    assert (found.value, between(d["t"], found)) == (4.0, rows)
    raw, out = tmp_path / "raw.csv", tmp_path / "mended.csv"
    table = np.column_stack(list(d.values()))
    np.savetxt(raw, table, delimiter=",", header=",".join(d), comments="", fmt="%.17g")
    import_files([raw], ship, out, fix=True)
    (again,) = check_files([out], ship)
    assert {f.id for f in again.findings} <= {"gap"}


@pytest.mark.parametrize(
    ("every", "rate"), [(2, 10.0), (10, 10.0), (1.25, 10.0)], ids=["half", "tenth", "four fifths"]
)
def test_a_receiver_slower_than_the_table_has_its_own_rate(every, rate):
    d = copied(32, rate)
    rows = (np.floor(np.arange(len(d["t"])) / every) * every).astype(int)
    log = as_recording({"t": d["t"], "x_n": d["x_n"][rows], "y_n": d["y_n"][rows]})
    assert not hold_findings(log)


def test_a_late_message_of_a_slow_receiver():
    d = copied(33, 10.0)
    rows = np.arange(len(d["t"])) // 5 * 5
    rows[1500:1505] = rows[1499]
    log = as_recording({"t": d["t"], "x_n": d["x_n"][rows], "y_n": d["y_n"][rows]})
    (found,) = hold_findings(log)
    assert between(d["t"], found) == [1500, 1501, 1502, 1503, 1504]


def test_a_steady_course_is_not_quantised():
    """Positions at constant speed are all one step apart, and no step of a sensor's."""
    rng = np.random.default_rng(5)
    t = np.arange(0, 400, 1.0)
    speed = np.where(t < 360, 0.9, 0.6)
    x = np.cumsum(speed) + 0.005 * rng.standard_normal(len(t))
    log = as_recording({"t": t, "x_n": x})
    assert not coarse_findings(log)
    (found,) = coarse_findings(as_recording({"t": t, "x_n": np.round(x / 0.5) * 0.5}))
    assert (found.id, found.value) == ("quantised", pytest.approx(0.5))


def test_coarse_positions_that_repeat_by_rounding_are_not_held():
    d = copied(34, 10.0)
    coarse = {n: np.round(d[n] / 0.5) * 0.5 for n in ("x_n", "y_n")}
    assert not hold_findings(as_recording({"t": d["t"], **coarse}))


@pytest.mark.parametrize("decimals", [7, 8])
def test_rounded_latitudes_and_longitudes_repeat_by_chance(decimals, ship):
    """A slow ship whose RTK noise exceeds her way per sample: 7 decimals are steps of 1 cm."""
    rng = np.random.default_rng(8)
    t = np.arange(0, 1200, 0.2)
    north, east = 60 * np.sin(t / 100), 60 * np.cos(t / 130)
    noise = 1.8e-7 * rng.standard_normal((2, len(t)))
    lat = np.round(54.0 + north / 111.3e3 + noise[0], decimals)
    lon = np.round(10.0 + east / 65.2e3 + 1.7 * noise[1], decimals)
    repeats = (np.diff(lat) == 0) & (np.diff(lon) == 0)
    assert repeats.any() == (decimals == 7)

    def findings():
        log = Recording("geo", (Signal("lat", t, lat), Signal("lon", t, lon)))
        return [f for f in check_recording(log, ship).findings if f.id == "position_hold"]

    assert not findings()
    late = [1200, 1201, 2300, 2301, 2302]
    for k in late:
        lat[k], lon[k] = lat[k - 1], lon[k - 1]
    (found,) = findings()
    assert set(late) <= set(between(t, found))


def test_a_moored_ship_may_repeat_its_position():
    rng = np.random.default_rng(2)
    t = np.arange(0, 300, 0.2)
    x, y = 0.05 * rng.standard_normal((2, len(t)))
    x[200], y[200] = x[199], y[199]
    assert not hold_findings(as_recording({"t": t, "x_n": x, "y_n": y}))


def test_samples_of_geographic_positions_are_interpolated_too():
    t = np.arange(0, 60, 0.2)
    rng = np.random.default_rng(4)
    lat = 63.4 + 1e-5 * t + 2e-5 * np.sin(t / 7) + 1e-8 * rng.standard_normal(len(t))
    lon = 10.3 + 2e-5 * t + 4e-5 * np.cos(t / 5) + 1e-8 * rng.standard_normal(len(t))
    lat[150], lon[150] = lat[149], lon[149]
    log = Recording("geo", (Signal("lat", t, lat), Signal("lon", t, lon)))
    vessel = vessel_from_dict(
        {"name": "b", "length": 5, "thruster": [{"type": "fixed", "speed": "n"}]}
    )
    (found,) = check_recording(log, vessel).findings
    assert (found.id, times(found)) == ("position_hold", (t[150],))
    mended = apply_repairs(log, [found])
    for name, value in (("lat", lat), ("lon", lon)):
        assert mended[name].value[150] == pytest.approx(0.5 * (value[149] + value[151]), abs=1e-12)


def test_all_at_once_each_is_named_once(ship):
    d = copied(41, 5.0)
    psi = d["psi"] = wrapped(d["psi"])
    k = int(crossings(psi)[0])
    psi[k] = 0.5 * (psi[k - 1] + psi[k + 1])
    for j in (700, 1200, 2100):
        for name in ("x_n", "y_n"):
            d[name][j] = d[name][j - 1]
    d["y_n"][1800:] -= 3.0
    d["u"][300] += 1.0
    log = as_recording(d)
    findings = check_recording(log, ship).findings
    ids = {"heading_wrap", "position_hold", "position_jump", "outlier"}
    assert {f.id for f in findings} == ids
    assert len(findings) == len(ids)
    made = import_recording(apply_repairs(log, findings), ship).segments
    assert len(made) == 2
    true = recorded(41, 5.0)
    joined = np.concatenate([s["psi"] for s in made])
    at = np.concatenate([s.t for s in made])
    assert np.abs(wrapped(joined - np.interp(at, true["t"], true["psi"]), -np.pi)).max() < 0.06


@pytest.mark.long
@pytest.mark.parametrize(("name", "seed"), [("kvlcc2-320m", 102), ("training-ship-105m", 101)])
def test_a_crash_stop_is_no_jump(name, seed):
    """A ship of others, stopped hard: in earth axes, or beside its thrusters, the way bends."""
    preset = presets()[name]
    vessel = vessel_from_dict(tomllib.loads(preset.ship.vessel_toml()))
    trial = preset.sail(kinds()["stopping"], seed=seed, step=1.0)
    columns = trial.columns()
    assert not jump_findings(as_recording(columns), vessel)
    # ten standard errors of a position, where the ship goes astern
    columns["x_n"] = columns["x_n"] + 10 * preset.ship.noise.position * (trial.t >= 1000.0)
    (found,) = jump_findings(as_recording(columns), vessel)
    assert times(found) == (1000.0,)


# how often


def smallest(seed, rate, rng):
    """A log with the smallest defects that must be found, and their rows."""
    d = copied(seed, rate, seconds=400, wide=bool(seed // 4 % 2))
    psi = d["psi"] = wrapped(d["psi"], -np.pi if seed % 3 else 0.0)
    n = len(psi)
    inner = [k for k in crossings(psi) if 5 < k < n - 5]
    wrap = int(rng.choice(inner)) if inner else None
    if wrap is not None:
        share = rng.uniform()
        psi[wrap] = share * psi[wrap - 1] + (1 - share) * psi[wrap + 1]
    speed = np.hypot(d["u"], d["v"])
    held = np.sort(rng.choice(np.flatnonzero(speed[20:-20] > 0.5) + 20, 3, replace=False))
    jump = int(rng.integers(10, n - 10))
    while np.abs(held - jump).min() < 5:
        jump = int(rng.integers(10, n - 10))
    angle = rng.uniform(0, TURN)
    d["x_n"][jump:] += 0.5 * np.cos(angle)
    d["y_n"][jump:] += 0.5 * np.sin(angle)
    for k in held:
        for name in ("x_n", "y_n"):
            d[name][k] = d[name][k - 1]
    return d, wrap, held.tolist(), jump


@pytest.mark.long
def test_the_smallest_defects_are_found_in_nearly_all_logs():
    """At least 95 % with the right place, less two binomial errors of 48 logs."""
    logs = 48
    found = {"heading_wrap": 0, "position_hold": 0, "position_jump": 0}
    planted = dict.fromkeys(found, 0)
    for k in range(logs):
        rng = np.random.default_rng([8, k])
        d, wrap, held, jump = smallest(4000 + k, (1.0, 2.0, 5.0, 10.0)[k % 4], rng)
        log = as_recording(d)
        if wrap is not None:
            planted["heading_wrap"] += 1
            wraps = wrap_findings(log)
            found["heading_wrap"] += bool(wraps) and between(d["t"], wraps[0]) == [wrap]
            log = apply_repairs(log, wraps)
        planted["position_hold"] += 1
        holds = hold_findings(log)
        found["position_hold"] += bool(holds) and between(d["t"], holds[0]) == held
        planted["position_jump"] += 1
        jumps = jump_findings(apply_repairs(log, holds))
        found["position_jump"] += [times(f) for f in jumps] == [(d["t"][jump],)]
    for kind, count in planted.items():
        least = count * (0.95 - 2 * np.sqrt(0.95 * 0.05 / count))
        assert found[kind] >= least, (kind, found[kind], count)


@pytest.mark.long
def test_clean_logs_have_none_of_these_defects():
    """At most 2 % false findings per check, plus two binomial errors of 64 logs."""
    logs = 64
    count = {"heading_wrap": 0, "position_hold": 0, "position_jump": 0}
    for k in range(logs):
        rng = np.random.default_rng([9, k])
        rate = (1.0, 2.0, 5.0, 10.0)[k % 4]
        d = copied(6000 + k, rate, seconds=300, wide=bool(k // 4 % 2), noise=(1.0, 0.3)[k // 8 % 2])
        d["psi"] = wrapped(d["psi"])
        n = len(d["t"])
        for name in ("x_n", "y_n"):
            if k % 5 == 1:
                # receivers wander
                d[name] += np.cumsum(0.02 / np.sqrt(rate) * rng.standard_normal(n))
            if k % 5 == 2:
                d[name] = np.round(d[name], 1)
            if k % 5 == 3:
                d[name] = d[name][np.arange(n) // 2 * 2]
        log = as_recording(d)
        count["heading_wrap"] += bool(wrap_findings(log))
        count["position_hold"] += bool(hold_findings(log))
        count["position_jump"] += bool(jump_findings(log))
    limit = 0.02 * logs + 2 * np.sqrt(0.02 * 0.98 * logs)
    assert all(c <= limit for c in count.values()), count


# real logs


@pytest.mark.long
def test_late_messages_of_the_tanker_model(data_folder):
    """Each of fifteen runs repeats positions to the last digit and then takes a double step."""
    from test_checks import ESSO

    vessel = vessel_from_dict(ESSO)
    for path in sorted((data_folder / "esso_osaka").glob("z*.csv")):
        (report,) = check_files([path], vessel)
        held = [f for f in report.findings if f.id == "position_hold"]
        assert len(held) == 1, path
        assert held[0].value >= 25


def test_the_antenna_of_the_drone_leaps_aside_for_three_seconds(data_folder):
    from test_checks import BLUEBOAT

    path = data_folder / "nmea/usv_202412071021.nmea"
    (report,) = check_files([path], vessel_from_dict(BLUEBOAT))
    jumps = [f for f in report.findings if f.id == "position_jump"]
    assert [round(f.value[1], 1) for f in jumps] == [-0.3, 0.3]
    assert times(jumps[1])[0] - times(jumps[0])[0] == pytest.approx(3.0, abs=0.3)


def test_a_speed_over_ground_that_leaps_is_no_jump_of_the_position(ship):
    d = copied(5, 1.0)
    t = d["t"]
    east, north = (np.gradient(d[n], t) for n in ("y_n", "x_n"))
    sog, cog = np.hypot(north, east), np.arctan2(east, north)
    k = len(t) // 2
    sog[k] *= 6
    d |= {"v_n": sog * np.cos(cog), "v_e": sog * np.sin(cog)}
    found = [f for f in spike_findings(as_recording(d)) if f.channel in ("v_n", "v_e")]
    assert found
    assert all(f.repair[0].channels == ("v_n", "v_e") for f in found)
