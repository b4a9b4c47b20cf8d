"""D-optimal input design here, by Pyomo.DoE and by pydex: a row of `python -m benchmarks`.

Surge, x⁺ = x + a x + b x|x| + c u (steps of 1 s), the speed x measured after each
step with white noise, the first speed known, and u free within two limits in
each of N intervals. The criterion is log det of the Cramér-Rao information of
(a, b, c), F = Σ S(k)ᵀ S(k) / σ², which is what Pyomo.DoE maximises too. It writes
S by central differences between copies of the model; here S follows from its
recursion. Our exact F is confirmed in each run by a loop over finite differences of
simulations, which judges Pyomo's designs.

Because u keeps x positive, x|x| is written x² for Pyomo, which spares it the
modulus. Times include building the problem. Pyomo gets the same IPOPT library
as CasADi's where cyipopt was built against that, and is called in this process.
Both tools start from mid-range, and from the same two-level sequence, which ours has
to draw as well.

pydex chooses among candidate sequences and weighs them; it has no free input, so
this problem is beyond it. It is given the best of the two-level sequences that our
search draws, and two figures are shown: the best single sequence of those that it
chose, which is what one trial can use, and in the notes its weighted mixture, an
information that only several trials can have and that may exceed any one trial's.

    pip install ".[bench-design]"

cyipopt needs an IPOPT and Pyomo's ``pynumero_ASL``: `pip install cyipopt` with
``PKG_CONFIG_PATH`` at ``casadi/pkgconfig`` builds it against CasADi's IPOPT (where the
paths in its ``ipopt.pc`` are those of its build, a copy with CasADi's own folder). The
library is ``AmplInterface.cpp`` of ``pyomo/contrib/pynumero/src``, compiled as a shared
object with Debian's ``libamplsolver-dev`` and put in ``~/.pyomo/lib``. An ``ipopt``
executable on the path is used in place of both.
"""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.constraints.limit_program import LimitProgram
from experiment_design.constraints.limits import TrialLimits
from experiment_design.criteria.covariance import Criterion
from experiment_design.excitation.inputs import prbs
from experiment_design.excitation.rollout import Rollout
from experiment_design.excitation.schedule import make_schedule
from experiment_design.information.sensitivities import SensitivityProgram
from experiment_design.optimise.search import draw_two_level, within_reach
from experiment_design.optimise.solve import make_shooting, run_ipopt
from experiment_design.request.problem import Scenario, TrialProblem
from greybox.model.catalogue import get_structure
from greybox.model.noise import NoiseLevels
from greybox.model.predictor import build_predictor
from greybox.vessel.vessel import Limits, Thruster, Vessel

Array = NDArray[np.float64]

A, B, C = -0.05, -0.05, 0.1
START, SIGMA = 0.5, 0.014
LOW, HIGH = 0.1, 2.25
NAMES = ("Xu", "Xuu", "Xmu")


@dataclass(frozen=True)
class Run:
    """One tool's design: input (N,) where it is free, log det, and what there is to say."""

    u: Array | None
    note: str
    logdet: float


def information(u: Array, step: float = 1e-6) -> float:
    """Log det F by central differences of simulations, one loop over the samples."""
    theta = np.array([A, B, C])

    def simulate(theta: Array) -> Array:
        x, out = START, []
        for value in u:
            x = x + theta[0] * x + theta[1] * abs(x) * x + theta[2] * value
            out.append(x)
        return np.array(out)

    slopes = []
    for i in range(3):
        d = np.eye(3)[i] * step
        slopes.append((simulate(theta + d) - simulate(theta - d)) / (2 * step))
    s = np.array(slopes) / SIGMA
    return float(np.linalg.slogdet(s @ s.T)[1])


def ours_problem(intervals: int) -> TrialProblem:
    structure = get_structure("surge-Wuu")
    theta = np.array([{"Xu": A, "Xuu": B, "Xmu": C}[n] for n in structure.parameters])
    engine = Thruster("fixed", 0.0, 0.0, "n", speed_limits=Limits(LOW, HIGH))
    vessel = Vessel("surge", 10.0, (engine,))
    predictor = build_predictor(structure, "basic", (("u", (1,)),))
    noise = NoiseLevels(structure.states, np.array([SIGMA]), np.zeros(1))
    schedule = make_schedule(vessel, float(intervals), 1.0, 1.0)
    d = np.zeros(len(structure.disturbances))
    rollout = Rollout(vessel, structure, theta, d, np.array([START, 0.0]), 1.0)
    program = SensitivityProgram(predictor, theta, d, noise, 1.0, initial=False)
    criterion = Criterion("D", program.wanted, np.ones(3), np.ones(3))
    limits = LimitProgram(rollout, schedule, TrialLimits())
    return TrialProblem(schedule, (Scenario(rollout, program, limits),), criterion)


def starts(problem: TrialProblem, count: int = 200) -> tuple[Array, Array]:
    """Return random two-level and PRBS starts, best first, and their values."""
    rng = np.random.default_rng(0)
    held = draw_two_level(problem, rng, count)
    # long holds matter as much as short ones: each sequence is stretched
    for i, width in enumerate(rng.integers(1, 16, count)):
        held[i] = np.repeat(held[i], width, axis=0)[: held.shape[1]]
    unit = np.concatenate([held, within_reach(problem, prbs(*problem.shape))[:4]])
    value = problem.evaluate(unit).value
    order = np.argsort(-value)
    return unit[order], value[order]


def middle(intervals: int) -> Array:
    """Return the mid-range start (N,); a constant would have a determinant of nearly 0."""
    out = np.full(intervals, (LOW + HIGH) / 2)
    out[: intervals // 2] *= 1.2
    return out


def ours(intervals: int, two_level: bool) -> Run:
    """Design by IPOPT from mid-range, and from the best two-level sequence too where wanted."""
    problem = ours_problem(intervals)
    s = problem.schedule
    first = ((middle(intervals) - s.lower) / (s.upper - s.lower))[:, None]
    program = make_shooting(problem, first)
    from_ = [first, starts(problem)[0][0]] if two_level else [first]
    found = [run_ipopt(program, unit, barrier=0.1) for unit in from_]
    best = max(found, key=lambda f: f.value)
    note = "; ".join(f"{f.value:.4f} after {f.iterations} iterations" for f in found)
    return Run(problem.levels(best.unit)[:, 0], note, best.value)


def sequences(intervals: int) -> Array:
    """Return the two-level sequences (M, N) that our search draws, best first."""
    problem = ours_problem(intervals)
    return problem.levels(starts(problem)[0])[:, :, 0]


def pyomo_solver():
    """Return an IPOPT that Pyomo can call, and what it is; ImportError where there is none."""
    import pyomo.environ as pyo

    executable = pyo.SolverFactory("ipopt")
    if executable.available(False):
        executable.options["max_iter"] = 3000
        return executable, "ipopt executable"
    from pyomo.contrib.pynumero.asl import AmplInterface

    library = pyo.SolverFactory("cyipopt")
    if not library.available(False):
        raise ImportError("no IPOPT for Pyomo: neither an ipopt executable nor cyipopt")
    if not AmplInterface.available():
        raise ImportError("cyipopt is there, Pyomo's pynumero_ASL library is not")
    import cyipopt
    from pyomo.contrib.pynumero.algorithms.solvers import cyipopt_solver
    from pyomo.core.base.block import BlockData

    cyipopt_solver.Block = BlockData
    library.config.options["max_iter"] = 3000

    class InProcess:
        """The cyipopt solver as Pyomo.DoE calls a solver.

        It solves members of an indexed block, which the solver's check of its
        argument would refuse, and leaves constant objectives in them, of which
        the solver takes only one.
        """

        def solve(self, model: BlockData, tee: bool = False) -> object:
            active = list(model.component_data_objects(pyo.Objective, active=True))
            real = [o for o in active if o.expr is not None and not pyo.is_fixed(o.expr)]
            kept = (real or active)[:1]
            idle = [o for o in active if all(o is not k for k in kept)]
            for o in idle:
                o.deactivate()
            try:
                return library.solve(model, tee=tee)
            finally:
                for o in idle:
                    o.activate()

    return InProcess(), "cyipopt, IPOPT " + ".".join(map(str, cyipopt.IPOPT_VERSION))


def pyomo_doe(intervals: int, first: Array) -> Run:
    """Design by Pyomo.DoE from the input `first`, square-solved at that input by itself."""
    import pyomo.environ as pyo
    from pyomo.contrib.doe import DesignOfExperiments

    solver, text = pyomo_solver()

    class Surge:
        """The experiment as Pyomo.DoE asks for it."""

        def get_labeled_model(self, **_: object):
            m = pyo.ConcreteModel()
            m.k, m.j = pyo.RangeSet(0, intervals), pyo.RangeSet(0, intervals - 1)
            x = [START]
            for value in first:
                x.append(x[-1] + A * x[-1] + B * x[-1] ** 2 + C * value)
            m.x = pyo.Var(m.k, initialize=lambda m, k: x[k])
            m.x[0].fix(START)
            m.u = pyo.Var(m.j, bounds=(LOW, HIGH), initialize=lambda m, k: float(first[k]))
            m.a, m.b, m.c = (pyo.Var(initialize=v) for v in (A, B, C))
            for v in (m.a, m.b, m.c):
                v.fix()
            m.step = pyo.Constraint(
                m.j,
                rule=lambda m, k: (
                    m.x[k + 1] == m.x[k] + m.a * m.x[k] + m.b * m.x[k] ** 2 + m.c * m.u[k]
                ),
            )
            m.experiment_outputs = pyo.Suffix(direction=pyo.Suffix.LOCAL)
            m.experiment_outputs.update((m.x[k], None) for k in m.k if k)
            m.measurement_error = pyo.Suffix(direction=pyo.Suffix.LOCAL)
            m.measurement_error.update((m.x[k], SIGMA) for k in m.k if k)
            m.experiment_inputs = pyo.Suffix(direction=pyo.Suffix.LOCAL)
            m.experiment_inputs.update((m.u[k], None) for k in m.j)
            m.unknown_parameters = pyo.Suffix(direction=pyo.Suffix.LOCAL)
            m.unknown_parameters.update((v, pyo.value(v)) for v in (m.a, m.b, m.c))
            return m

    doe = DesignOfExperiments(
        Surge(), fd_formula="central", step=1e-3, objective_option="determinant",
        scale_nominal_param_value=True, scale_constant_value=1.0, solver=solver,
        logger_level=logging.ERROR,
    )  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        doe.run_doe()
    u = np.array(doe.results["Experiment Design"], float)
    note = (
        f"{text}, {doe.results['Termination Condition']}; build "
        f"{doe.results['Build Time']:.2f}, initialise {doe.results['Initialization Time']:.2f}, "
        f"solve {doe.results['Solve Time']:.2f} s"
    )
    return Run(u, note, information(u))


def pydex(intervals: int, candidates: Array) -> Run:
    """Weigh candidate inputs (M, N) by pydex."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from cvxpy.error import SolverError
        from pydex.core.designer import Designer

    def simulate(ti_controls, sampling_times, model_parameters):
        a, b, c = np.array([A, B, C]) * model_parameters
        x, out = START, []
        for value in ti_controls:
            x = x + a * x + b * abs(x) * x + c * value
            out.append(x)
        return np.array(out)[:, None]

    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        designer = Designer()
        designer.simulate = simulate
        # in units of their values, because its steps are absolute
        designer.model_parameters = np.ones(3)
        designer.ti_controls_candidates = candidates
        designer.sampling_times_candidates = np.tile(
            np.arange(1.0, intervals + 1), (len(candidates), 1)
        )
        designer.error_cov = np.array([[SIGMA**2]])
        designer.initialize(verbose=0)
        # its default first step of 2 takes these parameters into divergence
        designer.eval_sensitivities(base_step=0.1)
        try:
            designer.design_experiment(
                designer.d_opt_criterion, package="cvxpy", optimizer="CLARABEL"
            )
        except SolverError:  # its problem is badly scaled; the other free solver may cope
            designer.design_experiment(designer.d_opt_criterion, package="cvxpy", optimizer="SCS")
        efforts = np.asarray(designer.efforts, float).reshape(len(candidates), -1).sum(axis=1)
    problem = ours_problem(intervals)
    s = problem.schedule
    unit = (candidates[..., None] - s.lower) / (s.upper - s.lower)
    motion = problem.scenarios[0].rollout.run(s.expand(problem.levels(unit)))
    grams = problem.moments(motion, 0).gram
    mixture = np.einsum("m,mij->ij", efforts / efforts.sum(), grams)
    chosen = np.flatnonzero(efforts > 1e-3)
    mixed = float(np.linalg.slogdet(mixture)[1])
    note = f"mixture of {len(chosen)} of {len(candidates)} given sequences, log det {mixed:.4f}"
    return Run(None, note, float(np.linalg.slogdet(grams[chosen])[1].max()))
