"""Polish a sequence by direct multiple shooting with CasADi and IPOPT; see `shooting`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from experiment_design.information.moments import MomentProgram
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.lifted import MomentShooting, SensitivityShooting
from experiment_design.optimise.search import Candidate, assess, limit_scale, to_unit
from experiment_design.optimise.shooting import Shooting
from experiment_design.request.problem import TrialProblem
from greybox.errors import UsageError

Array = NDArray[np.float64]

# most columns for which M is lifted as well; its entries grow with their square
EXACT_COLUMNS = 20
# most unknowns for which sensitivities are states of the program
SENSITIVE_COLUMNS = 8
# of IPOPT, in scaled variables
_TOLERANCE = 1e-6
# share of its range within which a level counts as at a limit
_NEAR = 1e-3


class Outcome(Enum):
    """How a polish ended."""

    CONVERGED = "IPOPT converged to a local optimum."
    ACCEPTABLE = "IPOPT converged to its acceptable tolerance."
    ITERATIONS = "IPOPT used up its iterations; the best iterate was kept."
    TIME = "IPOPT used up its time; the best iterate was kept."
    INTERRUPTED = "IPOPT was interrupted; the best iterate was kept."
    INFEASIBLE = "IPOPT found no sequence near this one that keeps all limits."
    FAILED = "IPOPT stopped early; the best iterate was kept."
    REFUSED = "IPOPT was not tried."


_STATUS = {
    "Solve_Succeeded": Outcome.CONVERGED,
    "Solved_To_Acceptable_Level": Outcome.ACCEPTABLE,
    "Feasible_Point_Found": Outcome.ACCEPTABLE,
    "Maximum_Iterations_Exceeded": Outcome.ITERATIONS,
    "Maximum_CpuTime_Exceeded": Outcome.TIME,
    "Maximum_WallTime_Exceeded": Outcome.TIME,
    "User_Requested_Stop": Outcome.INTERRUPTED,
    # what CasADi makes of Ctrl-C inside IPOPT
    "NonIpopt_Exception_Thrown": Outcome.INTERRUPTED,
    "Infeasible_Problem_Detected": Outcome.INFEASIBLE,
    "Restoration_Failed": Outcome.INFEASIBLE,
}


@dataclass(frozen=True)
class Polished(Candidate):
    """A candidate that IPOPT has looked at.

    Parameters
    ----------
    outcome : Outcome
    status : str
        What happened, one sentence or two.
    iterations : int
        Of IPOPT.
    """

    outcome: Outcome = Outcome.REFUSED
    status: str = ""
    iterations: int = 0


class _Iterates(ca.Callback):
    """Keeps the levels of every iterate, so that an interrupt loses nothing."""

    def __init__(self, variables: int, constraints: int, levels: int) -> None:
        ca.Callback.__init__(self)
        self._sizes = {"x": variables, "g": constraints, "f": 1, "lam_x": variables}
        self._sizes["lam_g"] = constraints
        self._levels = levels
        self.seen: list[Array] = []
        self.construct("iterates", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        n = self._sizes.get(str(ca.nlpsol_out(i)), 0)
        return ca.Sparsity.dense(n, 1) if n else ca.Sparsity(0, 0)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        self.seen.append(np.array(arg[0][: self._levels], dtype=float).ravel())
        return [0]


def make_shooting(problem: TrialProblem, unit: Array, exact: bool | None = None) -> Shooting:
    """Return the nonlinear program of a problem's first scenario.

    Parameters
    ----------
    problem : TrialProblem
        With a `MomentProgram` or a small `SensitivityProgram` as its information model
        and a D, A or c criterion.
    unit : ndarray
        (K, nc) a typical sequence, which gives the variables their scales.
    exact : bool, optional
        Climb the exact criterion rather than that of white equation errors; by
        default where the predictor has at most `EXACT_COLUMNS` columns.

    Raises
    ------
    UsageError
        The information model or the criterion has no such program.
    """
    information = problem.scenarios[0].information
    criterion = problem.criterion
    if not criterion.optimality.determinant and criterion.directions is None:
        raise UsageError(
            "IPOPT polishes D, A and c designs, and the largest variance (E) is not smooth: "
            "use the ascent (search.ascend), or --criterion A."
        )
    if isinstance(information, MomentProgram):
        if information.gust is not None:
            raise UsageError(
                "IPOPT polishes designs whose regressors follow from state and command alone, and "
                "a measured wind has its own time: use the ascent (search.ascend)."
            )
        small = information.columns <= EXACT_COLUMNS
        chosen = not information.white and (small if exact is None else exact)
        return MomentShooting(problem, unit, information, chosen)
    if not isinstance(information, SensitivityProgram):
        raise UsageError(
            f"IPOPT polishes designs for the zero-mean IV and the output-error estimates, and "
            f"this one is judged by {type(information).__name__}: use the ascent (search.ascend)."
        )
    if information.columns > SENSITIVE_COLUMNS:
        raise UsageError(
            f"IPOPT polishes output-error designs of at most {SENSITIVE_COLUMNS} unknowns, and "
            f"this one has {information.columns}: use the ascent (search.ascend)."
        )
    return SensitivityShooting(problem, unit, information)


def run_ipopt(
    shooting: Shooting,
    unit: Array,
    *,
    iterations: int = 100,
    seconds: float = 60.0,
    barrier: float = 1e-3,
) -> Polished:
    """Run IPOPT from a sequence and return the best of its iterates; see `solve_ipopt`."""
    start = np.clip(np.asarray(unit, float), 0.0, 1.0)
    options: dict[str, Any] = {
        "iteration_callback_ignore_errors": True,
        "error_on_fail": False,
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt.sb": "yes",
        "ipopt.print_level": 0,
        "ipopt.max_iter": iterations,
        "ipopt.max_wall_time": seconds,
        "ipopt.tol": _TOLERANCE,
        "ipopt.acceptable_tol": 100 * _TOLERANCE,
        "ipopt.acceptable_iter": 5,
        "ipopt.mu_init": barrier,
        "ipopt.bound_push": barrier,
        "ipopt.bound_frac": barrier,
        "ipopt.slack_bound_push": barrier,
        "ipopt.slack_bound_frac": barrier,
        "ipopt.nlp_scaling_method": "none",
    }
    key = repr(options)
    if key not in shooting.solvers:
        shooting.solvers[key] = _solver(shooting, options)
    solver, watch = shooting.solvers[key]
    watch.seen.clear()
    lower, upper = shooting.bounds()
    status = ""
    try:
        found = solver(
            x0=shooting.begin(start), lbx=lower, ubx=upper, lbg=shooting.lbg, ubg=shooting.ubg
        )
        watch.seen.append(np.array(found["x"][: shooting.levels]).ravel())
        status = str(solver.stats()["return_status"])
        outcome = _STATUS.get(status, Outcome.FAILED)
    except KeyboardInterrupt:
        outcome = Outcome.INTERRUPTED
    return _judge(shooting, start, watch.seen, outcome, status)


def _solver(shooting: Shooting, options: dict[str, Any]) -> tuple[Any, _Iterates]:
    watch = _Iterates(shooting.variables, shooting.rows, shooting.levels)
    given = {n: shooting.functions[n] for n in ("grad_f", "jac_g", "hess_lag")}
    w, p, f, g = shooting.symbols
    problem: dict[str, Any] = {"x": w, "p": p, "f": f, "g": g}
    everything = options | given | {"iteration_callback": watch}
    return ca.nlpsol("solver", "ipopt", problem, everything), watch


def _judge(
    shooting: Shooting, start: Array, seen: list[Array], outcome: Outcome, status: str
) -> Polished:
    problem = shooting.problem
    sequences = [start, *[np.clip(u.reshape(problem.shape), 0.0, 1.0) for u in seen]]
    # an interior point stops short of the limits that it tends to
    last = sequences[-1]
    sequences.append(np.where(last < _NEAR, 0.0, np.where(last > 1 - _NEAR, 1.0, last)))
    units = np.array(sequences)
    if shooting.schedule.limited:
        units = to_unit(problem, shooting.schedule.within_reach(problem.levels(units)))
    scale = limit_scale(problem)
    candidates = assess(problem, units)
    best, place = candidates[0], 0
    for i, candidate in enumerate(candidates):
        if candidate.beats(best, scale):
            best, place = candidate, i
    sentence = outcome.value
    if outcome is Outcome.FAILED:
        sentence += f" Its status: {status.replace('_', ' ').lower()}."
    if place == 0:
        sentence += " The sequence that it started from was better and was kept."
    return Polished(best.unit, best.value, best.missed, len(seen), outcome, sentence, len(seen) - 1)


def solve_ipopt(
    problem: TrialProblem,
    unit: Array,
    *,
    iterations: int = 100,
    seconds: float = 60.0,
    barrier: float = 1e-3,
) -> Polished:
    """Polish a sequence, feasible or not, by multiple shooting with IPOPT.

    IPOPT climbs the criterion of the first scenario only; every iterate is then
    judged by `assess` (exact criterion, exact motion, all scenarios), and the best
    one is returned, the start included, so that the result is never worse.

    Parameters
    ----------
    problem : TrialProblem
    unit : ndarray
        (K, nc) start, unit coordinates.
    iterations : int
        Most iterations of IPOPT.
    seconds : float
        Most wall time of IPOPT [s].
    barrier : float
        First barrier parameter, and how far the start is pushed from its limits.

    Returns
    -------
    Polished
        With ``outcome`` and ``status``; refused, with the reason, where the
        criterion or the information model has no such program.

    Notes
    -----
    The pair of nodes whose headings cover the required range is taken from the
    start. With white R the sums of earlier trials count as if their errors had
    this trial's variance.
    """
    try:
        shooting = make_shooting(problem, np.asarray(unit, float))
    except UsageError as refusal:
        start = assess(problem, np.asarray(unit, float)[None])[0]
        return Polished(start.unit, start.value, start.missed, 1, Outcome.REFUSED, str(refusal))
    return run_ipopt(shooting, unit, iterations=iterations, seconds=seconds, barrier=barrier)
