"""Parameters of an exported model, and the coefficients that they are at a sample."""

from __future__ import annotations

import casadi as ca

from greybox.export.ports import Port, distinct_ports
from greybox.model.disturbances import CURRENT
from greybox.model.model import ManoeuvringModel
from greybox.model.run.actuators import column


def parameter_ports(model: ManoeuvringModel) -> tuple[Port, ...]:
    """Return coefficients, current, and what changes the coefficients, in this order."""
    ts = model.sample_time
    ports = [
        Port(name, unit, f"coefficient of {term}, per sample of {ts:g} s", float(value))
        for name, term, unit, value in zip(
            model.names, model.structure.terms, model.units, model.theta, strict=True
        )
    ]
    known = dict(zip(model.structure.disturbances, model.d, strict=True))
    for name in CURRENT:
        towards = name.removeprefix("current_")
        ports.append(Port(name, "m/s", f"current velocity towards {towards}", float(known[name])))
    for c in model.changes:
        ports += [
            Port(f"{c.parameter}_factor", "1", f"factor on {c.parameter}", c.factor),
            Port(f"{c.parameter}_time", "s", "when the factor begins, from the start", c.time),
        ]
    return distinct_ports(ports)


def current(model: ManoeuvringModel, p: ca.SX) -> list[ca.SX]:
    """Return the current north and east of the parameters `p`."""
    return ca.vertsplit(p)[len(model.names) :][: len(CURRENT)]


def coefficients(model: ManoeuvringModel, p: ca.SX, sample: ca.SX) -> ca.SX:
    """Return the coefficients as they are at a sample.

    Parameters
    ----------
    model : ManoeuvringModel
    p : SX
        In the order of `parameter_ports`.
    sample : SX
        Samples since the start.
    """
    theta = ca.vertsplit(p)[: len(model.names)]
    first = len(theta) + len(CURRENT)
    factors = [ca.SX(1)] * len(theta)
    order = sorted(range(len(model.changes)), key=lambda k: model.changes[k].time)
    for k in order:
        factor, time = p[first + 2 * k], p[first + 2 * k + 1]
        i = model.names.index(model.changes[k].parameter)
        # as a free run: a whole number of samples may be a rounding error more
        factors[i] = ca.if_else(sample >= time / model.sample_time - 1e-6, factor, factors[i])
    return column(t * f for t, f in zip(theta, factors, strict=True))
