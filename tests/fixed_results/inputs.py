"""The logs, vessels and models that the fixed commands read.

Made with NumPy alone and written with six decimals, so that no change of the
package changes them.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ship = Mapping[str, tuple[str, str, float]]
# (3.51): equation, factors and true value of Ljungberg (2020), table 6.1, per sample of 1 s
SHIP = {
    "Xu": ("u", "u", -0.05), "Xvr": ("u", "v r", 1.0), "Xuu": ("u", "|u| u", -0.05),
    "Wuu": ("u", "|uq| uq", -0.0005), "Xmu": ("u", "taux", 0.02),
    "Xkappa": ("u", "u taux", -0.0025),
    "Yv": ("v", "v", -0.2), "Yur": ("v", "u r", -0.65), "Yvv": ("v", "|v| v", -0.2),
    "Yvr": ("v", "|v| r", -0.1), "Wvv": ("v", "|vq| vq", -0.0015), "Ymu": ("v", "tauy", 0.02),
    "Nr": ("r", "r", -0.1), "Nuv": ("r", "u v", -0.0015), "Nvv": ("r", "|v| v", -0.001),
    "Nvr": ("r", "|v| r", -0.04), "Wuv": ("r", "uq vq", -0.00003), "Nmu": ("r", "taun", 0.0003),
}  # fmt: skip
# the ship with a rudder, per second
RUDDER = {
    "Xuu": ("u", "|u| u", -0.02), "Xmu": ("u", "taux", 0.01),
    "X_|u|u*rudder_drag": ("u", "|u| u rudder_drag", -0.01),
    "Yv": ("v", "v", -0.2), "Yur": ("v", "u r", -0.4),
    "Y_|u|u*rudder": ("v", "|u| u rudder", -0.02),
    "Nr": ("r", "r", -0.25), "Nuv": ("r", "u v", -0.004),
    "N_|u|u*rudder": ("r", "|u| u rudder", 0.006),
}  # fmt: skip
SURGE = {n: SHIP[n] for n in ("Xu", "Xuu", "Wuu", "Xmu")}
SENSORS = "[sensors]\nu_std = 0.0141\nv_std = 0.0141\nr_std = 0.0141\nheading_std = 0.01\n"
VELOCITY_STD, HEADING_STD = 0.0141, 0.01


def _azimuths(more: str = "", low: float = 0.6, high: float = 1.1) -> str:
    head = 'name = "Two azimuths"\nlength = 30.0\n'
    return head + "".join(
        f'[[thruster]]\ntype = "azimuth"\nx = {x}\nspeed = "n"\nangle = "{angle}"\n'
        f"speed_limits = [10.0, 20.0]\nspeed_rate = 2.0\nangle_limits = [{low}, {high}]\n"
        f"angle_rate = 0.2\n{more}"
        for x, angle in ((9.0, "alpha1"), (-9.0, "alpha2"))
    )


_RUDDER_SHIP = (
    'name = "Rudder ship"\nlength = 20.0\n[[thruster]]\ntype = "propeller_rudder"\nx = -9.0\n'
    'speed = "n"\nrudder = "delta"\nspeed_limits = [0.0, 15.0]\nrudder_limits = [-0.6, 0.6]\n'
)
VESSELS = {
    "ship": _azimuths() + SENSORS,
    "free": _azimuths(low=-3.1, high=3.1) + SENSORS,
    "windy": _azimuths() + SENSORS + "wind_std = 0.2\n",
    "law": _azimuths("thrust = { quadratic_share = 0.4, reference = 15.0 }\ngain = 0.9\n")
    + SENSORS,
    "table": _azimuths("thrust = [[0.0, 0.0], [12.0, 9.0], [20.0, 25.0]]\n") + SENSORS,
    "late": _azimuths() + SENSORS + "[actuation]\nlag = 3.0\ndelay = 1.5\n",
    "slow": _azimuths() + SENSORS
    + '[actuation]\nlag = 2.5\nlag_on = "command"\nlag_held = "end"\n',
    "rudder": _RUDDER_SHIP + SENSORS,
}  # fmt: skip


def _pulses(rng: np.random.Generator, samples: int, low: float, high: float, held: int) -> Array:
    """Return levels held for about so many samples, edges rounded by a Hann window, (N,)."""
    widths = rng.integers(held // 2, 2 * held, samples // (held // 2) + 2)
    levels = np.repeat(rng.uniform(low, high, len(widths)), widths)[: samples + 8]
    window = np.hanning(11)[1:-1]
    return np.convolve(levels, window / window.sum(), "valid")


def _forces(at: Mapping[str, float]) -> dict[str, float]:
    """Return what the thrusters of (3.46), or the propeller and the rudder, exert."""
    if "delta" in at:
        s, c = np.sin(at["delta"]), np.cos(at["delta"])
        return {"taux": at["n"], "rudder": s * c, "rudder_drag": s * s}
    across = [at["n"] * np.sin(at[a]) for a in ("alpha1", "alpha2")]
    along = sum(at["n"] * np.cos(at[a]) for a in ("alpha1", "alpha2"))
    return {"taux": along, "tauy": sum(across), "taun": 9.0 * (across[0] - across[1])}


def _sail(
    ship: Ship,
    command: Callable[[int, float], Mapping[str, float]],
    d: Array,
    step: float,
    start: tuple[float, ...],
    process: Array,
    keeps: float = 0.0,
) -> dict[str, Array]:
    """Step a ship by Euler under commands that may see the heading; d (N, 4) [m/s].

    The force `keeps` a share of its last value.
    """
    samples = len(d)
    x, psi, way = np.array(start[:3]), start[3], np.zeros(2)
    force: dict[str, float] = {}
    rows = []
    for k in range(samples):
        c, s = np.cos(psi), np.sin(psi)
        turn = np.array([[c, s], [-s, c]])
        water, air = x[:2] - turn @ d[k, :2], x[:2] - turn @ d[k, 2:]
        at = command(k, psi)
        rows.append({
            **at, "x_n": way[0], "y_n": way[1], "psi": psi, "u": x[0], "v": x[1], "r": x[2],
            "u_q": air[0], "v_q": air[1],
        })  # fmt: skip
        signals = {"u": water[0], "v": water[1], "r": x[2], "uq": air[0], "vq": air[1]}
        now = _forces(at)
        force = {n: f + keeps * (force.get(n, f) - f) for n, f in now.items()}
        signals |= force
        gain = dict.fromkeys("uvr", 0.0)
        for state, factors, value in ship.values():
            for f in factors.split():
                signal = signals[f.strip("|")]
                value = value * (abs(signal) if f.startswith("|") else signal)
            gain[state] += value
        middle = psi + step * x[2] / 2
        c, s = np.cos(middle), np.sin(middle)
        way = way + step * np.array([c * x[0] - s * x[1], s * x[0] + c * x[1]])
        psi += step * x[2]
        x = x + np.array(list(gain.values())) + process[k]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _noise(rng: np.random.Generator, columns: dict[str, Array], scale: float = 1.0) -> None:
    std = dict.fromkeys("uvr", VELOCITY_STD) | {"psi": HEADING_STD, "x_n": 0.05, "y_n": 0.05}
    for name, value in std.items():
        columns[name] = columns[name] + scale * value * rng.standard_normal(len(columns[name]))


def _trial(
    seed: int,
    samples: int = 500,
    *,
    current: tuple[float, float] = (0.0, 0.0),
    wind: tuple[float, float] = (0.0, 0.0),
    gust: float = 0.03,
    process: float = 0.0,
    noise: float = 1.0,
    positions: bool = False,
    step: float = 1.0,
    keeps: float = 0.0,
) -> dict[str, Array]:
    """Return the columns of a trial of the ship with two azimuths."""
    rng = np.random.default_rng([21, seed])
    held = round(16 / step)
    orders = {
        "n": _pulses(rng, samples, 6, 20, held),
        "alpha1": _pulses(rng, samples, 0.2, 1.3, held),
        "alpha2": _pulses(rng, samples, 0.2, 1.3, held),
    }
    d = np.array([*current, *wind]) + gust * rng.standard_normal((samples, 4))
    pushed = process * np.array([1.0, 1.0, 0.1]) * rng.standard_normal((samples, 3))
    ship = {n: (s, f, step * v) for n, (s, f, v) in SHIP.items()}
    columns = _sail(
        ship, lambda k, _: {n: float(v[k]) for n, v in orders.items()}, d, step,
        (1.5, 1.2, 0.0, 0.3), pushed, keeps,
    )  # fmt: skip
    _noise(rng, columns, noise)
    if not any(wind):
        del columns["u_q"], columns["v_q"]
    if not positions:
        del columns["x_n"], columns["y_n"]
    return columns


def _rudder_trial(seed: int, zigzag: bool) -> dict[str, Array]:
    """Return the columns of zig-zags 20/20, or of rudder pulses, at 0.5 s."""
    rng = np.random.default_rng([22, seed])
    samples, step = 500, 0.5
    speed, rudder = _pulses(rng, samples, 6, 14, 60), _pulses(rng, samples, -0.5, 0.5, 25)
    order = [0.0, 0.0]

    def command(k: int, psi: float) -> dict[str, float]:
        if not zigzag:
            return {"n": float(speed[k]), "delta": float(rudder[k])}
        angle = np.radians(20.0)
        if k == 40:
            order[0] = angle
        elif abs(psi) > angle and order[0] * psi > 0:
            order[0] = -order[0]
        # the steering gear moves 0.087 rad/s
        order[1] += float(np.clip(order[0] - order[1], -0.0437, 0.0437))
        return {"n": 10.0, "delta": order[1]}

    ship = {n: (s, f, step * v) for n, (s, f, v) in RUDDER.items()}
    still = np.zeros((samples, 4)), step, (2.236, 0.0, 0.0, 0.0), np.zeros((samples, 3))
    columns = _sail(ship, command, *still)
    _noise(rng, columns, 0.2)
    del columns["u_q"], columns["v_q"]
    return columns


def _model(ship: Ship, vessel: str, step: float = 1.0, **more: object) -> dict[str, object]:
    """Return the tables of a model file, each parameter known to a twentieth of itself."""
    theta = np.array([value for _, _, value in ship.values()])
    states = [s for s in "uvr" if any(s == state for state, _, _ in ship.values())]
    terms = [{"name": n, "state": s, "factors": f.split()} for n, (s, f, _) in ship.items()]
    inputs = ["taux", "tauy", "taun"][: len(states)]
    if vessel == "rudder":
        inputs = ["taux", "race", "rudder", "race_drag", "rudder_drag"]
    std = np.abs(theta) / 20
    place = np.arange(len(std))
    # no two eigenvalues are equal, so that draws from it are what they are
    covariance = np.outer(std, std) * 0.4 ** np.abs(place[:, None] - place)
    noise = {
        "measurement": dict.fromkeys(states, 0.0141), "process": dict.fromkeys(states, 1e-3),
        "heading": 0.01, "wind": 0.1, "source": "given", "memory": {},
    }  # fmt: skip
    return {
        "format": "greybox-model", "version": 2, "sample_time": step, "integrator": "euler",
        "structure": {
            "name": "fixed", "reference": "", "states": states, "inputs": inputs,
            "disturbance": "marine", "increment": True, "terms": terms,
        },
        "names": list(ship), "theta": theta.tolist(), "std": std.tolist(),
        "covariance": covariance.tolist(), "sums": {}, "disturbances": {},
        "disturbance_covariance": [], "residual_std": dict.fromkeys(states, 0.015), "noise": noise,
        "vessel": tomllib.loads(VESSELS[vessel]), "ranges": {"n": [0.0, 15.0]}, **more,
    }  # fmt: skip


def _means(**values: float) -> dict[str, object]:
    return {n: {"value": v, "std": 0.01, "unit": "m/s"} for n, v in values.items()}


def _scaled(ship: Ship, by: float) -> Ship:
    return {n: (s, f, by * v) for n, (s, f, v) in ship.items()}


def models() -> dict[str, dict[str, object]]:
    """Return the tables of every model file by its name."""
    current = _means(current_north=0.3, current_east=-0.2)
    changes = [
        {"parameter": "Xu", "factor": 3.0, "time": 40.0},
        {"parameter": "Nr", "factor": 0.5, "time": 90.2},
    ]
    other = {**SHIP, "Nvr": ("r", "|v| r", -0.08), "Yvv": ("v", "|v| v", -0.25)}
    calm = {n: t for n, t in SHIP.items() if not n.startswith("W")}
    return {
        "plain": _model(SHIP, "ship"),
        "other": _model(other, "ship"),
        "rk4": _model(SHIP, "ship", integrator="rk4"),
        "late": _model(SHIP, "late", integrator="rk4", disturbances=current),
        "slow": _model(SHIP, "slow"),
        "changing": _model(SHIP, "ship", changes=changes, disturbances=current),
        "blown": _model(SHIP, "law", disturbances=current | _means(wind_north=3.0)),
        "calm": _model(calm, "ship"),
        "free": _model(calm, "free", disturbances=current),
        "surge": _model(SURGE, "ship"),
        "rudder": _model(_scaled(RUDDER, 0.5), "rudder", 0.5),
    }


def logs() -> dict[str, dict[str, Array]]:
    """Return the columns of every log by its name."""
    pushed = _trial(4, current=(0.25, -0.1), process=4e-3)
    plan = {n: v for n, v in _trial(9, 120).items() if n in ("n", "alpha1", "alpha2")}
    made = {
        "calm": (1.0, _trial(1)),
        "current": (1.0, _trial(2, current=(0.2, -0.2))),
        "second": (1.0, _trial(3, current=(0.2, -0.2))),
        "pushed": (1.0, pushed),
        "wind": (1.0, _trial(5, current=(0.2, -0.2), wind=(4.0, 3.0))),
        "windy": (1.0, _trial(6, current=(0.2, -0.2), wind=(6.0, -5.0), gust=0.1)),
        "fine": (0.5, _trial(7, 900, current=(0.2, 0.1), step=0.5, noise=0.5)),
        "tracked": (1.0, _trial(8, 240, current=(0.3, -0.2), positions=True)),
        "late": (1.0, _trial(10, keeps=float(np.exp(-1 / 4)))),
        "brief": (1.0, _trial(11, 200, wind=(4.0, 3.0))),
        "plan": (1.0, plan),
        "rudder": (0.5, _rudder_trial(1, False)),
        "zigzag": (0.5, _rudder_trial(2, True)),
    }
    return {n: {"t": step * np.arange(len(c["n"]))} | c for n, (step, c) in made.items()}


def write_inputs(folder: Path) -> None:
    """Write every vessel, model and log of the fixed commands into a folder."""
    for name, text in VESSELS.items():
        (folder / f"{name}.toml").write_text(text)
    for name, model in models().items():
        (folder / f"{name}.json").write_text(json.dumps(model))
    for name, columns in logs().items():
        rows = np.column_stack(list(columns.values()))
        head = ",".join(columns)
        np.savetxt(folder / f"{name}.csv", rows, "%.6f", ",", header=head, comments="")
