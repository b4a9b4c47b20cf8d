"""Symptoms: where, when and under which conditions a simulation errs, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS
from greybox.diagnosis.evidence.held_out import long_run_variance
from greybox.diagnosis.fitting import Problem
from greybox.diagnosis.noise import SEEN
from greybox.diagnosis.point import Fit
from greybox.diagnosis.result import Symptom
from greybox.diagnosis.ship import LogRun
from greybox.diagnosis.waves import Waves, noise_in

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# mean errors in fewer samples than this share of the logs are no condition
_SHARE = 0.08
# noise deviations, and standard errors, from which on a mean error is told
_LARGE, _CLEAR = 0.5, 4.0
_MOST, _PER_CHANNEL = 7, 2
_WORDS = {"u": "surge", "v": "sway", "r": "the yaw rate", "psi": "the heading"}
_QUARTERS = (("north", 0.0), ("east", 90.0), ("south", 180.0), ("west", 270.0))


def word(name: str) -> str:
    """Return a channel in words."""
    return _WORDS.get(name, name)


def find_symptoms(problem: Problem, fit: Fit, waves: Waves | None = None) -> list[Symptom]:
    """Return what the free run gets wrong beyond noise, the largest first.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        Of the model before any cause.
    waves : Waves, optional
        In its errors.
    """
    outputs = problem.runs[0].outputs
    sensor = {
        outputs[i]: float(s)
        for g in noise_in(waves, fit).groups for i, s in zip(g.outputs, g.sensor, strict=True)
    }  # fmt: skip
    errors, measured = np.concatenate(fit.errors), np.concatenate(problem.known)
    conditions = _joined(problem, fit)
    out: list[Symptom] = []
    for i, name in enumerate(problem.structure.states):
        known = measured[:, i]
        if not known.any():
            continue
        e, unit = errors[known, i], CHANNELS[name].unit if name in CHANNELS else ""
        rms = float(np.sqrt((e**2).mean()))
        ratio = rms / max(sensor[name], 1e-300)
        if ratio > 1.15:
            out.append(
                Symptom(
                    f"the free run misses {word(name)} by {rms:.2g} {unit} (root mean square), "
                    f"{ratio:.1f} times what its sensor's noise explains",
                    name, ratio,
                )
            )  # fmt: skip
        found: list[tuple[float, str]] = []
        for text, mask in conditions:
            here = e[mask[known]]
            if len(here) < max(_SHARE * len(e), 20) or len(here) > (1 - _SHARE) * len(e):
                continue
            mean = float(here.mean())
            spread = float(np.sqrt(long_run_variance(here - mean) / len(here)))
            level = abs(mean) / max(sensor[name], 1e-300)
            if level > _LARGE and abs(mean) > _CLEAR * spread:
                way = "under" if mean > 0 else "over"
                found.append(
                    (level, f"{word(name)} is {way}-predicted by {abs(mean):.2g} {unit} {text}")
                )
        found.sort(reverse=True)
        out += [Symptom(text, name, level) for level, text in found[:_PER_CHANNEL]]
    out.sort(key=lambda s: -s.size)
    return out[:_MOST]


def _joined(problem: Problem, fit: Fit) -> list[tuple[str, Mask]]:
    """Return conditions with the samples of all logs that meet them."""
    parts: dict[str, list[Mask]] = {}
    for run, start in zip(problem.runs, fit.point.starts, strict=True):
        x = run.run(fit.point.ship, start).x
        for text, mask in _conditions(run, x):
            parts.setdefault(text, []).append(mask)
    whole = len(problem.runs)
    return [(text, np.concatenate(m)) for text, m in parts.items() if len(m) == whole]


def _conditions(run: LogRun, x: Array) -> Iterator[tuple[str, Mask]]:
    states = dict(zip(run.states, x.T, strict=True))
    log = run.log
    if "psi" in log:
        course = np.rad2deg(log["psi"]) % 360
        for text, centre in _QUARTERS:
            off = np.abs((course - centre + 180) % 360 - 180)
            yield f"when heading {text}", off < 45
    if "u" in states:
        u = states["u"]
        yield "when going ahead", u > 0
        yield "when going astern", u < 0
        fast = np.abs(u) > np.quantile(np.abs(u), 0.75)
        yield "in the fastest quarter of the log", fast
        yield "in the slowest quarter of the log", np.abs(u) < np.quantile(np.abs(u), 0.25)
    if "v" in states:
        size = np.quantile(np.abs(states["v"]), 0.5)
        yield "when drifting to starboard", states["v"] > size
        yield "when drifting to port", states["v"] < -size
    if "r" in states:
        size = np.quantile(np.abs(states["r"]), 0.5)
        yield "when turning to starboard", states["r"] > size
        yield "when turning to port", states["r"] < -size
    half = run.time > run.duration / 2
    yield "in the second half of the log", half
    yield "in the first half of the log", ~half
    for name in log.vessel.commands:
        value = log[name]
        if np.ptp(value) > 0:
            yield f"while {name} is in its highest quarter", value > np.quantile(value, 0.75)
            yield f"while {name} is in its lowest quarter", value < np.quantile(value, 0.25)


def moved_beside(fit: Fit, outputs: Sequence[str]) -> str:
    """Return what is moved by more than the model, in words; nothing where little is."""
    found = []
    for group in fit.noise.groups:
        if group.share > SEEN:
            memory = group.remembered
            tail = f" with a memory of {memory:.0f} samples" if memory > 2 else ""
            found.append(f"{word(outputs[group.outputs[0]])}{tail}")
    return " and ".join(found)
