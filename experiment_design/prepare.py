"""Completion of a user's request: noise, margins, regimes and starts are chosen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from experiment_design.feasibility.checks import ROOM, tells_enough
from experiment_design.feasibility.stability import unstable_sentence
from experiment_design.information.estimators import ESTIMATORS
from experiment_design.optimise.campaign import random_campaign
from experiment_design.request.apparent_wind import clear_heading
from experiment_design.request.exclusions import (
    COVARIANCE,
    MEASURED_WIND,
    REGRESSORS,
    SURGE_SIGN,
    SWAY_SIGN,
    YAW_RATE,
    require_compatible,
)
from experiment_design.request.noise import noise_levels
from experiment_design.request.regimes import (
    Signs,
    Start,
    Steady,
    candidate_regimes,
    parse_regime,
    spell_regime,
    start_words,
    steady_motions,
    steady_start,
)
from experiment_design.request.request import (
    DesignRequest,
    OutOfReach,
    OutOfReachError,
    PreparedRequest,
    TrialOptions,
    build_problem,
    full_structure,
)
from greybox.errors import InfeasibleError, StructureError, UsageError, so_many
from greybox.model.model import ManoeuvringModel
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.semi_empirical import METHOD as SEMI_EMPIRICAL
from greybox.model.structure import Structure
from greybox.numerics.linalg import scaled_inverse
from greybox.vessel.actuation import with_actuators_of
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

# a disturbance bound of A10 where nothing is known of currents and wind [m/s]
_DISTURBANCE = 0.1
# between changes of command where nothing else is known [s]
_USUAL_HOLD = 10.0
# lengths that are sailed between changes of command in a trial for prediction
_HOLD = 0.75
# turbulence intensity of the wind over the sea, as a share of its mean
_GUSTINESS = 0.15


def prepare_request(
    model: ManoeuvringModel,
    asked: DesignRequest,
    vessel: Vessel | None = None,
    *,
    best_effort: bool = False,
) -> PreparedRequest:
    """Complete what a user asked for.

    Parameters
    ----------
    model : ManoeuvringModel
        The prior: parameters, their covariance, residuals, known current.
    asked : DesignRequest
    vessel : Vessel, optional
        With limits and sensors; by default the model's own.
    best_effort : bool
        Where no steady motion keeps the margins, those nearest to them take their place.

    Returns
    -------
    PreparedRequest
        With a sentence in ``notes`` for each choice that was made.

    Raises
    ------
    StructureError
        The model's structure has no surge speed.
    UsageError
        Options that exclude one another, or the model is of a ship with other commands.
    InfeasibleError
        No motion within the limits keeps the wanted signs.
    """
    try:
        return _prepared(model, asked, vessel)
    except OutOfReachError as error:
        told = error.told
        if not best_effort or told.instead is None:
            raise
        own = {
            n: m
            for n, m in told.instead.margins.items()
            if n in asked.limits.margins or m != told.asked.margins[n]
        }
        within = replace(asked, limits=replace(asked.limits, margins=own))
        # trials of several regimes may each need lower ones
        found = prepare_request(model, within, vessel, best_effort=True)
        return replace(found, out_of_reach=told)


def require_own_commands(model: ManoeuvringModel, vessel: Vessel) -> None:
    """Raise where a vessel has commands that the prior model's vessel does not have."""
    if lacking := [n for n in vessel.commands if n not in model.vessel.commands]:
        raise UsageError(
            f"the prior is of '{model.vessel.name}', which has no {', '.join(lacking)} as "
            f"'{vessel.name}' has: give a model of this ship, or the vessel file that the prior "
            f"was estimated with."
        )


def _prepared(
    model: ManoeuvringModel, asked: DesignRequest, vessel: Vessel | None
) -> PreparedRequest:
    if vessel is not None:
        require_own_commands(model, vessel)
    changes = (*model.changes, *(asked.prior.changes if asked.prior is not None else ()))
    notes: list[str] = [
        f"{c.sentence}, and the trial is designed for what it is from then on"
        for c in dict.fromkeys(changes)
    ]
    if model.record.get("method") == SEMI_EMPIRICAL:
        notes += model.record.get("notes", [])
    model = model.at_final_parameters()
    bumps = sum(t.local for t in model.structure.terms)
    if bumps:
        notes.append(
            f"the force without a name ({bumps} bumps) moves the ship in this plan as it is: the "
            f"trial is designed for the coefficients that have a name"
        )
    if vessel is not None and vessel != (acting := with_actuators_of(vessel, model.vessel)):
        vessel = acting
        notes.append(
            "thrust laws, gains, angle offsets, lag and delay are those that the model was "
            "estimated with, which the vessel file has otherwise"
        )
    vessel = model.vessel if vessel is None else vessel
    structure, theta = full_structure(model)
    if not structure.marine or "u" not in structure.states:
        raise StructureError(
            f"structure '{structure.name}' has no surge speed u, so no trial can be designed for "
            f"it: use a manoeuvring structure such as 'thesis' or 'surge'."
        )
    if asked.trials < 1:
        raise UsageError(f"--trials is {asked.trials}, it must be 1 or more.")
    noise = noise_levels(model, vessel, asked.process_noise)
    prefix = "" if noise.source.startswith("noise") else "noise: "
    notes.append(f"{prefix}{noise.source}")
    predictor = _predictor(model, structure, asked, notes)
    d, dt = expected_disturbances(model, asked), model.sample_time
    measuring = PREDICTORS[predictor].air_measured
    free_run = ESTIMATORS[asked.estimator].free_run
    automatic = asked.regime.strip().lower() == "auto"
    parts = candidate_regimes(structure.states)[:1]
    if not automatic:
        parts = [parse_regime(p, structure.states) for p in asked.regime.split(",")]
    signed = {s for signs in parts for s, _ in signs}
    unsigned = f"regime '{asked.regime}' has none for it"
    lacking = {
        YAW_RATE: "" if "r" in structure.states else f"structure '{structure.name}' has none",
        MEASURED_WIND: "" if measuring else f"predictor '{predictor}' does not measure it",
        REGRESSORS: f"estimator '{asked.estimator}' fits free runs" if free_run else "",
        COVARIANCE: "" if model.covariance.any() else "it has none",
        SURGE_SIGN: "" if "u" in signed else unsigned,
        SWAY_SIGN: "" if "v" in signed else unsigned,
    }
    require_compatible(asked.given, {n: said for n, said in lacking.items() if said})
    if measuring and not d[2:].any():
        raise UsageError(
            f"predictor '{predictor}' measures the wind, and in still air its terms are those of "
            f"the water: give the wind to expect, such as --wind 5,0 (north, east, m/s)."
        )
    gust = asked.gust
    if gust is None:
        gust = _GUSTINESS * float(np.hypot(*d[2:]))
        if measuring and not free_run:
            notes.append(
                f"the wind is taken to vary by {gust:.2g} m/s about its mean, without which its "
                f"terms could not be told from the water's (--gust to change)"
            )
    margins, chosen = _margins(model, structure, noise.measurement, asked)
    chosen = {state: note for state, note in chosen.items() if state in signed}
    notes += chosen.values()
    of_regime = [note for state, note in chosen.items() if state != "u"]
    if (np.diag(model.covariance) < 0).any():
        name = model.names[int(np.diag(model.covariance).argmin())]
        raise UsageError(
            f"the prior model gives {name} the variance {np.diag(model.covariance).min():.2g}, "
            f"which cannot be: estimate the model again."
        )
    covariance = np.zeros((theta.size, theta.size))
    size = model.covariance.shape[0]
    covariance[:size, :size] = model.covariance
    base = PreparedRequest(
        **{f.name: getattr(asked, f.name) for f in fields(TrialOptions)},
        vessel=vessel,
        structure=structure,
        theta=theta,
        sample_time=dt,
        integrator=model.integrator,
        untried=model.record.get("method") == SEMI_EMPIRICAL,
        noise=noise,
        hold=asked.hold or max(1, round(_USUAL_HOLD / dt)) * dt,
        regimes=((),),
        starts=(np.zeros(len(structure.states) + 1),),
        predictor=predictor,
        d=d,
        gust=gust,
        known=_known(asked.prior),
        covariance=covariance if covariance.any() else None,
    )
    base = replace(base, limits=replace(asked.limits, margins=margins))
    steady = steady_motions(base)
    if not len(steady.x):
        raise InfeasibleError(unstable_sentence(base))
    start = _start(asked, structure)
    if automatic:
        regimes = _choose_regimes(base, steady, start, asked, notes)
    else:
        if len(parts) not in (1, asked.trials):
            raise UsageError(
                f"--regime names {so_many(len(parts), 'regime')} for {asked.trials} "
                f"trial{'s' if asked.trials > 1 else ''}: give one, or one per trial."
            )
        regimes = tuple(parts * asked.trials if len(parts) == 1 else parts)
    caps = (asked.limits.speed_cap, asked.limits.yaw_cap)
    if start is None and not automatic:
        for signs in regimes:
            begin = steady_start(steady, structure.states, signs, margins, caps)
            if begin is not None and _depth(begin.state, signs, margins, structure.states) < -1e-6:
                raise OutOfReachError(_beyond_reach(base, steady, [signs]))
    begun = [
        _start_of(signs, start, steady, structure, margins, caps, asked.trials) for signs in regimes
    ]
    base = replace(
        base,
        regimes=regimes,
        starts=tuple(s.state if s.state is start else _clear_of_wind(s.state, base) for s in begun),
        start_commands=tuple(s.commands for s in begun),
    )
    for trial, begin in enumerate(begun):
        if begin.commands is None:
            continue
        which = f"trial {trial + 1}" if asked.trials > 1 else "the trial"
        of_regime.append(
            f"{which} starts from a steady motion: {start_words(base, trial)} (--start to change)"
        )
        notes.append(of_regime[-1])
    return replace(base, notes=tuple(notes), of_regime=tuple(of_regime))


def expected_disturbances(model: ManoeuvringModel, asked: DesignRequest) -> Array:
    """Return the means (nd,) of current and wind [m/s]: the model's, where none are asked for."""
    d = np.array(model.d, float)
    if asked.current is not None:
        d[:2] = asked.current
    if asked.wind is not None:
        d[2:] = asked.wind
    return d


def both_sides(asked: DesignRequest, model: ManoeuvringModel) -> DesignRequest:
    """Return the request of a trial for prediction: surge keeps its sign, the others do not.

    Parameters
    ----------
    asked : DesignRequest
        Where it has no hold, commands change after three quarters of a length at the speed of
        the prior's trial.
    model : ManoeuvringModel
        The prior, with the range of surge that its trial showed.
    """
    ranges = model.record.get("ranges")
    shown = ranges.get("u") if isinstance(ranges, Mapping) else None
    ahead = shown is None or float(shown[0]) >= 0
    dt, length = model.sample_time, model.vessel.length
    hold = asked.hold
    if hold is None:
        hold = _USUAL_HOLD
        if shown is not None and length:
            hold = _HOLD * length / max(abs(float(shown[0])), abs(float(shown[1])), 1e-3)
        hold = max(2, round(hold / dt)) * dt
    return replace(
        asked, hold=hold, regime="u+" if ahead else "", predictor=asked.predictor or "basic"
    )


def _predictor(
    model: ManoeuvringModel, structure: Structure, asked: DesignRequest, notes: list[str]
) -> str:
    if asked.predictor is not None:
        return PREDICTORS[asked.predictor].name
    if "r" not in structure.states:
        notes.append(
            "basic predictor: without a yaw rate the heading stays, and a current looks like the "
            "model's own terms"
        )
        return "basic"
    notes.append("augmented predictor: current and wind are captured, not measured")
    return "augmented"


def _margins(
    model: ManoeuvringModel,
    structure: Structure,
    measurement: Array,
    asked: DesignRequest,
) -> tuple[dict[str, float], dict[str, str]]:
    """Return the margins asked for, and a sentence on each that was not.

    Those are three noise deviations plus a disturbance bound (A10).
    """
    known = [e for _, e in model.disturbances.values()]
    bound = 2 * max(known) if known and max(known) > 0 else _DISTURBANCE
    margins, notes = {}, {}
    for i, state in enumerate(structure.states):
        value = asked.limits.margins.get(state)
        if value is None:
            if state not in ("u", "v"):
                continue
            value = 3.0 * float(measurement[i]) + bound
            notes[state] = (
                f"margin of {state}: {value:.3f} m/s, three standard deviations of its noise and "
                f"{bound:.3g} m/s for disturbances (A10)"
            )
        margins[state] = float(value)
    return margins, notes


def _known(model: ManoeuvringModel | None) -> tuple[tuple[str, ...], Array] | None:
    if model is None:
        return None
    model = model.at_final_parameters().estimable()
    if not (model.std > 0).all():
        name = model.names[int(np.argmin(model.std))]
        raise UsageError(
            f"the prior model gives {name} a standard error of 0, so nothing could be learnt of "
            f"it: use a model that was estimated."
        )
    return model.names, scaled_inverse(model.covariance)


def _start(asked: DesignRequest, structure: Structure) -> Array | None:
    if asked.start is None:
        return None
    given = np.asarray(asked.start, float)
    expected = len(structure.states) + 1
    if given.size == 4 and expected < 4:
        # u,v,r,psi for a model of fewer states
        names = ("u", "v", "r")
        given = np.array([given[names.index(s)] for s in structure.states] + [given[3]])
    if given.size != expected:
        raise UsageError(
            f"--start has {given.size} numbers, {expected} are needed: "
            f"{','.join(structure.states)},psi."
        )
    return given


def _start_of(
    signs: Signs,
    start: Array | None,
    steady: Steady,
    structure: Structure,
    margins: dict[str, float],
    caps: tuple[float | None, float | None],
    trials: int,
) -> Start:
    if start is not None and _agrees(start, signs, structure.states):
        return Start(start)
    if start is not None and trials == 1:
        name, sign = next((s, v) for s, v in signs if start[structure.states.index(s)] * v < 0)
        raise InfeasibleError(
            f"the trial starts with {name} = {start[structure.states.index(name)]:g} m/s and the "
            f"regime {spell_regime(signs)} asks for {'more' if sign > 0 else 'less'} than 0: "
            f"change --start or --regime."
        )
    found = steady_start(steady, structure.states, signs, margins, caps)
    if found is None:
        reached = [
            spell_regime(c)
            for c in candidate_regimes(structure.states)
            if steady_start(steady, structure.states, c, margins) is not None
        ]
        raise InfeasibleError(
            f"no constant command within the limits of the thrusters holds the regime "
            f"{spell_regime(signs)}: reached are {', '.join(reached) or 'none'}. Choose one of "
            f"them with --regime, or widen the limits."
        )
    return found


def _agrees(start: Array, signs: Signs, states: tuple[str, ...]) -> bool:
    """Whether a start has the signs of a regime."""
    return all(start[states.index(s)] * v >= 0 for s, v in signs)


def _depth(
    start: Array, signs: Signs, margins: Mapping[str, float], states: tuple[str, ...]
) -> float:
    """Return by how much a start keeps its margins at least [m/s]."""
    if not signs:
        return np.inf
    return min(abs(float(start[states.index(s)])) - margins.get(s, 0.0) for s, _ in signs)


def _clear_of_wind(start: Array, base: PreparedRequest) -> Array:
    """Return a chosen start, turned to where a margin through the air is kept best."""
    if base.limits.margin_air is None:
        return start
    velocity = [start[base.structure.states.index(s)] for s in base.limits.margins]
    return np.append(start[:-1], clear_heading(np.array(velocity), np.asarray(base.d[2:], float)))


def _beyond_reach(base: PreparedRequest, steady: Steady, candidates: list[Signs]) -> OutOfReach:
    """Return what margins steady motions reach, and which leave a trial room to tell enough."""
    states, signed = base.structure.states, dict(candidates[0])
    asked = {s: m for s, m in base.limits.margins.items() if s in signed}
    caps = (base.limits.speed_cap, base.limits.yaw_cap)
    shown = ", ".join(f"{k} {v:.3g}" for k, v in asked.items())
    # the motion that keeps the largest share of every margin
    share, reached, held = -np.inf, asked, candidates[0]
    for signs in candidates:
        kept = np.array([steady.x[:, states.index(s)] * v for s, v in signs]).T
        wanted = np.array([max(asked.get(s, 0.0), 1e-9) for s, _ in signs])
        least = np.minimum(kept / wanted, 1.0)
        order = least.min(axis=1) + 1e-3 * least.mean(axis=1)
        best = int(order.argmax())
        if order[best] > share:
            share, held = float(order[best]), signs
            reached = {s: float(kept[best, i]) for i, (s, _) in enumerate(signs)}
    best_shown = ", ".join(f"{k} {v:.3g}" for k, v in reached.items())
    said = (
        f"no steady motion keeps the margin{'s' if len(asked) > 1 else ''} {shown} m/s: the one "
        f"that comes closest within the limits of the thrusters keeps {best_shown} m/s."
    )
    for part in ROOM:
        margins = {s: min(v, np.floor(1e3 * part * reached[s]) / 1e3) for s, v in asked.items()}
        if min(margins.values()) < 0:
            break
        start = steady_start(steady, states, held, margins, caps)
        if start is None:
            continue
        eased = replace(
            base,
            regimes=(held,) * base.trials,
            starts=(_clear_of_wind(start.state, base),) * base.trials,
            limits=replace(base.limits, margins={**base.limits.margins, **margins}),
        )
        if tells_enough(eased):
            told = OutOfReach(base.limits, eased.limits, said)
            options = eased.eased(told).stand_ins
            return replace(told, sentence=f"{said} Use {options}, or widen the limits.")
    said += " Widen the limits of the thrusters, or lower the margins far below these."
    return OutOfReach(base.limits, None, said)


def _choose_regimes(
    base: PreparedRequest,
    steady: Steady,
    start: Array | None,
    asked: DesignRequest,
    notes: list[str],
) -> tuple[Signs, ...]:
    """Return the regimes that can be held and tell most, one per trial."""
    states = base.structure.states
    margins = dict(base.limits.margins)
    worth: list[tuple[float, Signs]] = []
    candidates = candidate_regimes(states)
    if start is not None and asked.trials == 1:
        candidates = [c for c in candidates if _agrees(start, c, states)]
    for signs in candidates:
        caps = (asked.limits.speed_cap, asked.limits.yaw_cap)
        begin = steady_start(steady, states, signs, margins, caps)
        if begin is None:
            continue
        own = _clear_of_wind(begin.state, base)
        if (
            start is not None
            and _agrees(start, signs, states)
            and (asked.trials > 1 or _depth(start, signs, margins, states) >= 0)
        ):
            # else a lead-in brings her to where the regime can be judged
            own = start
        if _depth(own, signs, margins, states) < -1e-6 and own is not start:
            continue
        try:
            request = replace(base, regimes=(signs,), starts=(own,))
            problem = build_problem(request)
        except StructureError as error:
            if asked.trials == 1:
                raise
            del error
            worth.append((0.0, signs))
            continue
        units, kept = random_campaign([problem], base.seed)
        value = -np.inf
        if units is not None and kept:
            value = float(problem.evaluate(np.array(units)).value[0])
        worth.append((value, signs))
    if not worth:
        raise OutOfReachError(_beyond_reach(base, steady, candidates))
    worth.sort(key=lambda item: -item[0])
    chosen = [signs for _, signs in worth]
    if asked.trials == 1:
        notes.append(
            f"regime {spell_regime(chosen[0])} chosen of "
            f"{', '.join(spell_regime(c) for c in chosen)}, where random sequences tell most"
        )
        return (chosen[0],)
    picked = tuple(chosen[i % len(chosen)] for i in range(asked.trials))
    shown = ", ".join(spell_regime(c) for c in picked)
    if len(chosen) > 1:
        notes.append(
            f"regimes {shown}: trials of different signs determine together what one alone "
            f"cannot (Remark 4.1)"
        )
    else:
        notes.append(f"regimes {shown}: no other one can be held within the thrusters' limits")
    return picked
