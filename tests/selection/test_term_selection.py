"""Selection of terms by free runs: what enters, how many, and what of it is told."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from foreign_ships import presets, write_campaign
from virtual import virtual_log

from greybox.commands.common import read_logs
from greybox.estimation.output_error import OutputErrorOptions
from greybox.estimation.prediction_verdict import SomeHeldDiverge
from greybox.model.catalogue import get_structure, structure_for
from greybox.model.model import load_model
from greybox.model.run.simulation import simulate
from greybox.selection import term_selection
from greybox.selection.cross_validation import Refit, parts_of
from greybox.selection.estimate import _leaves_more, at_own_pace, estimate_model, nominal_model
from greybox.selection.family import family_for, first_terms, spell_structure
from greybox.selection.free_run_selection import FreeRunSelection, Selected
from greybox.selection.term_selection import _moving, _staying, select_terms
from greybox.trial.log import make_log
from greybox.validation.fit import average_fit, run_model
from greybox.vessel.force import force_inputs
from greybox.vessel.thrust import ThrustLaw
from greybox.vessel.toml import load_vessel, vessel_from_dict
from greybox.vessel.vessel import Actuation

SHIPS = [("taux", "tauy", "taun"), ("taux", "taun"),
         ("taux", "race", "rudder", "race_drag", "rudder_drag")]  # fmt: skip


@pytest.mark.parametrize("inputs", SHIPS)
@pytest.mark.parametrize("wind", [False, True])
def test_any_set_of_the_family_has_a_name_that_gives_it_back(inputs, wind):
    names = family_for(inputs, wind, False).parameters
    rng = np.random.default_rng(1)
    for share in (0.2, 0.5, 1.0):
        chosen = tuple(n for n in names if rng.random() < share)
        made = structure_for(spell_structure(chosen, inputs), inputs)
        assert set(made.parameters) == set(chosen)
    beginnings, core = first_terms(inputs)
    assert all(set(core) <= set(first) <= set(names) for first in beginnings)
    # without thrust a constant speed is a trap: neither it nor resistance helps alone
    assert "Xmu" in core


@pytest.fixture(scope="module")
def modulus_log():
    """A log of a ship with two terms more than the selection begins with."""
    vessel = load_vessel("thesis")
    structure = get_structure("linear").with_terms("N_|r|r", "Xuu")
    values = {"Xu": -0.02, "Xvr": 0.3, "Xmu": 1e-3, "Yv": -0.1, "Yur": -0.2, "Ymu": 1e-3,
              "Nr": -0.1, "Nuv": -5e-4, "Nmu": 1e-4, "N_|r|r": -3.0, "Xuu": -0.01}  # fmt: skip
    rng = np.random.default_rng(3)
    samples = 700
    steps = np.repeat(rng.uniform(-1, 1, (samples // 35, 3)), 35, axis=0)
    commands = {"n": 15 + 5 * steps[:, 0], "alpha1": steps[:, 1], "alpha2": 0.8 * steps[:, 2]}
    tau = make_log(vessel, commands, 1.0).forces(structure.inputs)
    theta = np.array([values[n] for n in structure.parameters])
    run = simulate(structure, theta, np.array([1.0, 0.0, 0.0]), tau[:-1], 1.0)
    # as it is recorded: rounding errors of the simulation do not decide which sets are tried
    x = (run.x[0] + rng.standard_normal((samples, 3)) * [0.02, 0.01, 1e-3]).round(9)
    channels = commands | dict(zip("uvr", x.T, strict=True)) | {"psi": run.psi[0]}
    return make_log(vessel, channels, 1.0, "modulus")


def test_the_terms_that_a_ship_has_enter_first(modulus_log):
    inputs = force_inputs(modulus_log.vessel)
    selection = FreeRunSelection([modulus_log], family_for(inputs, False, True), "augmented")
    (_, first), stay = first_terms(inputs)
    sets = selection.path(first, stay, len(first) + 4)
    assert "N_|r|r" in sets[-1].terms
    grown = [s.cost for s in sets if s.change.startswith("+")]
    assert grown == sorted(grown, reverse=True)


def test_a_current_in_which_the_ship_turns_brings_the_turn_of_the_water(modulus_log):
    """What forces change is the velocity through the water (Fossen, 2011, section 8.3)."""
    vessel, current = modulus_log.vessel, np.array([0.3, -0.2, 0.0, 0.0])
    structure = get_structure("linear").with_terms("N_|r|r", "Xuu", "X_r*vc", "Y_r*uc")
    values = {"Xu": -0.02, "Xmu": 1e-3, "Yv": -0.1, "Yur": -0.2, "Ymu": 1e-3, "Nr": -0.1,
              "Nmu": 1e-4, "N_|r|r": -3.0, "Xuu": -0.01, "X_r*vc": 1.0, "Y_r*uc": -1.0}  # fmt: skip
    theta = np.array([values.get(n, 0.0) for n in structure.parameters])
    tau = modulus_log.forces(structure.inputs)
    run = simulate(structure, theta, np.array([1.0, 0.0, 0.0]), tau[:-1], 1.0, d=current)
    x = run.x[0] + np.random.default_rng(5).standard_normal(run.x[0].shape) * [0.02, 0.01, 1e-3]
    channels = modulus_log.channels | dict(zip("uvr", x.T, strict=True)) | {"psi": run.psi[0]}
    log = replace(modulus_log, channels=channels)
    inputs = force_inputs(vessel)
    selection = FreeRunSelection([log], family_for(inputs, False, True), "augmented")
    (alone, _), stay = first_terms(inputs)
    chosen = selection.path(alone, stay, len(alone) + 8)[-1]
    assert {"X_r*vc", "Y_r*uc", "current_north", "current_east"} <= set(chosen.terms)
    asked = structure_for("linear-Xvr-Nuv+N_|r|r+Xuu+X_r*vc+Y_r*uc", inputs)
    begun = nominal_model(asked, np.array([0.8 * values[n] for n in asked.parameters]), [log])
    model = estimate_model(
        [log], structure=asked.name, method="oe", predictor="augmented", nominal=begun
    ).model()
    std = np.sqrt(np.diag(model.covariance))
    for name in ("X_r*vc", "Y_r*uc", "Yur", "N_|r|r"):
        i = model.names.index(name)
        assert abs(model.theta[i] - values[name]) < 4 * std[i]
        assert std[i] < 0.3 * abs(values[name])


def test_what_enters_is_what_lowers_the_error_most_of_all_that_are_fitted(modulus_log):
    """Beside the score: every single term is fitted to the end."""
    inputs = force_inputs(modulus_log.vessel)
    family = family_for(inputs, False, False)
    selection = FreeRunSelection([modulus_log], family, "augmented")
    (_, first), _ = first_terms(inputs)
    chosen = selection.path(first, first, len(first) + 1)[1]
    assert chosen.change == "+N_|r|r"
    least = {}
    for name in ("N_|r|r", "Xuu", "Yvv", "Nvv", "Y_|r|r", "X_vv", "N_rrr", "X_uu"):
        (only,) = FreeRunSelection([modulus_log], family, "augmented").path(
            (*first, name), (*first, name), len(first) + 1
        )
        least[name] = only.cost
    assert min(least, key=least.__getitem__) == "N_|r|r"
    assert chosen.cost == pytest.approx(min(least.values()), rel=0.01)


def test_damping_never_drives_the_ship(modulus_log):
    inputs = force_inputs(modulus_log.vessel)
    family = family_for(inputs, False, False)
    selection = FreeRunSelection([modulus_log], family, "augmented")
    (_, first), stay = first_terms(inputs)
    for one in selection.path(first, stay, 20):
        for term in family.terms:
            if term.dissipates:
                assert one.p[selection.names.index(term.name)] <= 0


def test_a_channel_that_never_moves_lets_its_terms_leave(modulus_log):
    log = replace(modulus_log, channels=modulus_log.channels | {"v": 0 * modulus_log["v"]})
    inputs = force_inputs(log.vessel)
    selection = FreeRunSelection([log], family_for(inputs, False, False), "basic")
    (_, first), stay = first_terms(inputs)
    sets = selection.path(first, stay, len(first) + 2)
    assert np.isfinite(sets[-1].cost)
    assert not {"Yv", "Nuv", "Xvr"} & {n for n in sets[-1].terms if n not in stay}


def test_what_the_log_cannot_tell_from_damping_is_damping(modulus_log):
    """u r and |u| r are one on a log ahead; astern the first would drive the ship."""
    assert (modulus_log["u"] > 0).all()
    inputs = force_inputs(modulus_log.vessel)
    selection = FreeRunSelection([modulus_log], family_for(inputs, False, True), "augmented")
    (alone, _), stay = first_terms(inputs)
    sets = selection.path(alone, stay, len(alone) + 4)
    assert any(len(one.terms) > len(alone) for one in sets)
    for one in sets:
        assert not {"X_uu", "Y_uv", "N_ur"} & set(one.terms)


def test_a_published_structure_stays_where_it_follows_within_noise():
    found = estimate_model([virtual_log(4, 600, wind=0.0, spread=1e-12, current=(0.0, 0.0))])
    assert found.predictor.structure.name.startswith(("thesis", "linear"))
    assert not any("selected" in note for note in found.notes)


@pytest.mark.parametrize(
    ("method", "error", "own", "leaves"),
    [("oe", 0.006, 0.0058, True), ("oe", 0.006, 0.005, False), ("oe", 0.0052, 0.0058, False),
     # instruments leave their own log by the noise of their coefficients too
     ("iv", 0.0052, 0.005, True), ("iv", 0.005, 0.0058, False)],
)  # fmt: skip
def test_a_channel_that_moves_little_counts_by_its_error_beyond_noise(method, error, own, leaves):
    sway = SimpleNamespace(rmse=error, own=own, noise=0.0049, spread=0.0144, moves=False)
    judged = SimpleNamespace(because=(), channels=(sway,))
    assert _leaves_more(SimpleNamespace(method=method, prediction=judged)) is leaves
    judged.because = (SomeHeldDiverge({"n": 10.0}, 60.0, 1, 16),)
    assert _leaves_more(SimpleNamespace(method=method, prediction=judged))


def test_logs_are_taken_at_the_pace_of_the_ship():
    vessel = vessel_from_dict(
        {"name": "boat", "length": 10.0, "thruster": [{"type": "fixed", "speed": "n"}]}
    )
    count = 2000
    channels = dict.fromkeys(("v", "r", "psi"), np.zeros(count))
    channels |= {"u": np.full(count, 2.0), "n": np.ones(count)}
    notes: list[str] = []
    (slower,) = at_own_pace([make_log(vessel, channels, 0.1)], notes)
    assert slower.sample_time == pytest.approx(0.2)  # at most a twentieth of 10 m over 2 m/s
    assert "0.2 s instead of 0.1 s" in notes[0]
    notes.clear()
    # thrusters that push a ship about on her place do not wait for her
    (still,) = at_own_pace([make_log(vessel, channels | {"u": channels["u"] / 40}, 0.1)], notes)
    assert still.sample_time == pytest.approx(0.4)
    assert "that keeps 500 samples" in notes[0]
    notes.clear()
    same = [make_log(vessel, channels, 0.2)]
    assert at_own_pace(same, notes) is same
    assert not notes


@pytest.fixture(scope="module")
def catamaran(tmp_path_factory):
    """Logs of a ship that shares no structure with the package: those to estimate on, and one."""
    folder = tmp_path_factory.mktemp("catamaran")
    kinds = ["random", "zigzag-20", "everyday", "turn-port"]
    file, paths = write_campaign(folder, "survey-catamaran-2m", kinds, seed=5, every=5)
    vessel = load_vessel(file)
    return [read_logs([str(p)], vessel)[0] for p in paths]


@pytest.mark.long
def test_thrust_that_goes_with_the_square_of_the_speed_is_told(catamaran):
    logs = [log.window(0, 500, log.name) for part in catamaran[:3] for log in part]
    choice = select_terms(logs, "nothing", 0, Refit(lambda _: _still(logs[0])))
    assert choice.taken
    assert choice.logs[0].vessel.thrusters[0].thrust != ThrustLaw()
    assert "thrust ~ n|n|" in choice.note
    assert all(choice.again(fitting) is not None for fitting, _ in parts_of(choice.logs))
    assert sum(row["chosen"] for row in choice.rows) == 1


@pytest.mark.long
def test_a_path_that_ends_in_a_local_minimum_decides_nothing(catamaran, monkeypatch):
    logs = [log.window(0, 500, log.name) for part in catamaran[:2] for log in part]
    (few, most), _ = first_terms(force_inputs(logs[0].vessel))

    class Lost(FreeRunSelection):
        def __init__(self, logs, *rest):
            super().__init__(logs, *rest)
            self.law = logs[0].vessel.thrusters[0].thrust

        def path(self, first, *rest, **more):
            sets = super().path(first, *rest, **more)
            lost = first == few and self.law.kind == "quadratic"
            return [replace(s, cost=9 * s.cost) for s in sets] if lost else sets

    monkeypatch.setattr(term_selection, "FreeRunSelection", Lost)
    choice = select_terms(logs, "nothing", 0, Refit(lambda _: _still(logs[0])))
    errors = {law.kind: error for law, error in choice.laws if not law.quadratic_share}
    assert errors["quadratic"] < errors["linear"]
    assert choice.logs[0].vessel.thrusters[0].thrust.kind == "quadratic"
    sizes = [row["coefficients"] for row in choice.rows if row["coefficients"] >= len(most)]
    assert len(sizes) == len(set(sizes)) > 3


@pytest.mark.long
def test_commands_that_move_between_samples_are_told_and_kept(modulus_log, tmp_path):
    """A ship whose commands follow a line and which sails by Runge and Kutta's rule."""
    vessel, structure = modulus_log.vessel, get_structure("linear")
    values = {"Xu": -0.1, "Xvr": 0.3, "Xmu": 5e-3, "Yv": -0.3, "Yur": -0.2, "Ymu": 5e-3,
              "Nr": -0.3, "Nuv": -5e-4, "Nmu": 3e-4}  # fmt: skip
    rng = np.random.default_rng(4)
    knots = np.arange(0, 401, 8)
    n, a, b = (np.interp(np.arange(400), knots, rng.uniform(-1, 1, len(knots))) for _ in range(3))
    commands = {"n": 15 + 5 * n, "alpha1": a, "alpha2": 0.8 * b}
    moving = replace(vessel, actuation=Actuation(between="interpolated"))
    tau = make_log(moving, commands, 1.0).forces(structure.inputs)
    theta = np.array([values[name] for name in structure.parameters])
    run = simulate(structure, theta, np.array([0.8, 0.0, 0.0]), tau[:-1], 1.0, integrator="rk4")
    x = run.x[0] + rng.standard_normal((400, 3)) * [2e-3, 1e-3, 1e-4]
    channels = commands | dict(zip("uvr", x.T, strict=True)) | {"psi": run.psi[0]}
    log = make_log(vessel, channels, 1.0, "moving")
    choice = select_terms([log], "nothing", 0, Refit(lambda _: _still(log)))
    assert choice.logs[0].vessel.actuation.between == "interpolated"
    assert choice.terms.integrator == "rk4"
    assert [(s.integrator, s.commands) for s, *_ in choice.steps] == [
        ("euler", "held"), ("euler", "interpolated"), ("rk4", "held"), ("rk4", "interpolated")
    ]  # fmt: skip
    named = {"method": "oe", "structure": "linear", "predictor": "basic"}
    options = OutputErrorOptions(integrator="rk4")
    found = estimate_model([replace(log, vessel=moving)], output_error=options, **named)
    found.model().save(tmp_path / "model.json")
    model = load_model(tmp_path / "model.json")
    assert (model.integrator, model.vessel.actuation.between) == ("rk4", "interpolated")
    assert np.abs((model.theta - theta) / model.std).max() < 4
    plain = estimate_model([log], **named)
    off = [abs(m["Nr"] - values["Nr"]) for m in (found, plain)]
    assert off[1] > 4 * off[0]


def _still(log):
    from greybox.model.model import ManoeuvringModel

    structure = structure_for("linear", force_inputs(log.vessel))
    count = len(structure.parameters)
    none = np.zeros((count, count))
    return ManoeuvringModel(structure, none[0], none, log.sample_time, log.vessel)


@pytest.mark.long
def test_the_default_predicts_a_foreign_ship_better_than_a_published_structure(catamaran):
    training = [log for part in catamaran[:3] for log in part]
    held = catamaran[3]
    published = estimate_model(training, method="oe", structure="modulus", judged=False).model()
    chosen = estimate_model(training)
    model = chosen.model()

    def fit(model):
        runs = [run_model(model, replace(log, vessel=model.vessel)) for log in held]
        return np.mean([max(v, -100) for v in average_fit(runs).values()])

    assert fit(model) > fit(published)
    assert "terms were selected" in " ".join(chosen.notes)
    assert presets()["survey-catamaran-2m"].ship.length == model.vessel.length


def test_a_set_that_rests_in_a_channel_that_others_follow_is_not_chosen() -> None:
    class Runs:
        def errors(self, p: np.ndarray) -> list[np.ndarray]:
            return [np.tile(p, (50, 1))]

    def sets(*errors: tuple[float, float]) -> list[Selected]:
        return [
            Selected(tuple("abcdef"[: k + 1]), np.array(e), 1 / (k + 1))
            for k, e in enumerate(errors)
        ]

    # in deviations of 2 and 0.1: the first set moves in one channel only, the second in both
    spread = np.array([2.0, 0.1])
    whole = [sets((0.4, 0.1), (0.5, 0.02)), sets((0.6, 0.11))]
    every = [(0, 1), (0, 2), (1, 1)]
    assert _moving(Runs(), whole, every, spread) == [(0, 2)]
    # what none of them follows, or hardly, excludes none
    whole = [sets((0.4, 0.1), (0.5, 0.09)), sets((0.6, 0.11))]
    assert _moving(Runs(), whole, every, spread) == every


def test_a_set_that_runs_away_where_commands_are_held_is_not_chosen(modulus_log) -> None:
    logs, family = [modulus_log], get_structure("linear")
    names = FreeRunSelection(logs, family, "basic").names
    values = {"Xu": -0.02, "Xmu": 1e-3, "Yv": -0.1, "Ymu": 1e-3, "Nr": -0.1, "Nmu": 1e-4}
    calm, driven = (
        Selected(tuple(names), np.array([(values | {"Nr": nr}).get(n, 0.0) for n in names]), 0.1)
        for nr in (-0.1, 0.2)
    )
    scores = [np.full(4, s) for s in (-50.0, -20.0, -10.0)]
    of = (logs, family, "basic")
    assert _staying(2, scores, [0, 8, 9], [calm, driven], of) == (1, 1)
    assert _staying(2, scores, [0, 8, 9], [driven, calm], of) == (2, 0)
    # where none stays, or only the present model is better, the choice stands
    assert _staying(2, scores, [0, 8, 9], [driven, driven], of) == (2, 0)
    assert _staying(2, [scores[1], scores[0], scores[2]], [0, 8, 9], [calm, driven], of) == (2, 0)
    assert _staying(0, scores, [0, 8, 9], [calm, driven], of) == (0, 0)
