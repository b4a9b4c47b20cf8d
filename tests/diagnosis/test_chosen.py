"""Terms that the data chose, and defects of sensors beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.diagnosis.chosen import _with_sensors
from greybox.diagnosis.hypothesis import Hypothesis, Parameter
from greybox.diagnosis.preparing import prepare
from greybox.study.blind import draw
from greybox.trial.log import TrialLog

BIAS, ARM = 0.06, (-0.9, 0.4)


def as_measured(log: TrialLog) -> TrialLog:
    """Return a log whose antenna is away from the origin and whose compass is biased."""
    u, v = log["u"] - log["r"] * ARM[1], log["v"] + log["r"] * ARM[0]
    turned = {
        "u": u * np.cos(BIAS) + v * np.sin(BIAS),
        "v": v * np.cos(BIAS) - u * np.sin(BIAS),
    }
    return replace(log, channels={**log.channels, **turned})


@pytest.mark.parametrize("defect", [True, False])
def test_defects_of_sensors_stand_beside_terms_that_imitate_them(defect: bool) -> None:
    trial = draw(np.random.default_rng([4, 2]), (), samples=500, positions=False)
    logs = [trial.estimation, trial.validation]
    one, two = (as_measured(log) for log in logs) if defect else logs
    ready = prepare([one], [two], None, "thesis", ["heading_bias", "lever_arm"])
    terms = ("Y_taux", "N_taux")
    imitating = Hypothesis(
        "asymmetry", "asymmetry", tuple(Parameter(n, "", 0.0) for n in terms), columns=terms
    )
    case = ready.case.wider(terms, "free run")
    base = case.carried(ready.base())
    problem = case.problem(base.integrator)
    fit = problem.settle(problem.fit(problem.add(base.point, imitating), base.noise))
    found, causes = _with_sensors(case, fit, [imitating], ready.hypotheses)
    if not defect:
        assert causes == [imitating]
        return
    assert {h.cause for h in causes} == {"asymmetry", "heading_bias", "lever_arm"}
    told = {h.cause: v for h, v in zip(found.point.hypotheses, found.point.values, strict=True)}
    assert np.abs(told["heading_bias"]) == pytest.approx([BIAS], abs=0.01)
    assert told["lever_arm"] == pytest.approx(ARM, abs=0.25)
