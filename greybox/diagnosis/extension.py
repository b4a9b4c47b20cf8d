"""Turn a fitted hypothesis into an ordinary model that contains the causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.point import Fit
from greybox.diagnosis.quantities import numbers_by_true_north
from greybox.diagnosis.ship import CURRENTS, Sensors, Ship, Wire, derived_motions
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.model.run.changes import Change
from greybox.model.structure import Structure
from greybox.trial.log import TrialLog
from greybox.trial.validity import pooled_conditions
from greybox.vessel.vessel import Thruster, Vessel

Array = NDArray[np.float64]

# what of an actuation may name a column
_ON = ("lag_on", "delay_on", "rate_on")
# where wind is not among the terms, these coefficients stand for sums
_SUMS = {"Xuu": ("Xuu", "Wuu"), "Yvv": ("Yvv", "Wvv"), "Nuv": ("Nuv", "Wuv")}


def extended_structure(structure: Structure, problem: Problem, fit: Fit) -> Structure:
    """Return the structure with the terms that the hypothesis added."""
    p = len(problem.structure.parameters)
    names = [problem.names[i] for i in fit.point.places if i < p]
    added = [n for n in names if n not in structure.parameters]
    if not added:
        return structure
    named = replace(structure, name=structure.name + "".join(f"+{n}" for n in added))
    return named.with_terms(*added)


def extended_model(
    structure: Structure,
    problem: Problem,
    fit: Fit,
    logs: Sequence[TrialLog],
    record: Mapping[str, Any],
    known_current: Mapping[str, tuple[float, float]],
    misfit: Array | float = 0.0,
) -> ManoeuvringModel:
    """Return the hypothesis as a model that every command takes.

    Parameters
    ----------
    structure : Structure
        Of the model that was diagnosed.
    problem : Problem
        That the fit belongs to.
    fit : Fit
    logs : sequence of TrialLog
        That it was fitted to.
    record : mapping
        What the model file tells beside.
    known_current : mapping of str to (float, float)
        Current of the model that was diagnosed, where it has one.
    misfit : ndarray or float
        (q, q) covariance of the free numbers by what the model lacks.
    """
    wide = extended_structure(structure, problem, fit)
    ship = fit.point.ship
    numbers, covariance = numbers_by_true_north(problem, fit)
    covariance = covariance + misfit
    where = {problem.names[i]: k for k, i in enumerate(fit.point.places)}
    theta = np.array([ship.theta[problem.place(n)] for n in wide.parameters])
    index = [where.get(n) for n in wide.parameters]
    full = np.zeros((len(index), len(index)))
    for i, a in enumerate(index):
        for j, b in enumerate(index):
            if a is not None and b is not None:
                full[i, j] = covariance[a, b]
    disturbances = dict(known_current)
    for name in CURRENTS:
        if name in where:
            i = where[name]
            disturbances[name] = (float(numbers[i]), float(np.sqrt(covariance[i, i])))
    names = problem.structure.parameters
    means = [where[n] for n in disturbances] if set(disturbances) <= set(where) else []
    beside = np.array([np.zeros(len(covariance)) if i is None else covariance[i] for i in index])
    shared = np.vstack([beside, covariance[means]])[:, means]
    # levels of noise are those of the errors' colour, whatever the fit was weighed by
    white = problem.forgetful(fit, np.inf)
    summed = {
        name: parts for name, parts in _SUMS.items()
        if name in wide.parameters and parts[1] not in wide.parameters
    }  # fmt: skip
    return ManoeuvringModel(
        structure=wide,
        theta=theta,
        covariance=full,
        sample_time=problem.sample_time,
        vessel=extended_vessel(ship.vessel, ship.sensors, ship.wires, logs[0]),
        integrator=fit.integrator,
        disturbances=disturbances,
        disturbance_covariance=shared if means else np.zeros((0, 0)),
        residual_std=one_step_deviations(problem, white),
        noise=noise_levels(problem, white),
        sums=summed,
        changes=_changes(ship, names),
        conditions=pooled_conditions(logs).values,
        record=dict(record),
    )


def _changes(ship: Ship, names: Sequence[str]) -> tuple[Change, ...]:
    """Return a ship's changes as a model has them, each by how much of the first value."""
    factors: dict[int, float] = {}
    out = []
    for change in sorted(ship.changes, key=lambda c: c.time):
        factors[change.index] = factors.get(change.index, 1.0) * change.factor
        out.append(Change(names[change.index], factors[change.index], change.time))
    return tuple(out)


def extended_vessel(
    vessel: Vessel, sensors: Sensors, wires: Sequence[Wire], log: TrialLog
) -> Vessel:
    """Return the vessel with what was found of its sensors and of its columns."""
    said = dict(vessel.sensors)
    if sensors.turned:
        said["heading_bias"] = said.get("heading_bias", 0.0) + sensors.turned
        said["velocities_from_heading"] = True
    if any(sensors.lever):
        # velocities that follow from positions are those of the antenna
        key = "antenna" if "u" in derived_motions(log) else "velocity_at"
        before = tuple(said.get(key, (0.0, 0.0)))
        said[key] = (before[0] + sensors.lever[0], before[1] + sensors.lever[1], *before[2:])
    if sensors.late:
        clock = dict(said.get("clock", {}))
        for name, seconds in sensors.late:
            clock[name] = clock.get(name, 0.0) + seconds
        said["clock"] = clock
    turned = [*sensors.reversed, *(a for a, b, sign in wires if a == b and sign < 0)]
    if turned:
        said["reversed"] = tuple(dict.fromkeys([*said.get("reversed", ()), *turned]))
    swaps = {a: b for a, b, _ in wires if a != b}
    # a command goes with its feedback, where the same one of both drives all thrusters
    alike = len({t.drive for t in vessel.thrusters}) == 1
    others = {c: other for t in vessel.thrusters for _, c, other, _ in t.movements}
    thrusters = tuple(
        _rewired(t, swaps, others if alike else None) if swaps else t for t in vessel.thrusters
    )
    late = vessel.actuation
    on = {k: swaps.get(v, v) for k in _ON if (v := getattr(late, k)) is not None}
    return replace(vessel, sensors=said, thrusters=thrusters, actuation=replace(late, **on))


def _rewired(
    thruster: Thruster, swaps: Mapping[str, str], others: Mapping[str, str | None] | None
) -> Thruster:
    """Return a thruster with columns exchanged; `others` is None where no pair is known then."""
    changed: dict[str, Any] = {} if others is not None else {"drive": "feedback"}
    for kind, column, _, _ in thruster.movements:
        now = swaps.get(column, column)
        changed |= {kind: now, f"{kind}_other": None if others is None else others[now]}
    return replace(thruster, **changed)


def one_step_deviations(problem: Problem, fit: Fit) -> Array:
    """Return the deviation of the innovations of each state, (nx,)."""
    nx = len(problem.structure.states)
    out = np.zeros(nx)
    for group in fit.noise.groups:
        spread = np.sqrt(np.diag(group.root @ group.root.T))
        for i, s in zip(group.outputs, spread, strict=True):
            if i < nx:
                out[i] = s
    return out


def noise_levels(problem: Problem, fit: Fit) -> NoiseLevels:
    """Return the colours in the terms of a model file."""
    states = problem.structure.states
    outputs = problem.runs[0].outputs
    sensor = dict.fromkeys(outputs, 0.0)
    force, memory = dict.fromkeys(states, 0.0), dict.fromkeys(states, 0.0)
    for group in fit.noise.groups:
        for i, s in zip(group.outputs, group.sensor, strict=True):
            sensor[outputs[i]] = float(s)
        first = outputs[group.outputs[0]]
        force[first], memory[first] = group.force, group.memory
    return NoiseLevels(
        states,
        np.array([sensor[s] for s in states]),
        np.array([force[s] for s in states]),
        sensor.get("psi", 0.0),
        0.0,
        "likelihood of the whitened free-run errors",
        np.array([memory[s] for s in states]),
    )
