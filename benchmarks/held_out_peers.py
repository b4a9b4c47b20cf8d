"""The other tools of `held_out.py`, in an interpreter that needs none of this package.

`scipy`: output error with regressors chosen by hand, see `held_out_scipy.py`.
`jax-sysid`: state-space in the three states, of second order with moduli and a residual net, by
Adam and L-BFGS from least squares, several seeds.
`sysidentpy`: one polynomial NARX an output by FROLS, run freely together.

All of them choose on the training logs only. Called by `held_out.py`: TOOL JOB.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from held_out_logs import SAMPLE_TIMES, WORST, Array, Loaded, Run, folds, judge, read, write


def picked(ship: str, names: Sequence[str]) -> list[int]:
    """Return the drivers that a black box gets: forces, and what moves the rudder and the air."""
    wanted = {"esso": "T n Td d dd wx wy wn", "hsva": "T Td d dd", "marin": "T Td d dd",
              "blueboat": "S D SS DD", "ferry": "X Y Z", "ferry_2": "X Y Z"}  # fmt: skip
    return [names.index(n) for n in wanted[ship].split() if n in names]


class Scaled:
    """Logs in deviations of the training logs, with the drivers of a black box."""

    def __init__(self, ship: str, names: list[str], runs: list[Run]):
        self.on = picked(ship, names)
        w = np.concatenate([r.w[:, self.on] for r in runs])
        moved = w.std(axis=0) > 1e-3 * np.abs(w).mean(axis=0) + 1e-12
        self.on = [i for i, m in zip(self.on, moved, strict=True) if m]
        self.middle, self.size = w[:, moved].mean(axis=0), w[:, moved].std(axis=0)
        y = np.concatenate([r.y for r in runs])
        self.mean, self.deviation = y.mean(axis=0), y.std(axis=0)

    def states(self, y: Array) -> Array:
        return np.asarray((y - self.mean) / self.deviation)

    def drivers(self, w: Array) -> Array:
        return np.asarray((w[:, self.on] - self.middle) / self.size)

    def rmse(self, runs: Sequence[Run], run: Callable[[Run], Array]) -> Array:
        """Return the error of free runs in deviations of the training logs (3,)."""
        e = [np.clip(np.nan_to_num(run(r), nan=1e3), -1e3, 1e3) - self.states(r.y) for r in runs]
        return np.asarray(np.sqrt((np.minimum(np.concatenate(e) ** 2, WORST**2)).mean(axis=0)))


def jax_sysid(job: dict[str, Any], load: Callable[[float], Loaded]) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp
    from jax_sysid.models import Model

    jax.config.update("jax_enable_x64", True)
    runs, names, held_out = load(SAMPLE_TIMES[job["ship"]][0])
    scaled = Scaled(job["ship"], names, runs)
    m = len(scaled.on)

    def wide(x: Any) -> Any:
        return jnp.concatenate(
            [x, x * jnp.abs(x), jnp.array([x[0] * x[1], x[0] * x[2], x[1] * x[2]])]
        )

    def step(x: Any, u: Any, th: Any) -> Any:
        hidden = jnp.tanh(th[3] @ jnp.concatenate([x, u]) + th[4])
        return x + th[0] @ wide(x) + th[1] @ u + th[2] + th[5] @ hidden

    def train(logs: list[Run], hidden: int, seed: int, seconds: float) -> Any:
        phi, z = [], []
        for r in logs:
            x, u = scaled.states(r.y), scaled.drivers(r.w)
            a = np.column_stack([x, x * np.abs(x), x[:, 0] * x[:, 1], x[:, 0] * x[:, 2],
                                 x[:, 1] * x[:, 2], u, np.ones(len(x))])  # fmt: skip
            phi.append(a[:-1])
            z.append(np.diff(x, axis=0))
        p = np.vstack(phi)
        h = p.T @ p
        ab = np.linalg.solve(h + 1e-3 * len(p) * np.eye(len(h)), p.T @ np.vstack(z)).T
        rng = np.random.default_rng(seed)
        params = [ab[:, :9], ab[:, 9 : 9 + m], ab[:, -1], rng.normal(0, 0.5, (hidden, 3 + m)),
                  rng.normal(0, 0.5, hidden), rng.normal(0, 1e-3, (3, hidden))]  # fmt: skip
        # an evaluation with its gradient takes about 25 us a sample
        calls = int(np.clip(seconds / (25e-6 * sum(len(r.y) for r in logs)), 150, 2000))
        model = Model(3, 3, m, state_fcn=step, output_fcn=lambda x, u, th: x)
        model.init(params=[jnp.array(q) for q in params], x0=[scaled.states(r.first) for r in logs])
        model.loss(rho_x0=0.0, rho_th=1e-4, train_x0=True, xsat=30.0)
        model.optimization(
            adam_eta=2e-3, adam_epochs=calls // 4, lbfgs_epochs=calls - calls // 4, iprint=-1
        )
        model.fit([scaled.states(r.y) for r in logs], [scaled.drivers(r.w) for r in logs])
        return model

    def free(model: Any) -> Callable[[Run], Array]:
        return lambda r: np.asarray(
            model.predict(jnp.array(scaled.states(r.first)), jnp.array(scaled.drivers(r.w)))[0]
        )

    inner, left = folds(runs)[0]
    tried = {}
    for hidden in (1, 6, 12):
        model = train(inner, hidden, 0, 0.2 * job["budget"])
        tried[hidden] = judge([scaled.rmse(left, free(model))])
    hidden = min(tried, key=lambda k: tried[k])
    models = [train(runs, hidden, seed, 0.2 * job["budget"]) for seed in (0, 1)]
    best = min(models, key=lambda k: judge([scaled.rmse(runs, free(k))]))
    for r in held_out:
        write(job, r, free(best)(r) * scaled.deviation + scaled.mean)
    return {"neurons": hidden, "training folds": {str(k): v for k, v in tried.items()}}


def sysidentpy(job: dict[str, Any], load: Callable[[float], Loaded]) -> dict[str, Any]:
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    tried: dict[str, float] = {}
    plans: dict[str, tuple[float, int, int]] = {}

    def train(
        scaled: Scaled, logs: list[Run], degree: int, count: int
    ) -> list[tuple[Array, Array]]:
        """Return codes of the regressors and their coefficients, an output."""
        found = []
        x = [scaled.states(r.y) for r in logs]
        u = [scaled.drivers(r.w) for r in logs]
        for i in range(3):
            others = [j for j in range(3) if j != i]
            inputs = np.vstack(
                [np.column_stack([a[:, others], b]) for a, b in zip(x, u, strict=True)]
            )
            model = FROLS(
                order_selection=False, n_terms=count, ylag=1, xlag=[[1]] * inputs.shape[1],
                estimator=LeastSquares(), basis_function=Polynomial(degree=degree),
                model_type="NARMAX", elag=1,
            )  # fmt: skip
            # the few steps from one log to the next are among thousands
            model.fit(X=inputs, y=np.concatenate([a[:, i] for a in x])[:, None])
            found.append((np.asarray(model.final_model), np.asarray(model.theta).ravel()))
        return found

    def free(models: list[tuple[Array, Array]], scaled: Scaled) -> Callable[[Run], Array]:
        def run(r: Run) -> Array:
            u, x = scaled.drivers(r.w), np.zeros((len(r.y), 3))
            x[0] = scaled.states(r.first)
            tables = []
            for i, (codes, theta) in enumerate(models):
                # 1001 is the output itself, 2001 and 3001 the other two, then the drivers
                order = np.array([0, 1 + i, *(1 + j for j in range(3) if j != i),
                                  *range(4, 4 + u.shape[1])])  # fmt: skip
                tables.append((order[np.asarray(codes, int) // 1000], theta))
            for k in range(len(x) - 1):
                z = np.concatenate([[1.0], x[k], u[k]])
                x[k + 1] = np.clip(
                    [float(z[which].prod(axis=1) @ theta) for which, theta in tables], -1e3, 1e3
                )
            return x

        return run

    # errors of one step tell more where the step is long
    for step in (k * SAMPLE_TIMES[job["ship"]][0] for k in (1, 2, 4)):
        runs, names, _ = load(step)
        scaled = Scaled(job["ship"], names, runs)
        for degree in (1, 2, 3):
            for count in (5, 8, 12, 18) if degree > 1 else (3 + len(scaled.on),):
                if time.process_time() > job["budget"]:
                    continue
                found = []
                for inner, left in folds(runs):
                    models = train(scaled, inner, degree, count)
                    found.append(scaled.rmse(left, free(models, scaled)))
                label = f"degree {degree}, {count} terms, {step:g} s"
                tried[label], plans[label] = judge(found), (step, degree, count)
    step, degree, count = plans[min(tried, key=lambda k: tried[k])]
    runs, names, held_out = load(step)
    scaled = Scaled(job["ship"], names, runs)
    run = free(train(scaled, runs, degree, count), scaled)
    for r in held_out:
        write(job, r, run(r) * scaled.deviation + scaled.mean)
    return {"training folds": dict(sorted(tried.items(), key=lambda k: k[1]))}


def scipy(job: dict[str, Any], load: Callable[[float], Loaded]) -> dict[str, Any]:
    from held_out_scipy import scipy_output_error

    return scipy_output_error(job, load)


TOOLS = {"scipy": scipy, "jax-sysid": jax_sysid, "sysidentpy": sysidentpy}


def main() -> None:
    tool, job = sys.argv[1], json.loads(Path(sys.argv[2]).read_text())
    logs = Path(job["logs"])
    cache: dict[float, Loaded] = {}

    def load(step: float) -> Loaded:
        if step not in cache:
            parts, names = [], []
            for side in ("train", "held_out"):
                found = [read(logs / f"{n}.csv", job["ship"], step) for n in job[side]]
                parts.append([run for runs, _ in found for run in runs])
                names = found[0][1]
            cache[step] = parts[0], names, parts[1]
        return cache[step]

    said = TOOLS[tool](job, load)
    Path(job["out"], "said.json").write_text(json.dumps(said, indent=1))


if __name__ == "__main__":
    main()
