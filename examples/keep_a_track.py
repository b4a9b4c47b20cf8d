"""Keep a winding track in a current: predictive control with the identified model.

The model is estimated from a trial, its step is a CasADi function, and the controller
is one nonlinear program, built once and started warm. The true ship has other parameters
than the model, and its current wanders. Name a file to get a picture.
"""

import sys
import time
from dataclasses import replace

import casadi as ca
import numpy as np

import greybox as gb
from greybox.model.run.simulation import positions
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses

rng = np.random.default_rng(5)
structure = gb.get_structure("thesis")
true = np.array([TRUE[name] for name in structure.parameters])
limits = {
    "speed_limits": [-5.0, 20.0], "speed_rate": 2.0, "angle_limits": [-1.6, 1.6], "angle_rate": 0.1,
}  # fmt: skip
pods = [
    {"type": "azimuth", "x": x, "speed": f"n{k}", "angle": f"alpha{k}", **limits}
    for k, x in ((1, 9.0), (2, -9.0))
]
ship = gb.vessel_from_dict({"name": "Ferry", "length": 30.0, "thruster": pods})
bounds = [ship.limits[name] for name in ship.commands]
CURRENT, SPEED, HOLD, AHEAD, SECONDS = (0.25, -0.35), 1.5, 2, 25, 240


def sea(samples):
    """Draw a current that wanders about its mean, in still air."""
    mean = np.array([*CURRENT, 0.0, 0.0])
    std = np.array([0.03, 0.03, 0.0, 0.0])
    return gb.stationary_disturbance(rng, mean, std, samples, correlation_time=60.0)[0]


def trial(samples=800):
    """Sail the true ship on pulses, and measure it."""
    drawn = {
        c: smoothed_pulses(rng, samples, *((5, 20) if c[0] == "n" else (-1, 1)))
        for c in ship.commands
    }
    tau = gb.make_log(ship, drawn, 1.0).forces(structure.inputs)[:-1]
    run = gb.simulate(structure, true, np.array([1.0, 0.0, 0.0]), tau, 1.0, d=sea(samples - 1))
    measured = run.x[0] + 0.01 * rng.standard_normal((samples, 3))
    seen = dict(zip("uvr", measured.T, strict=True)) | {"psi": run.psi[0]}
    return gb.make_log(ship, drawn | seen, 1.0)


def track(t):
    """Return north, east [m] and direction [rad] of the track at time t."""
    north = SPEED * t
    return north, 25 * np.sin(north / 50), np.arctan(0.5 * np.cos(north / 50))


def controller(model):
    """Build the program ``(state, last command, track ahead, start) -> plan`` once."""
    step = model.step_function()
    x, c = ca.MX.sym("x", 6, AHEAD + 1), ca.MX.sym("c", 4, AHEAD)
    now, last, ahead = ca.MX.sym("now", 6), ca.MX.sym("last", 4), ca.MX.sym("ahead", 3, AHEAD + 1)
    cost, defects, moves = 0, [x[:, 0] - now], []
    for k in range(AHEAD):
        after = x[:, k]
        for _ in range(HOLD):
            after = step(x=after, command=c[:, k])["x_next"]
        defects.append(x[:, k + 1] - after)
        moves.append(c[:, k] - (c[:, k - 1] if k else last))
        away, direction = x[4:, k + 1] - ahead[:2, k + 1], ahead[2, k + 1]
        along = ca.cos(direction) * away[0] + ca.sin(direction) * away[1]
        across = ca.cos(direction) * away[1] - ca.sin(direction) * away[0]
        cost += across**2 + 0.1 * along**2 + 5 * (x[3, k + 1] - direction) ** 2
        cost += 0.01 * ca.sumsqr(moves[-1][[0, 2]]) + 2 * ca.sumsqr(moves[-1][[1, 3]])
    free = ca.vertcat(ca.vec(x), ca.vec(c))
    kept = ca.vertcat(*defects, *moves)
    problem = {"x": free, "f": cost, "g": kept, "p": ca.vertcat(now, last, ca.vec(ahead))}
    quiet = {"print_time": False, "expand": True, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}
    solver = ca.nlpsol("mpc", "ipopt", problem, quiet | warm)
    rates = np.tile([HOLD * b.rate for b in bounds], AHEAD)
    zeros, wide = np.zeros(6 * (AHEAD + 1)), np.full(6 * (AHEAD + 1), np.inf)
    box = {
        "lbx": np.concatenate([-wide, np.tile([b.lower for b in bounds], AHEAD)]),
        "ubx": np.concatenate([wide, np.tile([b.upper for b in bounds], AHEAD)]),
        "lbg": np.concatenate([zeros, -rates]), "ubg": np.concatenate([zeros, rates]),
    }  # fmt: skip
    return solver, box


def sail(model, d):
    """Sail the true ship under a controller; return its way and its distance to the track."""
    solver, box = controller(model)
    noise = np.random.default_rng(6)
    state, last = np.array([1.5, 0.0, 0.0, 0.4, 0.0, -5.0]), np.array([10.0, 0.0, 10.0, 0.0])
    guess = np.concatenate([np.tile(state, AHEAD + 1), np.tile(last, AHEAD)])
    plan, way, times = {"x": guess, "lam_x": 0 * guess, "lam_g": 0.0}, [state], []
    for k in range(0, SECONDS, HOLD):
        begun = time.perf_counter()
        ahead = np.array(track(k + HOLD * np.arange(AHEAD + 1.0)))
        seen = state + [0.01, 0.01, 0.002, 0.005, 0.1, 0.1] * noise.standard_normal(6)
        asked = np.concatenate([seen, last, ahead.T.ravel()])
        plan = solver(x0=plan["x"], lam_x0=plan["lam_x"], lam_g0=plan["lam_g"], p=asked, **box)
        if not solver.stats()["success"]:
            raise SystemExit(f"no plan at {k} s: {solver.stats()['return_status']}")
        last = np.array(plan["x"])[6 * (AHEAD + 1) :, 0][:4]
        times.append(time.perf_counter() - begun)
        held = dict(zip(ship.commands, np.tile(last[:, None], HOLD), strict=True))
        tau = gb.make_log(ship, held, 1.0).forces(structure.inputs)
        run = gb.simulate(
            structure, true, state[:3], tau, 1.0, psi0=state[3], d=d[k : k + HOLD]
        )  # fmt: skip
        place = positions(run.x[0], run.psi[0], 1.0, state[4:])
        way += list(np.column_stack([run.x[0], run.psi[0], place])[1:])
        state = way[-1]
    line = np.column_stack(track(np.arange(-20.0, SECONDS + 60, 0.2))[:2])
    away = np.array(way)[:, None, 4:] - line
    return np.array(way), np.hypot(away[..., 0], away[..., 1]).min(axis=1), np.median(times)


model = gb.estimate_model(trial(), method="oe", structure="thesis").model()
for (name, (value, std)), mean in zip(model.disturbances.items(), CURRENT, strict=True):
    print(f"{name}: {value:.3f} ± {1.96 * std:.3f} m/s, wanders about {mean} in truth")
d = sea(SECONDS)
ways = {}
for name, known in (("current known", model), ("unknown", replace(model, disturbances={}))):
    way, off, each = sail(known, d)
    ways[name] = way, off
    rms = np.sqrt(np.mean(off[60:] ** 2))
    print(f"{name:<14} cross-track {rms:.2f} m rms after a minute, {1000 * each:.0f} ms a plan")

if len(sys.argv) > 1:
    from matplotlib import pyplot as plt

    figure, (map_, error) = plt.subplots(2, figsize=(8, 5), layout="constrained")
    map_.plot(*track(np.arange(SECONDS))[:2], "k--", lw=0.8, label="track")
    for name, (way, off) in ways.items():
        map_.plot(way[:, 4], way[:, 5], label=name)
        error.plot(off, label=name)
    map_.set(xlabel="north [m]", ylabel="east [m]", aspect="equal")
    map_.invert_yaxis()
    error.set(xlabel="time [s]", ylabel="distance to the track [m]", ylim=(0, 2))
    error.legend()
    figure.savefig(sys.argv[1], dpi=120)
