"""Blind trials: the simulator against others, and each effect doing what it says."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from greybox.errors import UsageError
from greybox.model.catalogue import get_structure
from greybox.model.run.simulation import simulate
from greybox.study.blind import Order, draw, draw_many, write
from greybox.study.blind_causes import CAUSES, Effect, with_terms
from greybox.study.blind_conditions import Conditions, blind_vessel
from greybox.study.blind_effects import EFFECTS, UNKNOWN, act
from greybox.study.blind_inputs import KINDS
from greybox.study.blind_sensors import gauss_markov, narrow_band
from greybox.study.blind_ship import LEAD, NAMES, Ship, simulate_ships
from greybox.study.chapter6 import TRUE
from greybox.trial.convert.read import read_log
from greybox.vessel.force import generalised_force

STILL = Conditions(euler=True, noise=0.0, process=0.0, samples=400)
SEED = 4


@pytest.fixture(scope="module")
def trials():
    """One trial an effect, all of the same ship and inputs, without noise."""
    ids = ["none", *EFFECTS]
    rngs = [np.random.default_rng(SEED) for _ in ids]
    orders = [Order(() if n == "none" else (n,)) for n in ids]
    return dict(zip(ids, draw_many(rngs, orders, STILL), strict=True))


def wind_of(log):
    c, s = np.cos(log["psi"]), np.sin(log["psi"])
    along, across = log["u"] - log["u_q"], log["v"] - log["v_q"]
    return np.column_stack([c * along - s * across, s * along + c * across])


def one_step(trial, *, log=None, tau=None, terms=(), d=None, change=None):
    """Next state less what (3.51) with the true parameters gives, (N-1, 3)."""
    log = trial.estimation if log is None else log
    structure = get_structure("thesis").with_terms(*[t for t, _ in terms])
    values = dict(trial.ship) | dict(terms) | (change or {})
    theta = np.array([values[n] for n in structure.parameters])
    x = log.states(("u", "v", "r"))
    tau = log.forces(("taux", "tauy", "taun")) if tau is None else tau
    d = np.zeros(4) if d is None else d
    d = np.broadcast_to(d, (len(x), 4))
    run = simulate(
        structure, theta, x, tau[:, None], 1.0, psi0=log["psi"], d=d[:, None]
    )  # fmt: skip
    return x[1:] - run.x[:-1, 1]


def forces(log, **columns):
    """Generalised force of the log's commands, some of them replaced."""
    commands = {n: columns.get(n, log[n]) for n in log.vessel.commands}
    made = generalised_force(log.vessel, commands)
    return np.column_stack([made[n] for n in ("taux", "tauy", "taun")])


def lagged(value, lag):
    out = value.copy()
    for k in range(1, len(out)):
        out[k] = value[k - 1] + (out[k - 1] - value[k - 1]) * np.exp(-1 / lag)
    return out


def test_undisturbed_euler_log_is_a_free_run_of_the_engine():
    trial = draw(np.random.default_rng(1), euler=True, noise=0.0, process=0.0)
    for log in (trial.estimation, trial.validation):
        structure = get_structure("thesis")
        theta = np.array([trial.ship[n] for n in structure.parameters])
        tau = log.forces(structure.inputs)
        run = simulate(
            structure, theta, log.states(("u", "v", "r"))[0], tau[:-1], 1.0, psi0=log["psi"][0]
        )  # fmt: skip
        np.testing.assert_allclose(run.x[0], log.states(("u", "v", "r")), atol=1e-9)
        np.testing.assert_allclose(run.psi[0], log["psi"], atol=1e-8)


def corrected(name, trial):
    """What is left of the one-step equation once the effect is put into the model."""
    log = trial.estimation
    p = trial.truth[0].parameters if trial.truth else {}
    n = {c: log[c] for c in ("n1", "n2")}
    if name == "current":
        return one_step(trial, d=np.array([p["current_north"], p["current_east"], 0, 0]))
    if name == "wind":
        return one_step(trial, d=np.column_stack([np.zeros((len(log), 2)), wind_of(log)]))
    if name == "thruster_gain":
        weak = {c: v * p.get(f"gain_{c}", 1.0) for c, v in n.items()}
        return one_step(trial, tau=forces(log, **weak))
    cause, _, column = name.partition(":")
    if column and cause == "thruster_lag":
        return one_step(trial, tau=forces(log, **{column: lagged(log[column], p["lag"])}))[150:]
    if column:
        late = round(p["delay"])
        return one_step(trial, tau=forces(log, **{column: np.roll(log[column], late)}))[late:]
    if name == "rate_limit":
        ((key, rate),) = p.items()
        column = key.removeprefix("rate_")
        wanted, reached = log[column], log[column].copy()
        for k in range(1, len(reached)):
            reached[k] = reached[k - 1] + np.clip(wanted[k - 1] - reached[k - 1], -rate, rate)
        # where it was caught up once, nothing is left of how it began
        return one_step(trial, tau=forces(log, **{column: reached}))[200:]
    if name == "thruster_lag":
        if p["variant"] == "speed":
            slow = {c: lagged(v, p["lag"]) for c, v in n.items()}
            return one_step(trial, tau=forces(log, **slow))[150:]
        return one_step(trial, tau=lagged(forces(log), p["lag"]))[150:]
    if name == "input_delay":
        late = round(p["delay"])
        return one_step(trial, tau=np.roll(forces(log), late, axis=0))[late:]
    if name == "quadratic_thrust":
        q, ref = p["quadratic_share"], p["reference"]
        law = {c: (1 - q) * v + q * v * np.abs(v) / ref for c, v in n.items()}
        return one_step(trial, tau=forces(log, **law))
    if name == "advance_speed":
        loss = p["loss"]
        terms = (
            ("Y_u*tauy", -loss * trial.ship["Ymu"]),
            ("N_u*taun", -loss * trial.ship["Nmu"]),
        )
        return one_step(trial, terms=terms)
    if name in CAUSES and CAUSES[name].act is with_terms:
        return one_step(trial, terms=tuple(p.items()))
    if name == "parameter_change":
        (key,) = (k for k in p if k.endswith("_factor"))
        changed = {key[:-7]: trial.ship[key[:-7]] * p[key]}
        at = int(p[key[:-7] + "_time"])
        np.testing.assert_allclose(
            one_step(trial, log=trial.validation, change=changed), 0, atol=1e-12
        )
        return np.vstack([one_step(trial)[:at], one_step(trial, change=changed)[at:]])
    if name == "dead_band":
        cut = {c: np.where(np.abs(v) < p["dead_band"], 0.0, v) for c, v in n.items()}
        return one_step(trial, tau=forces(log, **cut))
    if name == "interaction":
        race = p["loss"] * np.exp(-(((log["alpha1"] - p["centre"]) / p["width"]) ** 2))
        return one_step(trial, tau=forces(log, n2=n["n2"] * (1 - np.where(n["n1"] > 0, race, 0))))
    if name == "backlash":
        played = {}
        for c in ("alpha1", "alpha2"):
            out = log[c].copy()
            for k in range(1, len(out)):
                out[k] = np.clip(out[k - 1], log[c][k] - p["half_play"], log[c][k] + p["half_play"])
            played[c] = out
        # where the play was taken up once, nothing is left of how it began
        return one_step(trial, tau=forces(log, **played))[150:]
    left = one_step(trial)
    c, s, t = np.cos(log["psi"]), np.sin(log["psi"]), log.t + LEAD
    u, v = log["u"], log["v"]
    if name == "slow_force":
        push = p["amplitude"] * np.cos(2 * np.pi * t / p["period"] + p["phase"])
        north, east = push * np.cos(p["towards"]), push * np.sin(p["towards"])
        left[:, 0] -= (c * north + s * east)[:-1]
        left[:, 1] -= (c * east - s * north)[:-1]
    if name == "uneven_damping":
        left[:, 1] -= (trial.ship["Yv"] * p["unevenness"] * np.maximum(v, 0))[:-1]
    if name == "shallow":
        beyond = np.maximum(np.abs(u) - p["threshold"], 0)
        left[:, 0] -= (p["coefficient"] * beyond**2 * np.sign(u))[:-1]
    return left


# Euler's rule reads a command at the samples, where it is the same whatever lies between
SENSOR = (
    "feedback_sampling",
    "heading_bias",
    "lever_arm",
    "angle_offset",
    "clock_offset",
    "waves",
    "sign",
)


@pytest.mark.parametrize("name", [n for n in ("none", *EFFECTS) if n not in SENSOR])
def test_the_effect_in_the_model_leaves_nothing(name, trials):
    trial = trials[name]
    np.testing.assert_allclose(corrected(name, trial), 0, atol=1e-9)
    if name != "none":
        assert np.abs(one_step(trial)).max() > 1e-3


def test_a_feedback_is_not_held_between_samples():
    """The same as a ship all of whose commands move on straight lines, and no held one."""
    made = {"noise": 0.0, "process": 0.0, "samples": 200}
    own = draw(np.random.default_rng(SEED), ("feedback_sampling",), **made).estimation
    moving = draw(np.random.default_rng(SEED), (), linear=True, **made).estimation
    held = draw(np.random.default_rng(SEED), (), **made).estimation
    np.testing.assert_array_equal(own["u"], moving["u"])
    assert np.abs(own["u"] - held["u"]).max() > 1e-4


def test_heading_bias_turns_heading_and_perhaps_velocities(trials):
    true = trials["none"].estimation
    for bias, variant in ((0.1, "body"), (-0.1, "earth")):
        log = sensed(Effect("heading_bias", {"heading_bias": bias, "variant": variant}))
        np.testing.assert_allclose(log["psi"] - true["psi"], bias, atol=1e-12)
        np.testing.assert_allclose(log["x_n"], true["x_n"], atol=1e-12)
        turn = 0.0 if variant == "body" else bias
        speed = (true["u"] + 1j * true["v"]) * np.exp(-1j * turn)
        np.testing.assert_allclose(log["u"] + 1j * log["v"], speed, atol=1e-12)


def test_lever_arm_moves_positions_and_perhaps_velocities(trials):
    true = trials["none"].estimation
    for variant in ("positions", "antenna"):
        log = sensed(
            Effect("lever_arm", {"lever_arm_x": 6.0, "lever_arm_y": -2.0, "variant": variant})
        )
        arm = (6.0 - 2.0j) * np.exp(1j * true["psi"])
        np.testing.assert_allclose(log["x_n"] - true["x_n"], arm.real, atol=1e-9)
        np.testing.assert_allclose(log["y_n"] - true["y_n"], arm.imag, atol=1e-9)
        on = variant == "antenna"
        np.testing.assert_allclose(log["u"], true["u"] + on * true["r"] * 2.0, atol=1e-12)
        np.testing.assert_allclose(log["v"], true["v"] + on * true["r"] * 6.0, atol=1e-12)


def test_offset_sign_and_clock_are_those_of_the_log(trials):
    true = trials["none"].estimation
    log = sensed(Effect("angle_offset", {"offset_alpha2": 0.1}))
    np.testing.assert_allclose(true["alpha2"] - log["alpha2"], 0.1)
    np.testing.assert_array_equal(true["u"], log["u"])
    for channel in ("alpha1", "r"):
        log = sensed(Effect("sign", {"channel": channel}))
        np.testing.assert_array_equal(log[channel], -true[channel])
    log = sensed(Effect("clock_offset", {"clock_r": 3.0}))
    np.testing.assert_allclose(log["r"][3:], true["r"][:-3], atol=1e-12)
    np.testing.assert_array_equal(log["v"], true["v"])


def test_waves_rock_rate_and_heading_alike(trials):
    true, log = trials["none"].estimation, trials["waves"].estimation
    rate, angle = log["r"] - true["r"], log["psi"] - true["psi"]
    assert rate.std() == pytest.approx(3 * np.sqrt(2e-4), rel=0.3)
    # a sampled sine of 0.12 Hz is differentiated to within a tenth
    assert np.abs(np.gradient(angle) - rate).max() < 0.15 * np.abs(rate).max()
    power = np.abs(np.fft.rfft(rate)) ** 2
    frequency = np.fft.rfftfreq(len(rate))
    near = trials["waves"].truth[0].number("frequency")
    band = (frequency > 0.7 * near) & (frequency < 1.3 * near)
    assert power[band].sum() > 0.9 * power.sum()


def sensed(effect):
    """The estimation log of the trial without effects, seen by a faulty sensor."""
    from greybox.study import blind

    draft = blind._drafted(np.random.default_rng(SEED), STILL)
    history = blind._sail([draft], STILL)
    blind._disturb(draft, Order(), history, 0, STILL)
    draft.effects = (effect,)
    return blind._logged(draft, blind._sail([draft], STILL), 0, STILL).estimation


def scalar_rates(theta, x, tau, wind, current):
    """(3.51) once more, with complex numbers for the plane."""
    p = dict(zip(NAMES, theta, strict=True))
    u, v, r, psi = x
    turn = np.exp(-1j * psi)
    water = u + 1j * v - turn * complex(*current)
    air = u + 1j * v - turn * complex(*wind)
    a, b, c, d = water.real, water.imag, air.real, air.imag
    return [
        p["Xu"] * a + p["Xvr"] * b * r + p["Xuu"] * abs(a) * a + p["Wuu"] * abs(c) * c
        + p["Xmu"] * tau[0] + p["Xkappa"] * a * tau[0],
        p["Yv"] * b + p["Yur"] * a * r + p["Yvv"] * abs(b) * b + p["Yvr"] * abs(b) * r
        + p["Wvv"] * abs(d) * d + p["Ymu"] * tau[1],
        p["Nr"] * r + p["Nuv"] * a * b + p["Nvv"] * abs(b) * b + p["Nvr"] * abs(b) * r
        + p["Wuv"] * c * d + p["Nmu"] * tau[2],
        r,
    ]  # fmt: skip


@pytest.mark.parametrize("linear", [False, True])
def test_runge_kutta_agrees_with_scipy(linear):
    rng = np.random.default_rng(3)
    seconds = 60
    theta = np.array([TRUE[n] for n in NAMES])
    wind = gauss_markov(rng, seconds, 5.0, 20.0)
    ship = Ship(
        theta,
        KINDS["manoeuvres"](rng, seconds, False),
        np.array([1.5, 0.3, 0.02, 0.4]),
        wind,
        np.zeros((seconds, 3)),
        current=(0.3, -0.2),
        speed_lag=5.0 if linear else 0.0,
    )
    history = simulate_ships([ship], linear=linear)
    commands = history.commands[:, :, 0]
    x = ship.start
    # speeds are a state of their own: they lag
    n = commands[0, :2]
    for k in range(seconds - 1):

        def wanted(s, k=k):
            return commands[k] + linear * s * (commands[k + 1] - commands[k])

        def rates(s, y, k=k):
            want = wanted(s, k)
            speeds = y[4:] if linear else want[:2]
            push = speeds * np.exp(1j * want[2:])
            tau = [push.sum().real, push.sum().imag, 9 * (push[0] - push[1]).imag]
            air = wind[k] + s * (wind[k + 1] - wind[k])
            change = (want[:2] - y[4:]) / 5.0 if linear else np.zeros(2)
            return [*scalar_rates(theta, y[:4], tau, air, ship.current), *change]

        y = solve_ivp(rates, (0, 1), [*x, *n], rtol=1e-10, atol=1e-12).y[:, -1]
        x, n = y[:4], y[4:]
    # a modulus has a kink where it changes sign; a lag follows moving commands to second order
    np.testing.assert_allclose(history.x[-1, :, 0], x, atol=2e-3 if linear else 2e-6)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    files = ("vessel.toml", "estimation.csv", "validation.csv", "truth.json")
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        trial = draw(np.random.default_rng(seed), ("current", "waves"), samples=60, gusts=True)
        write(trial, tmp_path / folder)
    for name in files:
        a, b, c = ((tmp_path / f / name).read_bytes() for f in "abc")
        assert a == b
        assert (a == c) == (name == "vessel.toml")
    truth = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert [e["id"] for e in truth["effects"]] == ["current", "waves"]
    log = read_log(tmp_path / "a" / "estimation.csv", blind_vessel())
    again = draw(np.random.default_rng(5), ("current", "waves"), samples=60, gusts=True)
    np.testing.assert_allclose(log["v"], again.estimation["v"], rtol=1e-12)
    assert not any("current" in p.read_text() for p in (tmp_path / "a").glob("*.csv*"))


def test_trials_sailed_together_are_those_sailed_alone(trials):
    alone = draw(np.random.default_rng(SEED), ("thruster_lag",), **STILL.__dict__)
    both = trials["thruster_lag"]
    assert alone.truth == both.truth
    np.testing.assert_allclose(alone.validation["v"], both.validation["v"], atol=1e-9)


def test_size_scales_the_effect_and_moves_nothing_else():
    def trial(size):
        return draw(
            np.random.default_rng(8), ("current",), size=size, euler=True, samples=100
        )  # fmt: skip

    none = draw(np.random.default_rng(8), euler=True, samples=100)
    whole, half, zero = trial(1.0), trial(0.5), trial(0.0)
    for key, value in whole.truth[0].parameters.items():
        assert half.truth[0].parameters[key] == pytest.approx(value / 2)
    np.testing.assert_array_equal(zero.estimation["u"], none.estimation["u"])
    np.testing.assert_array_equal(whole.estimation["n1"], none.estimation["n1"])


@pytest.mark.parametrize("kind", KINDS)
def test_ships_move_sensibly_and_logs_hold_what_was_asked(kind):
    conditions = Conditions(kind=kind, gusts=True, colour="memory", euler=True, anemometer=True)
    rngs = [np.random.default_rng([9, i]) for i in range(12)]
    trials = draw_many(rngs, [Order()] * 12, conditions)
    x = np.concatenate([t.estimation.states(("u", "v", "r")) for t in trials])
    assert np.abs(x[:, 0]).max() < 5
    assert np.sqrt((x[:, 2] ** 2).mean()) < 0.1
    assert np.quantile(np.abs(x[:, 2]), 0.99) < 0.2
    both = (np.sign(np.quantile(x[:, 1], [0.1, 0.9])) == [-1, 1]).all()
    assert both == (kind != "pulses")
    log = trials[0].estimation
    assert set(log.channels) == set("u v r psi x_n y_n u_q v_q n1 n2 alpha1 alpha2".split())
    # nobody measures the gusts
    noise = wind_of(log).std(axis=0)
    assert noise == pytest.approx(0.2, rel=0.1)
    few = draw(
        np.random.default_rng(0), kind=kind, single=True, positions=False, samples=60, euler=True
    )
    assert set(few.estimation.channels) == set("u v r psi n alpha1 alpha2".split())


def test_noises_have_their_variances():
    quiet = draw(np.random.default_rng(10), noise=0.0, euler=True)
    loud = draw(np.random.default_rng(10), euler=True)
    for name, std in (("u", np.sqrt(2e-4)), ("r", np.sqrt(2e-4)), ("psi", 0.01), ("x_n", 0.1)):
        found = (loud.estimation[name] - quiet.estimation[name]).std()
        assert found == pytest.approx(std, rel=4 / np.sqrt(2 * 1200))
    left = one_step(quiet)
    assert left.std(axis=0) == pytest.approx([1e-3, 1e-3, 3e-4], rel=4 / np.sqrt(2 * 1200))
    slow = gauss_markov(np.random.default_rng(0), 40000, 2.0, 20.0)
    assert slow.std() == pytest.approx(2.0, rel=0.1)
    assert np.mean(slow[1:] * slow[:-1]) / slow.var() == pytest.approx(np.exp(-1 / 20), abs=0.01)
    motion, way = narrow_band(np.random.default_rng(1), np.arange(0, 50, 0.01), 0.1, 1.0)
    np.testing.assert_allclose(np.gradient(way, 0.01)[1:-1], motion[1:-1], atol=1e-3)


def test_two_effects_act_together():
    trial = draw(np.random.default_rng(11), ("cubic_damping", "crossflow"), **STILL.__dict__)
    terms = [item for e in trial.truth for item in e.parameters.items()]
    np.testing.assert_allclose(one_step(trial, terms=tuple(terms)), 0, atol=1e-9)


def test_a_change_that_came_to_stay_or_comes_again():
    effect = Effect("parameter_change", {"Yv_factor": 2.0, "Yv_time": 30.0})
    still = np.zeros((3, 2))
    ship = Ship(np.zeros(18), KINDS["pulses"](np.random.default_rng(0), 3, False), np.zeros(4),
                still, np.zeros((3, 3)))  # fmt: skip
    assert act(ship, (effect,), later=False).change == (NAMES.index("Yv"), 2.0, LEAD + 30.0)
    assert act(ship, (effect,), later=True).change == (NAMES.index("Yv"), 2.0, 0.0)
    inside = replace(STILL, change_inside=True)
    trial = draw(np.random.default_rng(SEED), ("parameter_change",), **inside.__dict__)
    left = np.abs(one_step(trial, log=trial.validation)).max(axis=1)
    (time,) = (v for k, v in trial.truth[0].parameters.items() if k.endswith("_time"))
    assert left[: int(time)].max() < 1e-9
    assert left[int(time) :].max() > 1e-4


@pytest.mark.parametrize(
    ("effects", "conditions", "words"),
    [
        (("curent",), {}, "Did you mean 'current'"),
        (("uneven_damping",), {"kind": "pulses"}, "sway to both sides"),
        (("current", "current"), {}, "stands twice"),
        (("thruster_gain",), {"single": True}, "1 speed column"),
        ((), {"kind": "zigzags"}, "Did you mean 'zigzag'"),
        ((), {"colour": "pink"}, "no colour 'pink'"),
        (("cubic_damping",), {"euler": True, "samples": 60}, "ran away"),
    ],
)
def test_what_cannot_be_drawn_says_so(effects, conditions, words):
    size = -1e6 if words == "ran away" else 1.0
    with pytest.raises(UsageError, match=words):
        draw(np.random.default_rng(0), effects, size=size, **conditions)


def test_no_unknown_effect_has_the_name_of_a_cause():
    assert not set(CAUSES) & set(UNKNOWN)
    with pytest.raises(TypeError, match="minutes"):
        draw(np.random.default_rng(0), minutes=20)
