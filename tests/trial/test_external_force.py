"""Forces that the thrusters did not give: towed, pushed, held; and nothing on clean logs."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from foreign_ships import presets
from foreign_ships.manoeuvres import kinds
from virtual import PARAMETERS, as_recording, recorded

from greybox.channels import CHANNELS
from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate
from greybox.study.blind_sensors import gauss_markov
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses
from greybox.trial.checks.check import check_recording
from greybox.trial.checks.external_force import force_findings
from greybox.trial.log import make_log
from greybox.trial.raw_log import Recording, Signal
from greybox.trial.repair import apply_repairs
from greybox.vessel.toml import load_vessel, vessel_from_dict

SECONDS, LENGTH, FINE, WIND = 1200, 60, 0.5, 5.0
VESSEL = load_vessel("thesis")


def sailed(seed, share=0.0, *, fixed=False, gusts=0.0):
    """One ship of the thesis, pushed for a minute by a share of the thrust at half speed.

    Returns a recording at 2 Hz, and the start of the push [s].
    """
    structure, rng = get_structure("thesis"), np.random.default_rng([41, seed])
    n = round(SECONDS / FINE)
    hold, edge = (round(15 / FINE), round(60 / FINE)), round(5 / FINE)
    commands = {
        name: smoothed_pulses(rng, n, low, high, widths=hold, smoothing=edge)
        for name, low, high in (("n", 4, 20), ("alpha1", -0.5, 0.5), ("alpha2", -0.5, 0.5))
    }
    tau = make_log(VESSEL, commands, FINE).forces(structure.inputs).copy()
    known = {p: TRUE[p] for p in PARAMETERS}
    theta = np.array(list(known.values())) * FINE
    current, wind = rng.uniform(-0.2, 0.2, 2), WIND * rng.uniform(-1, 1, 2)
    d = np.column_stack([np.tile(current, (n, 1)), wind + gauss_markov(rng, n, gusts, 20 / FINE)])
    start, towards = int(rng.integers(60, SECONDS - LENGTH - 60)), rng.uniform(0, 2 * np.pi)

    def run():
        # half a step of Euler's rule would be a latency
        start = np.array([1.5, 0.5, 0.0])
        return simulate(structure, theta, start, tau[:-1], FINE, d=d[:-1], integrator="rk4")

    if share:
        free = run()
        half = 0.5 * np.quantile(np.abs(free.x[0][:, 0]), 0.95)
        push = share * abs(known["Xu"] + known["Xuu"] * half) * half
        rows = slice(round(start / FINE), round((start + LENGTH) / FINE))
        angle = towards - (free.psi[0][rows] if fixed else 0.0)
        tau[rows, structure.inputs.index("taux")] += push * np.cos(angle) / known["Xmu"]
        tau[rows, structure.inputs.index("tauy")] += push * np.sin(angle) / known["Ymu"]
    made = run()
    noise = dict(zip(("u", "v", "r"), np.sqrt([2e-4] * 3), strict=True))
    channels = {s: made.x[0][:, k] + noise[s] * rng.standard_normal(n) for k, s in enumerate("uvr")}
    channels["psi"] = made.psi[0] + 0.01 * rng.standard_normal(n)
    t = FINE * np.arange(n)
    return Recording(
        f"log{seed}",
        tuple(
            Signal(name, t, v, CHANNELS[name].unit if name in CHANNELS else None, name, True)
            for name, v in (channels | commands).items()
        ),
    ), start


def overlap(finding, start):
    low, high = finding.repair[0].interval
    return min(high, start + LENGTH) - max(low, start)


@pytest.mark.parametrize("fixed", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_push_is_found_where_it_acts_and_nowhere_else(fixed):
    for seed in range(1, 5):
        recording, start = sailed(seed, 0.5, fixed=fixed)
        (found,), _ = force_findings([recording], VESSEL)
        assert sum(overlap(f, start) for f in found) > 0.25 * LENGTH
        for finding in found:
            low, high = finding.repair[0].interval
            assert start - 20 < low < high < start + LENGTH + 20
            assert (finding.id, finding.safe) == ("external_force", False)
            assert finding.ci[0] < finding.value < finding.ci[1]


def test_clean_logs_have_no_finding_alone_and_together():
    recordings = [sailed(seed)[0] for seed in range(10, 16)]
    found, told = force_findings(recordings, VESSEL)
    assert not any(found)
    assert told == [None] * 6
    for recording in recordings:
        assert force_findings([recording], VESSEL) == ([[]], [None])


def test_the_colour_of_the_noise_is_not_taken_for_known_in_a_short_log():
    # a force of its own for 36 s of these five minutes lets the rest pass for quieter than it is
    clean = as_recording(recorded(55066, 5.0, seconds=313.888))
    assert force_findings([clean], VESSEL) == ([[]], [None])


@pytest.mark.parametrize(
    ("seed", "rate", "lengths"),
    [
        (105460, 2.0, (304.396, 364.613, 280.43, 248.989)),
        (106060, 1.0, (243.0, 237.0, 202.0, 283.0)),
    ],
)
def test_short_logs_in_currents_of_their_own_are_clean_together(seed, rate, lengths):
    # turning fast in winds and currents; what a current does in products is no force from outside
    logs = []
    for k, seconds in enumerate(lengths):
        log = recorded(seed + k, rate, seconds=seconds, wide=k > 0, noise=0.3)
        logs.append(as_recording({n: x for n, x in log.items() if n not in ("u_q", "v_q")}))
    assert force_findings(logs, VESSEL) == ([[]] * 4, [None] * 4)


def test_the_stretch_is_left_out_where_the_user_says_so():
    recording, _ = sailed(2, 0.3)
    (found,), _ = force_findings([recording], VESSEL)
    left = apply_repairs(recording, found)
    low, high = found[0].repair[0].interval
    assert not ((left["u"].t > low) & (left["u"].t < high)).any()
    assert len(left["u"]) > 0.85 * len(recording["u"])
    (again,), _ = force_findings([left], VESSEL)
    assert not again


def test_a_ship_that_is_held_is_found():
    """Held for 80 s: thrust ahead, and no speed."""
    log, _ = sailed(20)
    t, rng = log["u"].t, np.random.default_rng(5)
    held = (t > 600) & (t < 680)
    level = {"n": 15.0, "alpha1": 0.0, "alpha2": 0.0}
    signals = []
    for s in log.signals:
        value = s.value.copy()
        if s.name in ("u", "v", "r"):
            value[held] = 0.014 * rng.standard_normal(held.sum())
        value[held] = level.get(s.name, value[held])
        signals.append(s.with_value(value))
    (found,), _ = force_findings([Recording("held", tuple(signals))], VESSEL)
    assert any(590 < f.repair[0].interval[0] < 680 and f.value > 0.5 for f in found)


def test_a_velocity_that_jumps_and_comes_back_is_no_force():
    log, _ = sailed(21)
    jump = 0.25 * ((log["u"].t > 500) & (log["u"].t < 506))
    signals = tuple(s.with_value(s.value + jump) if s.name == "u" else s for s in log.signals)
    assert force_findings([Recording("jumps", signals)], VESSEL) == ([[]], [None])


def test_a_log_without_thrusters_or_too_short_cannot_tell():
    log, _ = sailed(22)
    bare = log.with_signals(s for s in log.signals if s.name != "n")
    _, (told,) = force_findings([bare], VESSEL)
    assert (told.status, " n" in told.sentence) == ("cannot tell", True)
    short = log.with_signals(Signal(s.name, s.t[:300], s.value[:300], s.unit) for s in log.signals)
    _, (told,) = force_findings([short], VESSEL)
    assert told.status == "cannot tell"


def test_a_push_changes_no_other_finding():
    recording, start = sailed(1, 0.3)
    before = [f.id for f in check_recording(sailed(1)[0], VESSEL).findings]
    found = check_recording(recording, VESSEL).findings
    assert [f.id for f in found] == [*before, "external_force"]
    assert overlap(found[-1], start) > 0.5 * LENGTH


@pytest.mark.long
def test_a_push_is_found_and_clean_logs_are_clean():
    """60 ships each in wind and current: 80 % of pushes by 30 % found, at most 2 % false."""
    hits = false = 0
    for seed in range(60):
        recording, start = sailed(100 + seed, 0.3, fixed=bool(seed % 2))
        (found,), _ = force_findings([recording], VESSEL)
        hits += any(overlap(f, start) > 0.3 * LENGTH for f in found)
        (found,), _ = force_findings([sailed(200 + seed, gusts=2.0 * (seed % 2))[0]], VESSEL)
        false += bool(found)
    assert hits / 60 > 0.8 - 3 * np.sqrt(0.8 * 0.2 / 60)
    assert false / 60 < 0.02 + 3 * np.sqrt(0.02 * 0.98 / 60)


@pytest.mark.long
def test_what_a_ship_does_once_is_no_force_from_outside():
    """A tanker of others turns hard once: what the model lacks there is no push."""
    preset = presets()["kvlcc2-320m"]
    vessel = vessel_from_dict(tomllib.loads(preset.ship.vessel_toml()))
    trials = ("zigzag-20", "turn-starboard", "turn-starboard-15", "zigzag-20-port")
    logs = [
        as_recording(preset.sail(kinds()[k], seed=100, step=1.0).columns(every=4)) for k in trials
    ]
    assert force_findings(logs, vessel) == ([[]] * 4, [None] * 4)


def test_wind_that_one_log_measures_and_another_does_not():
    (calm, _), (blown, _) = sailed(1), sailed(2)
    u, v, t = blown["u"].value, blown["v"].value, blown["u"].t
    wind = tuple(Signal(n, t, -x, "m/s", n, True) for n, x in (("u_q", u), ("v_q", v)))
    both = [calm, Recording(blown.name, (*blown.signals, *wind))]
    found, told = force_findings(both, VESSEL)
    assert found == [[], []]
    assert told == [None, None]
