"""Output error with SciPy as an engineer would set it up by hand.

A discrete model, the increments of u, v and r linear in regressors, is run freely with analytic
sensitivities (Numba) and weighed by its own residuals. Sets of regressors are compared by runs
over left-out training logs, with several ridges and sample times: decoupled, second order with
moduli, cubic with propeller and rudder, and a large family from which terms are taken forward by
the gradient of the free run, or which is held by ridge alone. A ship's own damping may not drive
it. Starts: zero, one-step and smoothed least squares, each through segments that grow. The last
fit is SciPy's `least_squares`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from held_out_logs import SAMPLE_TIMES, WORST, Array, Loaded, Run, folds, judge, write
from numpy.typing import NDArray

Index = NDArray[np.intp]

# functions of a state that a regressor is a product of: 1, x, |x|, x², x|x|, x³
BASIS = {"": 0, "x": 1, "a": 2, "xx": 3, "xa": 4, "xxx": 5}
# of the deviation of a channel; beyond it a run has escaped
_BOUND = 30.0


def terms(ship: str, kind: str, names: Sequence[str]) -> list[tuple[int, str, str]]:
    """Return the regressors of a set: (equation, driver, functions of u, v, r).

    The functions are written as in `BASIS` between commas: ``x,a,`` is u |v|.
    """
    if ship in ("esso", "hsva", "marin"):
        push = {
            "modulus": (["T:", "n:x,,"], ["Td:", "d:xx,,"], ["Td:", "d:xx,,"]),
            "cubic": (
                ["T:", "n:x,,", "Tdd:", "dd:xx,,"],
                ["Td:", "d:xx,,", "T:", "N:,x,", "N:,,x"],
                ["Td:", "d:xx,,", "T:", "N:,x,", "N:,,x"],
            ),
        }
        side = ["n:", "T:", "d:", "nd:", "Td:", "Rd:", "Tddd:", "d:x,,", "d:xx,,", "nd:x,,",
                "N:,x,", "N:,,x", "n:,x,", "n:,,x"]  # fmt: skip
        push["family"] = (
            ["n:", "T:", "N:", "n:x,,", "N:x,,", "Tdd:", "dd:", "dd:xx,,", "Td:", "Td:,x,",
             "Td:,,x", "d:x,x,", "d:x,,x"], side, side,
        )  # fmt: skip
    elif ship == "blueboat":
        plain = (["S:"], ["D:"], ["D:"])
        every = ["S:", "D:", "SS:", "DD:", "A:", "AD:", "SD:", "S:x,,", "D:x,,", "S:,x,", "S:,,x",
                 "c:", "s:"]  # fmt: skip
        push = {"modulus": plain, "cubic": (["S:", "S:x,,", "DD:"], ["D:", "S:,x,", "S:"],
                ["D:", "D:x,,", "S:"]), "family": (every,) * 3}  # fmt: skip
    else:
        plain = (["X:"], ["Y:", "Z:"], ["Z:", "Y:"])
        every = ["X:", "Y:", "Z:", "X:x,,", "Y:x,,", "Z:x,,", "c:", "s:"]
        push = {"modulus": plain, "cubic": (["X:", "X:x,,"], ["Y:", "Z:"], ["Z:", "Y:"]),
                "family": (every,) * 3}  # fmt: skip
    push["decoupled"] = push["modulus"]
    hull = {
        "decoupled": ([":x,,", ":xa,,"], [":,x,", ":x,,x"], [":,,x", ":,,xa"]),
        "modulus": (
            [":x,,", ":xa,,", ":,x,x"],
            [":,x,", ":x,,x", ":x,x,", ":,xa,", ":,,x"],
            [":,,x", ":,x,", ":x,x,", ":x,,x", ":,,xa"],
        ),
        "cubic": (
            [":", ":x,,", ":xx,,", ":xxx,,", ":,xx,", ":,,xx", ":,x,x", ":x,xx,"],
            [":", ":,x,", ":,,x", ":x,x,", ":x,,x", ":,xxx,", ":,,xxx", ":,xx,x", ":,x,xx"],
            [":", ":,x,", ":,,x", ":x,x,", ":x,,x", ":,xxx,", ":,,xxx", ":,xx,x", ":,x,xx"],
        ),
    }
    side = [":", ":,x,", ":,,x", ":x,x,", ":x,,x", ":a,x,", ":a,,x", ":,xa,", ":,,xa", ":,a,x",
            ":,x,a", ":,xxx,", ":,,xxx", ":,xx,x", ":,x,xx", ":xx,x,", ":xx,,x", ":x,,",
            ":xx,,"]  # fmt: skip
    hull["family"] = (
        [":", ":x,,", ":xx,,", ":xa,,", ":xxx,,", ":,x,", ":,,x", ":,xx,", ":,,xx", ":,x,x",
         ":x,xx,", ":x,,xx", ":x,x,x", ":,xa,", ":,,xa"], side, side,
    )  # fmt: skip
    air = (["wx:"], ["wy:"], ["wn:"])
    if kind == "family":
        air = (["wx:", "wy:", "wn:"],) * 3
    found = []
    for i in range(3):
        for text in (*hull[kind][i], *push[kind][i], *air[i]):
            driver, states = text.split(":")
            if driver in names:
                found.append((i, driver, states or ",,"))
    return found


@numba.njit(cache=True, fastmath=True)
def simulate(x0, y, w, driver, code, eq, theta, bound, reset, want):  # type: ignore[no-untyped-def]
    """Run freely, anew from `y` every `reset` samples; x (N, 3), sensitivities (N, 3, P).

    After the sample at which a run escapes, the third result, there are no numbers.
    """
    count, p = len(w), len(theta)
    out = np.full((count, 3), np.nan)
    sens = np.zeros((count if want else 1, 3, p))
    x, s, new = x0.copy(), np.zeros((3, p)), np.zeros((3, p))
    value, slope = np.ones((3, 6)), np.zeros((3, 6))
    for k in range(count):
        if reset > 0 and k > 0 and k % reset == 0:
            x[:] = y[k]
            s[:] = 0.0
        out[k] = x
        if want:
            sens[k] = s
        for i in range(3):
            z = x[i]
            if not abs(z) < bound[i]:
                return out, sens, k
            a, sign = abs(z), np.sign(z)
            value[i, 1], value[i, 2], value[i, 3], value[i, 4], value[i, 5] = (
                z, a, z * z, z * a, z * z * z
            )  # fmt: skip
            slope[i, 1], slope[i, 2], slope[i, 3], slope[i, 4], slope[i, 5] = (
                1.0, sign, 2 * z, 2 * a, 3 * z * z
            )  # fmt: skip
        step, jac = np.zeros(3), np.zeros((3, 3))
        for j in range(p):
            e, q = w[k, driver[j]], eq[j]
            b0, b1, b2 = value[0, code[j, 0]], value[1, code[j, 1]], value[2, code[j, 2]]
            phi = e * b0 * b1 * b2
            step[q] += theta[j] * phi
            if want:
                f = theta[j] * e
                jac[q, 0] += f * slope[0, code[j, 0]] * b1 * b2
                jac[q, 1] += f * b0 * slope[1, code[j, 1]] * b2
                jac[q, 2] += f * b0 * b1 * slope[2, code[j, 2]]
                new[q, j] = phi
        if want:
            for i in range(3):
                for j in range(p):
                    more = new[i, j] if eq[j] == i else 0.0
                    new[i, j] = s[i, j] + more + (
                        jac[i, 0] * s[0, j] + jac[i, 1] * s[1, j] + jac[i, 2] * s[2, j]
                    )  # fmt: skip
            s[:] = new
        x += step
    return out, sens, -1


class Family:
    """Regressors and their scales on training logs: parameters are of order one."""

    def __init__(
        self, chosen: list[tuple[int, str, str]], names: list[str], runs: list[Run],
        braked: bool = False,
    ):  # fmt: skip
        self.terms = chosen
        self.eq = np.array([i for i, _, _ in chosen])
        self.driver = np.array([names.index(d) for _, d, _ in chosen])
        self.code = np.array([[BASIS[f] for f in s.split(",")] for _, _, s in chosen])
        y = np.concatenate([r.y for r in runs])
        self.deviation = y.std(axis=0)
        self.bound = np.abs(y).max(axis=0) * 3 + _BOUND * self.deviation
        phi = self.regressors(
            np.concatenate([r.y for r in runs]), np.concatenate([r.w for r in runs])
        )
        moved = np.concatenate([np.diff(r.y, axis=0) for r in runs]).std(axis=0)
        size = np.sqrt((phi**2).mean(axis=0))
        # a driver that never moves acts as none
        self.scale = np.where(size > 1e-9, moved[self.eq] / np.maximum(size, 1e-9), 0.0)
        # the ship's own damping may not drive it: these parameters stay at zero or below
        damping = {(0, "x,,"), (0, "xa,,"), (0, "xxx,,"), (1, ",x,"), (1, ",xa,"), (1, ",xxx,"),
                   (2, ",,x"), (2, ",,xa"), (2, ",,xxx")}  # fmt: skip
        held = np.array([braked and d == "" and (i, s) in damping for i, d, s in chosen])
        self.upper = np.where(held, 0.0, np.inf)

    def regressors(self, y: Array, w: Array) -> Array:
        a = np.abs(y)
        value = np.stack([np.ones_like(y), y, a, y * y, y * a, y**3])
        c = self.code
        return np.asarray(
            w[:, self.driver]
            * value[c[:, 0], :, 0].T
            * value[c[:, 1], :, 1].T
            * value[c[:, 2], :, 2].T
        )

    def run(self, theta: Array, run: Run, on: Index, reset: int = 0, want: bool = False) -> Any:
        return simulate(
            run.first, run.y, run.w, self.driver[on], self.code[on], self.eq[on],
            theta * self.scale[on], self.bound, reset, want,
        )  # fmt: skip

    def errors(
        self, theta: Array, runs: Sequence[Run], on: Index, sigma: Array, reset: int = 0
    ) -> tuple[Array, Array] | None:
        """Return weighed errors and their Jacobian, None where a run escapes."""
        e, jac = [], []
        for run in runs:
            x, s, left = self.run(theta, run, on, reset, True)
            if left >= 0:
                return None
            e.append(((x - run.y) / sigma).ravel())
            jac.append((s / sigma[:, None]).reshape(-1, len(theta)) * self.scale[on])
        return np.concatenate(e), np.concatenate(jac)

    def rmse(self, theta: Array, runs: Sequence[Run], on: Index) -> Array:
        """Return the error of free runs in deviations of the training logs (3,)."""
        total, count = np.zeros(3), 0
        for run in runs:
            x, _, left = self.run(theta, run, on)
            worst = (WORST * self.deviation) ** 2
            square = (x - run.y) ** 2
            if left >= 0:
                square[left:] = worst
            total += np.minimum(square, worst).sum(axis=0)
            count += len(x)
        return np.asarray(np.sqrt(total / count) / self.deviation)

    def fit(
        self, theta: Array, runs: Sequence[Run], on: Index, sigma: Array, ridge: float,
        iterations: int, reset: int = 0,
    ) -> tuple[Array, float]:  # fmt: skip
        """Return Levenberg-Marquardt's parameters and cost."""
        load = ridge * sum(len(r.y) for r in runs)
        theta = np.minimum(theta, self.upper[on])
        now: Any = self.errors(theta, runs, on, sigma, reset)
        if now is None:
            return theta, np.inf
        cost, damp = float(now[0] @ now[0] + load * theta @ theta), 1e-3
        for _ in range(iterations):
            e, jac = now
            h, g = jac.T @ jac + load * np.eye(len(theta)), jac.T @ e + load * theta
            free = ~((theta >= self.upper[on]) & (g < 0))
            for _ in range(6):
                loaded, moves = h + damp * np.diag(np.diag(h) + 1e-9 * len(e)), free.copy()
                # what would pass its limit goes there, the others are solved again
                for _ in range(3):
                    room = np.where(moves, 0.0, self.upper[on] - theta)
                    room[~np.isfinite(room)] = 0.0
                    step = np.where(free, room, 0.0)
                    step[moves] = np.linalg.solve(
                        loaded[moves][:, moves], -(g + loaded @ step)[moves]
                    )
                    over = moves & (theta + step > self.upper[on])
                    if not over.any():
                        break
                    moves &= ~over
                trial = np.minimum(theta + step, self.upper[on])
                then = self.errors(trial, runs, on, sigma, reset)
                new = np.inf if then is None else float(then[0] @ then[0] + load * trial @ trial)
                if new < cost:
                    break
                damp *= 8
            else:
                return theta, cost
            done = cost - new < 1e-4 * cost
            theta, cost, now, damp = trial, new, then, max(damp / 5, 1e-9)
            if done:
                break
        return theta, cost

    def start(self, runs: Sequence[Run], on: Index, ahead: int, ridge: float) -> Array:
        """Return least squares of increments over `ahead` samples on the means of regressors."""
        theta = np.zeros(len(on))
        for i in range(3):
            of = np.flatnonzero(self.eq[on] == i)
            phi, y = [], []
            for r in runs:
                a = self.regressors(r.y, r.w)[:-1][:, on[of]] * self.scale[on[of]]
                c = np.vstack([np.zeros(len(of)), np.cumsum(a, axis=0)])
                phi.append(c[ahead:] - c[:-ahead])
                y.append(r.y[ahead:, i] - r.y[:-ahead, i])
            p, z = np.vstack(phi), np.concatenate(y)
            h = p.T @ p
            theta[of] = np.linalg.solve(
                h + (1e-6 + ridge) * np.trace(h) / max(len(of), 1) * np.eye(len(of)), p.T @ z
            )
        return theta

    def best(
        self, runs: Sequence[Run], on: Index, ridge: float, thorough: bool
    ) -> tuple[Array, Array]:
        """Return the best of several starts and the deviations of its errors (3,)."""
        starts = [self.start(runs, on, 5, 1e-3)]
        if thorough:
            starts += [
                self.start(runs, on, 1, 1e-6),
                np.zeros(len(on)),
                self.start(runs, on, 15, 1e-2),
            ]
        sigma, found = self.deviation, []
        for theta in starts:
            for reset in (20, 100):
                theta, _ = self.fit(theta, runs, on, sigma, max(ridge, 1e-5), 8, reset)
            found.append(self.fit(theta, runs, on, sigma, ridge, 15))
        theta, cost = min(found, key=lambda f: f[1])
        if np.isfinite(cost):
            # likelihood: each channel weighed by its own errors
            for _ in range(2 if thorough else 1):
                sigma = np.maximum(self.rmse(theta, runs, on), 0.02) * self.deviation
                theta, _ = self.fit(theta, runs, on, sigma, ridge, 15)
        return theta, sigma

    def forward(
        self, runs: Sequence[Run], on: Index, most: int, ridge: float, until: float
    ) -> list[tuple[Index, Array]]:
        """Return the path of terms and parameters, each taken by the gradient of the free run."""
        theta, sigma = self.best(runs, on, ridge, False)
        path, every = [(on, theta)], np.flatnonzero(self.scale > 0)
        while len(path) <= most and time.process_time() < until:
            full = np.zeros(len(self.eq))
            full[on] = theta
            now = self.errors(full[every], runs, every, sigma)
            if now is None:
                break
            e, jac = now
            inside = np.isin(every, on)
            h, g = jac.T @ jac, jac.T @ e
            a = np.linalg.solve(h[inside][:, inside] + 1e-6 * len(e) * np.eye(inside.sum()), np.c_[
                g[inside], h[inside][:, ~inside]])  # fmt: skip
            rest = g[~inside] - h[~inside][:, inside] @ a[:, 0]
            power = np.diag(h)[~inside] - np.einsum("ij,ji->i", h[~inside][:, inside], a[:, 1:])
            gain = rest**2 / np.maximum(power, 1e-3 * np.diag(h)[~inside] + 1e-3 * len(e))
            new = every[~inside][int(np.argmax(gain))]
            on, theta = np.append(on, new), np.append(theta, 0.0)
            theta, _ = self.fit(theta, runs, on, sigma, ridge, 6)
            sigma = np.maximum(self.rmse(theta, runs, on), 0.02) * self.deviation
            path.append((on, theta))
        return path


def scipy_output_error(job: dict[str, Any], load: Callable[[float], Loaded]) -> dict[str, Any]:
    from scipy.optimize import least_squares

    ship, began = job["ship"], time.process_time()
    budget = job["budget"]
    tried: dict[str, float] = {}
    # sample time, regressors, ridge, terms taken forward, whether damping has to brake
    plans: dict[str, tuple[float, list[tuple[int, str, str]], float, int, bool]] = {}

    def compare(step: float, kind: str, ridges: Sequence[float], braked: bool = False) -> None:
        runs, names, _ = load(step)
        family = Family(terms(ship, kind, names), names, runs, braked)
        on = np.flatnonzero(family.scale > 0)
        for ridge in ridges:
            found = []
            for train, left in folds(runs):
                theta, _ = family.best(train, on, ridge, False)
                found.append(family.rmse(theta, left, on))
            label = f"{kind}{' braked' * braked} {step:g} s ridge {ridge:g}"
            tried[label], plans[label] = judge(found), (step, family.terms, ridge, 0, braked)

    steps = SAMPLE_TIMES[ship]
    for step in steps:
        compare(step, "modulus", (1e-6, 1e-3))
    step = plans[min(tried, key=lambda k: tried[k])][0]
    for kind, braked in (("cubic", False), ("modulus", True), ("decoupled", False)):
        compare(step, kind, (1e-6, 1e-3), braked)
    compare(step, "decoupled", (1e-6, 1e-3), True)
    runs, names, _ = load(step)
    family = Family(terms(ship, "family", names), names, runs)
    # from the second-order set, and from nearly nothing
    bare = terms(ship, "modulus", names)
    few = [t for t in bare if t[2] in (",,", "x,,") or t == (1, "", ",x,") or t == (2, "", ",,x")]
    most = 16
    for label, base in (("second order", bare), ("bare", few)):
        on = np.array([
            i for i, t in enumerate(family.terms) if t in base and family.scale[i] > 0
        ])  # fmt: skip
        several = folds(runs)
        share = 0.35 * budget / len(several)
        paths = [
            (family.forward(train, on, most, 1e-5, time.process_time() + share), left)
            for train, left in several
        ]
        for size in range(min(len(p) for p, _ in paths)):
            name = f"{label} and {size} of the family, {step:g} s"
            found = [family.rmse(path[size][1], left, path[size][0]) for path, left in paths]
            tried[name], plans[name] = (
                judge(found),
                (step, [family.terms[i] for i in on], 1e-5, size, False),
            )
    if time.process_time() - began < budget:
        compare(step, "family", (1e-3, 1e-2))
    chosen = min(tried, key=lambda k: tried[k])
    step, regressors, ridge, size, braked = plans[chosen]
    runs, names, held_out = load(step)
    if " of the family" in chosen:
        on = np.array([family.terms.index(t) for t in regressors])
        on, _ = family.forward(runs, on, size, ridge, np.inf)[-1]
    else:
        family = Family(regressors, names, runs, braked)
        on = np.flatnonzero(family.scale > 0)
    start, sigma = family.best(runs, on, ridge, True)
    root = np.sqrt(ridge * sum(len(r.y) for r in runs))
    size_e = sum(r.y.size for r in runs)

    def residuals(p: Array) -> Array:
        now = family.errors(p, runs, on, sigma)
        return np.append(np.full(size_e, 1e3) if now is None else now[0], root * p)

    def jacobian(p: Array) -> Array:
        now = family.errors(p, runs, on, sigma)
        return np.vstack(
            [np.zeros((size_e, len(p))) if now is None else now[1], root * np.eye(len(p))]
        )

    upper = family.upper[on]
    begin = np.minimum(start, np.where(np.isinf(upper), np.inf, -1e-9))
    fit = least_squares(
        residuals, begin, jac=jacobian, bounds=(-np.inf, upper), x_scale="jac", max_nfev=30
    )
    rank = sorted(tried.items(), key=lambda k: k[1])
    for run in held_out:
        write(job, run, family.run(fit.x, run, on)[0])
    order = np.argsort(-np.abs(fit.x))
    return {
        "chosen": chosen, "training folds": dict(rank), "cost": float(fit.cost),
        "terms": [[*family.terms[on[i]], round(float(fit.x[i]), 3)] for i in order],
        "training rmse": family.rmse(fit.x, runs, on).tolist(),
    }  # fmt: skip
