"""Draws the pictures of the manual from virtual logs: python docs/pictures.py [FOLDER].

FOLDER holds the files of the tutorial, whose pictures are drawn there; without it the catalogues
are drawn.

The files in docs/images/causes and docs/images/checks are made by this script and kept
beside the text. A cause is shown on a log of a virtual ship that has it, beside the free
run of a model that is right in everything else.
"""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

import greybox as gb
from greybox.report.checks import finding_figure
from greybox.report.figures import new_figure, save_png, tidy
from greybox.study.blind import draw
from greybox.study.chapter6 import TRUE
from greybox.study.inputs import smoothed_pulses

FOLDER = Path(__file__).parent / "images"
GREY, RED, BLUE = "#555555", "#b2182b", "#2166ac"
UNITS = {"u": "m/s", "v": "m/s", "r": "rad/s"}
STRUCTURE = gb.get_structure("thesis")


def change(values):
    """Return how much a signal (N,) changed in the ten samples before."""
    return values - np.r_[np.full(10, values[0]), values[:-10]]


def push(log, along=np.cos):
    """Return the force of both thrusters along the bow, or across it."""
    return sum(log[f"n{i}"] * along(log[f"alpha{i}"]) for i in (1, 2))


# cause: seed of the trial, channel that errs, what the error follows, and how that is called
CAUSES = {
    "current": (1, "u", lambda g, run: np.degrees(g["psi"]) % 360, "heading [deg]"),
    "wind": (5, "v", lambda g, run: np.abs(g["v_q"]) * g["v_q"], "|v_q| v_q [m²/s²]"),
    "thruster_gain": (6, "u", lambda g, run: g["n2"] * np.cos(g["alpha2"]), "n2 cos(alpha2)"),
    "thruster_lag": (2, "u", lambda g, run: change(push(g)), "change of the force in 10 s"),
    "input_delay": (3, "u", lambda g, run: change(push(g)), "change of the force in 10 s"),
    "rate_limit": (1, "r", lambda g, run: change(g["alpha1"]), "change of alpha1 in 10 s [rad]"),
    "feedback_sampling": (
        6,
        "u",
        lambda g, run: np.gradient(push(g)),
        "change of the force in 1 s",
    ),
    "quadratic_thrust": (3, "u", lambda g, run: push(g), "force along the bow"),
    "advance_speed": (3, "v", lambda g, run: g["u"] * push(g, np.sin), "u times the side force"),
    "angle_offset": (1, "r", lambda g, run: g["n1"] * np.cos(g["alpha1"]), "n1 cos(alpha1)"),
    "cubic_damping": (1, "u", lambda g, run: g["u"], "surge [m/s]"),
    "quadratic_yaw_damping": (4, "r", lambda g, run: run[:, 2], "simulated yaw rate [rad/s]"),
    "crossflow": (5, "v", lambda g, run: np.abs(g["r"]) * g["v"], "|r| v [m rad/s²]"),
    "side_force": (2, "v", lambda g, run: np.degrees(g["psi"]) % 360, "heading [deg]"),
    "inertia_coupling": (1, "v", lambda g, run: g["r"], "yaw rate [rad/s]"),
    "asymmetry": (1, "v", lambda g, run: push(g), "force along the bow"),
    "heading_bias": (1, "v", lambda g, run: g["u"], "surge [m/s]"),
    "lever_arm": (6, "v", lambda g, run: g["r"], "yaw rate [rad/s]"),
    "clock_offset": (3, "u", lambda g, run: change(g["u"]) / 10, "mean rate of u in 10 s [m/s²]"),
    "sign": (6, "r", lambda g, run: g["r"], "yaw rate as logged [rad/s]"),
    "waves": (2, "v", None, "frequency [Hz]"),
    "parameter_change": (2, "v", lambda g, run: g.t, "time [s]"),
}


def afflicted(cause, seed):
    """Return a trial's log, the free run (N, 3) of the model without the cause, and its size."""
    options = {"kind": "manoeuvres", "samples": 900, "anemometer": cause == "wind"}
    trial = draw(np.random.default_rng(seed), (cause,), **options)
    theta = np.array([trial.ship[n] for n in STRUCTURE.parameters])
    model = gb.ManoeuvringModel(
        STRUCTURE, theta, np.zeros((theta.size,) * 2), 1.0, trial.vessel, integrator="rk4"
    )
    log = trial.estimation
    told = dict(trial.truth[0].parameters)
    still = {k: x for k, x in log.channels.items() if k not in ("u_q", "v_q")}
    return log, gb.run_model(model, replace(log, channels=still)).x, told


def cause_figure(cause):
    """Draw the part of the log that errs most, and what its error follows."""
    seed, channel, follows, label = CAUSES[cause]
    log, run, told = afflicted(cause, seed)
    simulated = run[:, "uvr".index(channel)]
    error = log[channel] - simulated
    figure = new_figure(7.2, 2.6)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    worst = int(np.argmax(np.convolve(error**2, np.ones(300), "valid")))
    part = slice(0, 900) if cause == "parameter_change" else slice(worst, worst + 300)
    left.plot(log.t[part], log[channel][part], ".", ms=2.5, color=GREY, label="logged")
    left.plot(log.t[part], simulated[part], color=RED, lw=1.2, label="model without the cause")
    left.set(xlabel="time [s]", ylabel=f"{channel} [{UNITS[channel]}]")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=8)
    if follows is None:
        frequency = np.fft.rfftfreq(len(error), 1.0)
        right.semilogy(
            frequency[5:], np.abs(np.fft.rfft(error))[5:] / len(error), color=BLUE, lw=0.8
        )
        right.set(xlabel=label, ylabel=f"spectrum of the error of {channel}")
    else:
        follow(right, follows(log, run), error)
        right.set(xlabel=label, ylabel=f"logged − model [{UNITS[channel]}]")
    for axes in (left, right):
        tidy(axes)
    said = ", ".join(f"{k} {v:.3g}" for k, v in told.items() if not isinstance(v, str))
    figure.suptitle(f"{cause}: {said}" if said else cause, fontsize=9)
    return figure


def follow(axes, x, error):
    """Draw an error (N,) against x (N,), with means of groups of equal number."""
    axes.plot(x, error, ".", ms=2, color="#bbbbbb")
    groups = np.array_split(np.argsort(x), 12)
    mean = np.array([error[g].mean() for g in groups])
    axes.plot([x[g].mean() for g in groups], mean, "o-", ms=3, color=BLUE)
    axes.axhline(0, color="black", lw=0.6)
    reach = 2 * np.abs(mean).max()
    axes.set_ylim(-reach, reach)


def defective(check, columns):
    """Return a log's columns (N,) each with one defect."""
    c = {k: v.copy() for k, v in columns.items()}
    if check == "gap":
        return {k: np.delete(v, np.r_[300:360]) for k, v in c.items()}
    if check == "duplicate_time":
        return {k: v[np.r_[0:400, 396 : len(v)]] for k, v in c.items()}
    if check == "nan":
        c["u"][200:240] = np.nan
    if check == "outlier":
        c["v"][[150, 420]] += [1.5, -2.0]
    if check == "stuck":
        c["psi"][300:360] = c["psi"][300]
    if check == "heading_wrap":
        c["psi"] = c["psi"] % (2 * np.pi)
        k = int(np.argmax(np.abs(np.diff(c["psi"]))))
        c["psi"][k] = 0.5 * (c["psi"][k - 1] + c["psi"][k + 1])
    if check == "position_hold":
        for k in (200, 201, 420, 610):
            c["x_n"][k], c["y_n"][k] = c["x_n"][k - 1], c["y_n"][k - 1]
    if check == "position_jump":
        c["x_n"][450:] += 8.0
        c["y_n"][450:] -= 5.0
    if check == "quantised":
        c["v"] = np.round(c["v"], 1)
    if check == "unit":
        c["u"], c["v"] = c["u"] * 3600 / 1852, c["v"] * 3600 / 1852
    if check == "frame":
        cos, sin = np.cos(c["psi"]), np.sin(c["psi"])
        c["u"], c["v"] = cos * c["u"] - sin * c["v"], sin * c["u"] + cos * c["v"]
    if check == "sign":
        c["r"] = -c["r"]
    if check == "clock_offset":
        for name in ("u", "v"):
            c[name] = np.r_[np.full(3, c[name][0]), c[name][:-3]]
    if check == "lever_arm":
        c["x_n"] = c["x_n"] + 6 * np.cos(c["psi"])
        c["y_n"] = c["y_n"] + 6 * np.sin(c["psi"])
    if check == "heading_bias":
        c["psi"] = c["psi"] + np.radians(6)
    if check == "actuator":
        # the log says what was asked for, and beside it what the shaft did
        c["n1_ref"] = c["n1"].copy()
        for k in range(1, len(c["n1"])):
            c["n1"][k] = c["n1"][k - 1] + 0.2 * (c["n1_ref"][max(k - 2, 0)] - c["n1"][k - 1])
        c["n1"] += 0.02 * np.random.default_rng(1).standard_normal(len(c["n1"]))
    return c


def towed():
    """Return vessel and columns (N,) of a ship of the thesis that a tug pulls for a minute."""
    vessel, rng, step, samples = gb.load_vessel("thesis"), np.random.default_rng(1), 0.5, 2400
    bounds = {"n": (4, 20), "alpha1": (-0.5, 0.5), "alpha2": (-0.5, 0.5)}
    commands = {
        name: smoothed_pulses(rng, samples, *reach, widths=(30, 120), smoothing=10)
        for name, reach in bounds.items()
    }
    tau = gb.make_log(vessel, commands, step).forces(STRUCTURE.inputs).copy()
    tau[1000:1120, STRUCTURE.inputs.index("taux")] += 2 * np.abs(tau[:, 0]).mean()
    theta = step * np.array([TRUE[n] for n in STRUCTURE.parameters])
    run = gb.simulate(STRUCTURE, theta, np.array([1.5, 0.5, 0.0]), tau[:-1], step)
    noise = rng.standard_normal((samples, 4)) * [0.014, 0.014, 0.014, 0.01]
    states = {s: run.x[0][:, k] + noise[:, k] for k, s in enumerate("uvr")}
    heading = {"psi": run.psi[0] + noise[:, 3]}
    return vessel, {"t": step * np.arange(samples), **states, **heading, **commands}


def written(check, columns):
    """Return a log's columns (N,) as text; the defect may be one of the text alone."""
    table = pd.DataFrame(columns)
    if check == "time_format":
        # fifty samples a second, one second of which lost the zeros of its fractions
        t = np.arange(len(table)) / 50
        whole = np.floor(t + 1e-9).astype(int)
        part = np.round(1000 * (t - whole)).astype(int)
        short = whole == 9
        table["t"] = [
            f"{a}.{b}" if s else f"{a}.{b:03d}" for a, b, s in zip(whole, part, short, strict=True)
        ]
    return table


CHECKS = (
    "gap", "duplicate_time", "nan", "outlier", "stuck", "quantised", "heading_wrap",
    "position_hold", "position_jump", "time_format", "unit", "frame", "sign", "clock_offset",
    "lever_arm", "heading_bias", "external_force", "actuator",
)  # fmt: skip


def check_figure(check):
    """Plant one defect in a clean log, run the checks, and draw what they find."""
    if check == "external_force":
        vessel, columns = towed()
    else:
        trial = draw(np.random.default_rng(3), (), kind="manoeuvres", samples=900)
        vessel = trial.vessel
        columns = defective(check, {"t": trial.estimation.t, **trial.estimation.channels})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trial.csv"
        written(check, columns).to_csv(path, index=False)
        if check == "actuator":
            first, *others = vessel.thrusters
            vessel = replace(vessel, thrusters=(replace(first, speed_other="n1_ref"), *others))
        (report,) = gb.check_files([path], vessel)
    found = next(f for f in report.findings if f.id == check)
    return finding_figure(found, report, vessel)


def plan_figure(folder):
    """Draw the commands of the plan and the motion that they made."""
    log = gb.read_log(folder / "trial.csv", gb.load_vessel("thesis"))
    figure = new_figure(7.2, 3.6)
    rows = figure.subplots(3, 1, sharex=True)
    rows[0].step(log.t, log["n"], where="post", color=BLUE, lw=1)
    rows[0].set_ylabel("n")
    for name, colour in (("alpha1", BLUE), ("alpha2", RED)):
        rows[1].step(log.t, log[name], where="post", color=colour, lw=1, label=name)
    rows[1].set_ylabel("[rad]")
    for name, colour in (("u", BLUE), ("v", RED)):
        rows[2].plot(log.t, log[name], color=colour, lw=0.8, label=name)
    rows[2].set(ylabel="[m/s]", xlabel="time [s]")
    for axes in rows:
        tidy(axes)
        if axes is not rows[0]:
            axes.legend(fontsize=8, loc="upper right", ncols=2)
    return figure


def runs_figure(folder, names):
    """Draw free runs of models on the other trial beside what was logged."""
    models = {n: gb.load_model(folder / f"{n}.json") for n in names}
    runs = {
        n: gb.run_model(m, gb.read_log(folder / "other.csv", m.vessel)) for n, m in models.items()
    }
    figure = new_figure(7.2, 3.6)
    rows = figure.subplots(3, 1, sharex=True)
    for i, (axes, state) in enumerate(zip(rows, "uvr", strict=True)):
        for (name, run), colour in zip(runs.items(), (RED, BLUE), strict=False):
            if colour == RED:
                axes.plot(run.log.t, run.log[state], ".", ms=2, color="#999999", label="logged")
            axes.plot(run.log.t, run.x[:, i], color=colour, lw=1, label=name)
        axes.set_ylabel(f"{state} [{UNITS[state]}]")
        tidy(axes)
    rows[2].set_xlabel("time [s]")
    figure.legend(
        *rows[0].get_legend_handles_labels(), loc="outside lower left", ncols=3, fontsize=8
    )
    return figure


def save(figure, path):
    """Write a PNG of 64 colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(figure, str(path))
    with Image.open(path) as image:
        image.convert("RGB").quantize(64).save(path, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        files = Path(sys.argv[1])
        save(plan_figure(files), files / "plan.png")
        save(runs_figure(files, ["model"]), files / "model.png")
        save(runs_figure(files, ["model", "better"]), files / "better.png")
        sys.exit()
    for name in CAUSES:
        save(cause_figure(name), FOLDER / "causes" / f"{name}.png")
    for name in CHECKS:
        save(check_figure(name), FOLDER / "checks" / f"{name}.png")
