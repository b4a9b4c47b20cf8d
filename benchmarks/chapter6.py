"""Chapter 6 by NumPy vectorised over runs: a row of `python -m benchmarks`.

Both do the same work: simulate disturbed ships, form the regressors of the three predictors,
solve LS, refine IV2 and IV3 to convergence and IV1 once. NumPy's regressors and model are typed
by hand, which is what the package spares its users.
"""

from __future__ import annotations

import numpy as np

from greybox.study.chapter6 import (
    NOMINAL,
    START,
    TRUE,
    pulse_forces,
    virtual_batch,
)

NAMES = list(TRUE)
TRUTH = np.array([TRUE[n] for n in NAMES])
FIRST = np.array([NOMINAL[n] for n in NAMES])
SUMS = [0, 1, 2, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15, 17]


def simulate(theta, tau, d, runs):
    """Free run by one NumPy statement a term, over all runs."""
    samples = len(tau)
    th = np.broadcast_to(np.atleast_2d(theta).T, (18, runs))
    u, v, r = (np.full(runs, s) for s in START)
    psi = np.zeros(runs)
    out = np.empty((samples + 1, 4, runs))
    out[0] = u, v, r, psi
    for k in range(samples):
        tx, ty, tn = tau[k]
        if d is None:
            ur = uq = u
            vr = vq = v
        else:
            c, s = np.cos(psi), np.sin(psi)
            a = d[:, k].T
            ur, vr = u - (c * a[0] + s * a[1]), v - (c * a[1] - s * a[0])
            uq, vq = u - (c * a[2] + s * a[3]), v - (c * a[3] - s * a[2])
        au, av = np.abs(ur), np.abs(vr)
        du = th[0] * ur + th[1] * vr * r + th[2] * au * ur + th[3] * np.abs(uq) * uq
        du += th[4] * tx + th[5] * ur * tx
        dv = th[6] * vr + th[7] * ur * r + th[8] * av * vr + th[9] * av * r
        dv += th[10] * np.abs(vq) * vq + th[11] * ty
        dr = th[12] * r + th[13] * ur * vr + th[14] * av * vr + th[15] * av * r
        dr += th[16] * uq * vq + th[17] * tn
        psi = psi + r
        u, v, r = u + du, v + dv, r + dr
        out[k + 1] = u, v, r, psi
    return out


def regressors(u, v, r, psi, tau, kind, air):
    """(6.4)-(6.6), (5.61), (5.70), (5.85), (5.64), (5.75), (5.88), typed by hand."""
    tx, ty, tn = (np.broadcast_to(t, u.shape) for t in tau.T)
    au, av = np.abs(u), np.abs(v)
    wind = kind == "3"
    pu = [u, v * r, au * u] + ([np.abs(air[0]) * air[0]] if wind else []) + [tx, u * tx]
    pv = [v, u * r, av * v, av * r] + ([np.abs(air[1]) * air[1]] if wind else []) + [ty]
    pr = [r, u * v, av * v, av * r] + ([air[0] * air[1]] if wind else []) + [tn]
    if kind != "1":
        c, s = np.cos(psi), np.sin(psi)
        c2, s2 = c * c, np.sin(2 * psi)
        pu += [c, s, au * c, au * s, r * c, r * s, tx * c, tx * s, np.sign(u) * c2, np.sign(u) * s2]
        pv += [c, s, av * c, av * s, r * c, r * s, np.sign(v) * c2, np.sign(v) * s2]
        pr += [r * c, r * s, v * c, v * s, u * c, u * s, c2, s2]
    return [np.stack(p, axis=1) for p in (pu, pv, pr)]


def solve(z, phi, y):
    out = []
    for i in range(3):
        gram = np.matmul(z[i], phi[i].transpose(0, 2, 1))
        right = np.matmul(z[i], y[i][..., None])
        size = 6 if phi[i].shape[1] in (6, 14, 16) else 5
        out.append(np.linalg.solve(gram, right)[:, :size, 0])
    return np.concatenate(out, axis=1)


def by_numpy(batch):
    """All six estimators on one batch, vectorised over its runs; converged runs leave."""
    tau = batch.tau[0]
    x, psi = batch.x[:, :-1], batch.psi[:, :-1]
    y = [np.diff(batch.x[:, :, i], axis=1) for i in range(3)]
    found = {}
    good = None
    for kind in ("2", "1", "3"):
        phi = regressors(x[..., 0], x[..., 1], x[..., 2], psi, tau, kind, batch.air)
        found["LS" + kind] = solve(phi, phi, y)
        active = np.arange(len(x))
        theta = good if kind == "1" else np.tile(FIRST, (len(x), 1))
        final = np.full_like(found["LS" + kind], np.nan)
        for _ in range(31):
            with np.errstate(all="ignore"):
                sim = simulate(theta[active], tau, None, len(active))[:-1]
            bounded = np.abs(sim[-1, :3]).max(axis=0) < 50
            active, sim = active[bounded], sim[:, :, bounded]
            us, vs, rs = (np.ascontiguousarray(sim[:, i].T) for i in range(3))
            air = tuple(a[active] for a in batch.air)
            z = regressors(us, vs, rs, psi[active], tau, kind, air)
            z = [a - a.mean(axis=2, keepdims=True) for a in z]
            new = solve(z, [p[active] for p in phi], [t[active] for t in y])
            old = final[active]
            final[active] = new
            if kind == "1":
                break
            theta = theta.copy()
            theta[active] = 0.0
            theta[np.ix_(active, SUMS if kind == "2" else range(18))] = new
            with np.errstate(invalid="ignore"):
                moving = ~(np.abs(new - old) < 1e-4 * np.abs(new)).all(axis=1)
            active = active[moving]
            if not len(active):
                break
        if kind == "2":
            good = theta
        found["IV" + kind] = final
    return found


def data_by_numpy(seed, runs, samples, wind, tau):
    rng = np.random.default_rng([seed, wind])
    d = np.array([0.2, -0.2, wind, wind]) + np.sqrt(1e-3) * rng.standard_normal((runs, samples, 4))
    sim = simulate(TRUTH, tau, d, runs).transpose(2, 0, 1)
    c, s = np.cos(sim[:, :-1, 3]), np.sin(sim[:, :-1, 3])
    air = (
        sim[:, :-1, 0] - (c * d[..., 2] + s * d[..., 3]),
        sim[:, :-1, 1] - (c * d[..., 3] - s * d[..., 2]),
    )
    from greybox.study.monte_carlo import Batch

    noise = np.sqrt(2e-4) * rng.standard_normal((runs, samples + 1, 3))
    heading = sim[..., 3] + 0.01 * rng.standard_normal((runs, samples + 1))
    return Batch(sim[..., :3] + noise, heading, tau[None], air, START)


def agree(samples):
    """Both ways give the same estimates on the same data."""
    from greybox.study.chapter6 import estimate_batch

    batch = virtual_batch(np.random.default_rng(0), 4, samples, 1, pulse_forces(samples))
    ours, theirs = estimate_batch(batch), by_numpy(batch)
    return max(
        float(np.max(np.abs(ours[k][0] - theirs[k]) / (np.abs(theirs[k]) + 1e-9))) for k in theirs
    )
