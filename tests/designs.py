"""Requests and plans that tests of the design and of its page share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiment_design.constraints.limits import LimitReport, TrialLimits
from experiment_design.optimise.campaign import covariance_of
from experiment_design.optimise.classical import Alternative
from experiment_design.output.result import Design
from experiment_design.prepare import prepare_request
from experiment_design.request.request import DesignRequest, PreparedRequest, build_problem
from greybox.model.catalogue import get_structure
from greybox.model.model import ManoeuvringModel
from greybox.model.noise import NoiseLevels
from greybox.study.chapter6 import TRUE
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Limits


@contextmanager
def hasty_search() -> Iterator[None]:
    """Search with few evaluations: what is aimed at is tested, not how near a search comes."""
    from experiment_design import design
    from experiment_design.certificate import certificate, trajectory_bound
    from experiment_design.feasibility import constraint_satisfaction
    from experiment_design.optimise import campaign, envelope_search, search

    few = {
        search: {"_DRAWS": 400, "_OUTER": 3, "_ITERATIONS": 5, "_LIMITED_ITERATIONS": 5},
        campaign: {
            "_EVALUATIONS": 1000, "_CHAINS": 1, "_ROUNDS": 1, "_LIMITED": 1, "_LEAST": 20,
            "REFERENCE": 20,
        },
        constraint_satisfaction: {"_TIGHTENINGS": 1},
        certificate: {"_DRAWS": 20, "_KEPT": 3, "_BUDGET": 20, "_LEAST": 10, "_ASCENT": 10},
        trajectory_bound: {
            "_POINTS": (5, 6), "_FORCES": (5, 6), "_STEPS": (2, 1), "_RANGES": 2, "_FINER": 1,
        },
        envelope_search: {"RANDOM": 40, "_CHAINS": 1, "_ROUNDS": 6},
        design: {"_POLISH": 2},
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for module, numbers in few.items():
            for name, number in numbers.items():
                patch.setattr(module, name, number)
        yield


REGIME = (("u", 1), ("v", 1))
PROCESS = np.array([2e-3, 2e-3, 4e-4])


def limited_ship(speed=None, angle=None, angles=(0.6, 1.1)):
    """The thesis's ship, with rates."""
    ship = load_vessel("thesis")
    thrusters = tuple(
        replace(t, speed_limits=Limits(10.0, 20.0, speed), angle_limits=Limits(*angles, angle))
        for t in ship.thrusters
    )
    return replace(ship, thrusters=thrusters)


def ship_file(least=0.6, *more):
    """The vessel file of that ship without rates, with further lines of its sensors."""
    thrusters = "".join(
        f'[[thruster]]\ntype = "azimuth"\nx = {x}\ny = 0.0\nspeed = "n"\nangle = "{a}"\n'
        f"speed_limits = [10.0, 20.0]\nangle_limits = [{least}, 1.1]\n"
        for x, a in ((9.0, "alpha1"), (-9.0, "alpha2"))
    )
    sensors = "\n".join(("u_std = 0.0141", "v_std = 0.0141", "r_std = 0.0141", *more))
    return f'name = "Thesis ship"\nlength = 30.0\n{thrusters}[sensors]\n{sensors}\n'


def make_request(structure="thesis", duration=120.0, **changes) -> PreparedRequest:
    """A request for the thesis's ship within narrower limits, with changes."""
    s = get_structure(structure)
    n = len(s.states)
    start = np.array([1.5, 1.2, 0.0, 0.0]) if n == 3 else np.array([1.5, 0.0])
    signs = tuple(p for p in REGIME if p[0] in s.states)
    request = PreparedRequest(
        vessel=limited_ship(),
        structure=s,
        theta=np.array([TRUE[t] for t in s.parameters]),
        sample_time=1.0,
        noise=NoiseLevels(s.states, np.full(n, np.sqrt(2e-4)), PROCESS[:n]),
        duration=duration,
        hold=10.0,
        regimes=(signs,),
        starts=(start,),
        limits=TrialLimits(margins={"u": 0.5, "v": 0.4}),
        predictor="basic",
    )
    return replace(request, **changes)


def thesis_model(structure="thesis", spread=0.0) -> ManoeuvringModel:
    """The true model, each parameter uncertain by a share of itself."""
    s = get_structure(structure)
    theta = np.array([TRUE[t] for t in s.parameters])
    return ManoeuvringModel(s, theta, np.diag((spread * theta) ** 2), 1.0, limited_ship())


def prior_model(ship, thesis, theta, uncertain):
    spread = np.diag((0.01 * np.abs(theta)) ** 2) * uncertain
    return ManoeuvringModel(thesis, theta, spread, 1.0, ship)


def random_plan(model, ship, *, duration=600.0, uncertain=False, trials=1, limits=None, **asked):
    """A design of random levels: what is drawn does not ask how they were found."""
    options = {"regime": "u+v+", "start": [1.5, 1.2, 0, 0]}
    limits = replace(limits or TrialLimits(), margins={"u": 0.5, "v": 0.4})
    asked = DesignRequest(
        duration, limits, hold=10.0, trials=trials, predictor="basic", **(options | asked),
    )  # fmt: skip
    request = prepare_request(model, asked, ship)
    problems = [build_problem(request, t) for t in range(trials)]
    rng = np.random.default_rng(0)
    units = [rng.random(p.shape).round(2) for p in problems]
    levels = tuple(p.levels(u) for p, u in zip(problems, units, strict=True))
    commands = tuple(p.schedule.expand(v) for p, v in zip(problems, levels, strict=True))
    motions = tuple(
        p.scenarios[0].rollout.run(c[None]) for p, c in zip(problems, commands, strict=True)
    )
    criterion = problems[0].criterion

    names = tuple(request.build_predictor().columns[i].name for i in criterion.wanted)
    covariance = covariance_of(problems, units)
    return Design(
        request=request, commands=commands, levels=levels, motions=motions, names=names,
        values=np.array([request.theta[request.structure.index(n)] for n in names]),
        covariance=covariance, criterion_value=1.0,
        efficiency_vs_random=1.25, random_value=0.8, random_kept=200,
        random_std=1.2 * np.sqrt(np.diag(covariance)),
        certificate=SimpleNamespace(
            sentence=lambda: "at least 0.7 of the best possible", efficiency_lower_bound=0.7,
            to_dict=dict,
        ),
        margins={"u": 0.9, "v": 0.5},
        limits=(LimitReport(0, "margin of surge", 0.5, "m/s", 0.0),),
        keeping=None,
        alternatives=(
            Alternative("PRBS", 7, 7, 0.5, units[0]), Alternative("zig-zag", 8, 0, 0.1, units[0]),
            Alternative("pulses", 8, 8, -np.inf, units[0]),
        ),
        status="solved", notes=("a note",), evaluations=1, seconds=1.0,
    )  # fmt: skip
