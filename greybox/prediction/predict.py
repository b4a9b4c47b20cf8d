"""Predicts standard manoeuvres of a model, with the intervals that its covariance gives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.errors import InfeasibleError, LogError, UsageError
from greybox.model.model import ManoeuvringModel
from greybox.prediction.conditions import (
    Conditions,
    Task,
    check,
    driven,
    stop_speed,
    stop_throttle,
    tasks,
)
from greybox.prediction.extrapolation import extrapolations
from greybox.prediction.helm import ROUNDED, Helm, find_helm
from greybox.prediction.measuring import known_from, measure, quantities
from greybox.prediction.misfit import held_out_errors, misfit_of
from greybox.prediction.monte_carlo import MonteCarloQuantity, over_draws
from greybox.prediction.notes import (
    instant_orders,
    model_notes,
    prediction_level,
    run_notes,
    trial_notes,
    trust_level,
)
from greybox.prediction.orders import EXECUTES, Legs, Ordered, ZigZagOrders, stop, turn
from greybox.prediction.result import (
    CRITERIA,
    Kind,
    ManoeuvrePrediction,
    PredictedManoeuvre,
    Side,
)
from greybox.prediction.running import Push, sail
from greybox.prediction.ship import WHERE_CURRENT, WHERE_WIND
from greybox.prediction.showing import bundle_of, log_of
from greybox.prediction.start import Start, steady_start, trial_start
from greybox.prediction.steady import Steady, eased, require_straight, straight_run
from greybox.prediction.trial import (
    TrialCurrent,
    as_in_trial,
    circles,
    compare,
    end_again,
    found_in_trial,
    trial_orders,
    wind_of,
    with_rates,
    within_trial,
)
from greybox.public import known_keywords
from greybox.trial.log import TrialLog
from greybox.trial.manoeuvres import Compliance, Criterion, Quantity, TurningCircle
from greybox.trial.manoeuvres.finding import Manoeuvre
from greybox.trial.manoeuvres.standards import check_limit
from greybox.trial.validity import ConditionDifference, other_conditions
from greybox.validation.bands import draw_parameters, process_noise

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

# times of one ship length after which a manoeuvre that is not complete stays so
_LONGEST = 200.0
_UNSIZED = (
    "with the force errors that held-out logs show, all draws diverge, so the intervals leave "
    "these errors out: estimate on logs of such motion."
)
# steps of process noise drawn at once
_STEPS = 1024


@known_keywords
def predict_manoeuvre(
    model: ManoeuvringModel,
    manoeuvre: Kind,
    *,
    angles: Sequence[float | tuple[float, float]] = (),
    side: Side = "",
    speed: float | None = None,
    command: float | Mapping[str, float] | None = None,
    thrusters: Sequence[str] = (),
    share: float | None = None,
    astern: float | None = None,
    until: float | None = None,
    limited: bool = True,
    current: bool | None = None,
    course: float = 0.0,
    disturbed: bool = False,
    scale: float = 1.0,
    draws: int = 256,
    seed: int = 0,
    trial: TrialLog | Sequence[TrialLog] | None = None,
    progress: Progress = lambda done, total: None,
) -> ManoeuvrePrediction:
    """Predict a standard manoeuvre from an identified model.

    The ship sails straight at the approach speed, is given the orders of the manoeuvre by
    the model's own simulation, and its run is measured as that of a trial is. Intervals are
    quantiles over draws of the model's parameters, of which each sails on its own.

    Parameters
    ----------
    model : ManoeuvringModel
    manoeuvre : {"turning", "zigzag", "stopping", "crash"}
        A stop takes the thrust off, a crash stop runs full astern.
    angles : sequence of float or (float, float)
        Steering angles; of a zig-zag also the heading at which it is reversed, which is the
        same angle unless given [rad]. By default 35 degrees, and 10/10 and 20/20.
    side : {"", "port", "starboard"}
        Of the first turn; both where empty.
    speed : float, optional
        Approach speed over ground [m/s]; the propeller speed that holds it is solved for.
    command : float or mapping of str to float, optional
        Propeller speeds of the approach instead, in the unit of the log. By default the
        greatest of the logs that the model was estimated on, or less where the manoeuvre could
        not be steered within the limits otherwise.
    thrusters : sequence of str
        Columns that steer, instead of rudders or the azimuth thrusters aft.
    share : float, optional
        Where speeds steer: by which those on either side differ from the approach's (0.5), or
        of the greatest speed of tunnel thrusters (1).
    astern : float, optional
        Propeller speed of a crash stop, positive; the vessel file's least speed by default.
    until : float, optional
        Share of the approach speed at which a stop ends: 0.2 without thrust, 0 astern.
    limited : bool
        Whether commands keep the ranges of the vessel file; rates hold anyway.
    current : bool, optional
        Whether the model's current and wind act. By default they do beside a trial that does
        not tell its own current, else the water and the air are still.
    course : float
        Heading of the approach, which matters in a current [rad].
    disturbed : bool
        Whether draws hold the model's process noise too: where one trial would lie.
    scale : float
        Length of the full-scale ship over that of the vessel, for the limits of the IMO.
    draws, seed : int
    trial : TrialLog or sequence of TrialLog, optional
        The same manoeuvres are looked for there, predicted at their approach speeds and
        angles, and compared.
    progress : callable
        Told how many manoeuvres of how many are done.

    Returns
    -------
    ManoeuvrePrediction

    Raises
    ------
    UsageError
        What is asked contradicts itself, the vessel or its limits.
    InfeasibleError
        The model does not hold the approach.
    LogError
        The trial holds no such manoeuvre.

    References
    ----------
    IMO MSC.137(76); ITTC 7.5-02-06-05 on the uncertainty of predicted manoeuvres.
    """
    if command is None:
        given: Mapping[str, float] = {}
    else:
        given = command if isinstance(command, Mapping) else {"": float(command)}
    if current is None:
        current = trial is not None and any(model.d)
    asked = Conditions(
        tuple((a, None) if isinstance(a, int | float) else (a[0], a[1]) for a in angles),
        side,
        speed,
        given,
        tuple(thrusters),
        share,
        astern,
        until,
        limited,
        current,
        course,
        disturbed,
        scale,
        draws,
        seed,
    )
    check(manoeuvre, model, asked)
    model = model.at_final_parameters()
    helm = find_helm(model.vessel, asked.thrusters, limited=limited)
    require_straight(helm)
    found: list[tuple[Task, Manoeuvre, TrialLog]] = []
    told_rates: list[str] = []
    elsewhere: tuple[ConditionDifference, ...] = ()
    if trial is None:
        helm = driven(manoeuvre, helm, model, asked)
        todo = tasks(manoeuvre, helm, model, asked)
    else:
        logs = [trial] if isinstance(trial, TrialLog) else list(trial)
        elsewhere = other_conditions(model.conditions, logs)
        found = found_in_trial(manoeuvre, logs, helm, asked)
        helm, told_rates = with_rates(helm, model.vessel.actuation, found)
        if asked.command:
            helm = driven(manoeuvre, helm, model, asked)
        todo = [task for task, _, _ in found]
    theta, d = _draws(model, asked)
    if trial is None and asked.speed is None and not asked.command:
        helm = eased(model, helm, theta, d, asked.course)
    flow = None
    if trial is not None and as_in_trial(asked):
        flow = _trial_current(model, helm, asked, logs, theta, d)
    if flow is not None:
        d[:, WHERE_CURRENT] = 0.0
    made = []
    for i, task in enumerate(todo):
        progress(i, len(todo))
        beside = found[i][1:] if found else None
        predicted = _one(manoeuvre, model, helm, asked, task, theta, d, beside, flow)
        if beside is not None:
            measured, log = beside
            again = end_again(measured, log, stop_speed(manoeuvre, asked))
            agreement = compare(model, helm, again, log, predicted)
            told = trial_notes(
                helm, predicted, measured, log, asked,
                own_start=as_in_trial(asked),
                windy=wind_of(model, measured, log) is not None,
                current=flow,
                usual=model.d[WHERE_CURRENT] if asked.current and model.disturbances else None,
            )  # fmt: skip
            predicted = replace(predicted, agreement=agreement, notes=(*predicted.notes, *told))
        made.append(predicted)
    progress(len(todo), len(todo))
    shared = [n for n in made[0].notes if all(n in m.notes for m in made)]
    made = [replace(m, notes=tuple(n for n in m.notes if n not in shared)) for m in made]
    return ManoeuvrePrediction(
        manoeuvre,
        model.vessel.name,
        helm.sentence if manoeuvre in ("turning", "zigzag") else helm.propulsion,
        tuple(made),
        asked.draws,
        (*model_notes(model, helm, asked), *(d.sentence for d in elsewhere), *told_rates, *shared),
        elsewhere,
        trust_level(model),
        prediction_level(model),
        tuple(instant_orders(manoeuvre, model, helm)),
    )


def _draws(model: ManoeuvringModel, asked: Conditions) -> tuple[Array, Array]:
    """Return parameters (1 + R, p) and disturbances (1 + R, nd), those of the estimate first."""
    rng = np.random.default_rng([137, asked.seed])
    theta, d = draw_parameters(model, rng, asked.draws)
    size = len(model.structure.disturbances)
    acting = np.zeros((asked.draws + 1, size))
    if asked.current and d is not None:
        acting = np.vstack([model.d, d[:, 0]])
    return np.vstack([model.theta, theta]), acting


@dataclass(frozen=True)
class _Setting:
    """What the runs of a manoeuvre sail with: see `sail`.

    `end` (R,) is the surge velocity at which a stop ends, and `unheld` how many draws had no
    approach.
    """

    helm: Helm
    start: Start
    theta: Array
    d: Array
    ordered: Ordered
    longest: float
    wind: Array | None = None
    end: Array | None = None
    unheld: int = 0


def _setting(
    kind: Kind,
    model: ManoeuvringModel,
    helm: Helm,
    asked: Conditions,
    task: Task,
    theta: Array,
    d: Array,
    beside: tuple[Manoeuvre, TrialLog] | None,
    flow: TrialCurrent | None = None,
) -> _Setting:
    """Return how the runs start and what is ordered, as in a trial where there is one."""
    unheld, d = 0, d.copy()
    wind = None if beside is None else wind_of(model, *beside)
    if wind is not None:
        d[:, WHERE_WIND] = wind[0]
    end: Array | None = None
    if beside is not None and as_in_trial(asked):
        measured, trial = beside
        rng = np.random.default_rng([139, asked.seed])
        start = trial_start(model, measured, trial, helm.columns, len(theta), rng)
        if flow is not None:
            start = replace(start, current=flow.drawn(rng, len(theta)))
        helm = within_trial(helm, trial)
        until = stop_speed(kind, asked) * measured.approach_speed.value
        ordered = trial_orders(helm, task, measured, trial, model.sample_time, until)
        end = None if task.order is not None else np.full(len(theta), until)
    else:
        steady = straight_run(model, helm, theta, d, task.course, task.speed)
        kept = np.flatnonzero(steady.found)
        unheld = len(steady.found) - len(kept)
        theta, d = theta[kept], d[kept]
        steady = steady.kept(kept)
        ordered, end = _orders(kind, helm, asked, task, steady)
        start = steady_start(model, steady, task.course)
    longest = _LONGEST * model.vessel.length / float(start.speed[0])
    return _Setting(helm, start, theta, d, ordered, longest, wind, end, unheld)


def _trial_current(
    model: ManoeuvringModel,
    helm: Helm,
    asked: Conditions,
    logs: Sequence[TrialLog],
    theta: Array,
    d: Array,
) -> TrialCurrent | None:
    """Return the current of a trial, None where no turn of its logs tells one.

    What the wind moves the model's circles by, in no current, is taken off their set.
    """
    if not model.structure.marine:
        return None
    still = d.copy()
    still[:, WHERE_CURRENT] = 0.0
    sets = []
    for task, found, log in circles(logs, helm, asked):
        at = _setting("turning", model, helm, asked, task, theta, still, (found, log))
        runs = sail(
            model, at.helm, at.start, at.theta, at.d, task.course,
            at.ordered(np.arange(len(theta))), at.longest, (), at.wind,
        )  # fmt: skip
        if runs.diverged[0]:
            continue
        stays = np.flatnonzero(~runs.diverged).tolist()
        own = [measure(runs, i, model.vessel.length) for i in stays]
        sets.append((found, [m for m in own if isinstance(m, TurningCircle)]))
    return TrialCurrent.of(sets)


def _one(
    kind: Kind,
    model: ManoeuvringModel,
    helm: Helm,
    asked: Conditions,
    task: Task,
    theta: Array,
    d: Array,
    beside: tuple[Manoeuvre, TrialLog] | None,
    flow: TrialCurrent | None,
) -> PredictedManoeuvre:
    at = _setting(kind, model, helm, asked, task, theta, d, beside, flow)
    helm, start, theta, d, wind, end = at.helm, at.start, at.theta, at.d, at.wind, at.end
    ordered, longest, unheld = at.ordered, at.longest, at.unheld
    pushes = [_process(model, asked, len(theta))] if asked.disturbed else []
    errors = held_out_errors(model)
    unsized: tuple[str, ...] = ()
    if errors is not None:
        only = np.zeros(1, int)
        alone = (start.of(only), theta[:1], d[:1], task.course)
        own_run = sail(model, helm, *alone, ordered(only), longest, (), wind)
        args = (start, theta, d, task.course, wind, asked.seed)
        goes_on = task.order is not None
        misfit = misfit_of(model, helm, errors, own_run, *args, goes_on=goes_on)
        pushes += [] if misfit is None else [misfit]
        unsized = (_UNSIZED,) if misfit is None else ()
    orders = ordered(np.arange(len(theta)))
    runs = sail(model, helm, start, theta, d, task.course, orders, longest, pushes, wind)
    if runs.diverged[0]:
        raise InfeasibleError(
            f"the run of the estimate itself diverges within {runs.t[-1] - runs.t[runs.order]:.3g} "
            f"s of the order of the {kind} manoeuvre at {start.speed[0]:.3g} m/s: this model "
            f"cannot predict it. Let greybox estimate leave terms out (--reduce), or estimate "
            f"on a log with such motion."
        )
    executes = orders.executes if isinstance(orders, ZigZagOrders) else None
    angular = helm.angular and task.order is not None

    def measured(run: int) -> Manoeuvre | None:
        if runs.diverged[run]:
            return None
        return measure(
            runs,
            run,
            model.vessel.length,
            rudder=task.order if angular else None,
            full_rudder=helm.greatest if angular else None,
            executes=None if executes is None else executes[run],
            heading=task.heading,
            end_speed=None if end is None else float(end[run]),
            reversed_thrust=kind == "crash",
            scale=asked.scale,
        )

    own = measured(0)
    if own is None:
        raise LogError(
            f"the estimate itself never swings back in the {_label(kind, helm, task, asked)} "
            f"within {longest:.3g} s: give another --angle."
        )
    tables = [quantities(m) if m else {} for m in map(measured, range(1, len(theta)))]
    # draws without an approach reach nothing
    tables += [{}] * unheld
    values = {n: over_draws(v, [t.get(n) for t in tables]) for n, v in quantities(own).items()}
    commands = {
        name: over_draws(
            Quantity(float(start.commands[-1, i, 0]), 0.0, "1"),
            [Quantity(float(c), 0.0, "1") for c in start.commands[-1, i, 1:]],
        )
        for i, name in enumerate(helm.columns)
    }
    log = log_of(runs, 0, model, helm)
    order_time = float(runs.t[runs.order])
    beyond = extrapolations(model, log, order_time)
    since, until = min((e.since for e in beyond or ()), default=math.inf), known_from(own)
    resting = tuple(n for n in values if since < until.get(n, math.inf))
    return PredictedManoeuvre(
        kind,
        task.side,
        None if task.order is None else task.sign * task.order,
        task.heading,
        _label(kind, helm, task, asked),
        {n: q for n, q in commands.items() if q is not None},
        values,
        _criteria(own, values, model.vessel.length, resting, tables, int(runs.diverged[1:].sum())),
        asked.draws,
        int(runs.diverged[1:].sum()),
        int(((runs.complete[1:] < 0) & ~runs.diverged[1:]).sum()),
        unheld,
        (
            *unsized,
            *run_notes(
                kind, task, model, own, runs, unheld, values, log, helm, start, longest, beyond
            ),
        ),
        log,
        order_time,
        bundle_of(runs, helm, task.course, model.vessel.length),
        extrapolated=beyond or (),
        resting=resting,
    )


def _orders(
    kind: Kind, helm: Helm, asked: Conditions, task: Task, steady: Steady
) -> tuple[Ordered, Array | None]:
    """Return what is ordered of chosen runs, and the surge velocity at which a stop ends."""
    if task.order is None:
        end = stop_speed(kind, asked) * steady.speed
        astern = np.full(len(steady.speed), stop_throttle(kind, helm, asked))
        held = helm.commands(astern, 0.0)
        return lambda runs: stop(Legs.of(held[:, runs]), end[runs]), end
    order = task.sign * task.order
    legs = [helm.commands(steady.throttle, way * order) for way in (1.0, -1.0)]
    for i in np.flatnonzero(helm.outside(legs[0][:, :1], ROUNDED)[:, 0]):
        limit = helm.limits[i]
        raise UsageError(
            f"this needs {helm.columns[i]} = {legs[0][i, 0]:.4g}, and the vessel file keeps it "
            f"from {limit.lower} to {limit.upper}: give a smaller --angle or --share, a lower "
            f"--speed, or --no-limits."
        )
    if task.heading is None:
        return lambda runs: turn(Legs.of(legs[0][:, runs])), None
    headings = np.full(EXECUTES - 1, task.heading)
    return (
        lambda runs: ZigZagOrders(task.sign, headings, Legs.of(*(leg[:, runs] for leg in legs))),
        None,
    )


def _process(model: ManoeuvringModel, asked: Conditions, runs: int) -> Push:
    """Return process noise (nx, R) of each sample; none of the estimate's own run."""
    noise = model.noise
    rng = np.random.default_rng([138, asked.seed])
    nx = len(model.structure.states)
    size = np.zeros(nx) if noise is None else noise.process
    memory = np.zeros(nx) if noise is None or not noise.memory.size else noise.memory
    drive = size * np.sqrt(1 - memory**2)

    def drawn() -> Iterator[Array]:
        push = size * rng.standard_normal((runs, nx))
        while True:
            pushes, push = process_noise(rng, push, memory, drive, _STEPS)
            pushes[0] = 0.0
            yield from pushes.transpose(1, 2, 0)

    samples = drawn()
    return lambda k, state, commands: next(samples)


def _criteria(
    own: Manoeuvre,
    values: Mapping[str, MonteCarloQuantity | None],
    length: float,
    resting: Sequence[str],
    tables: Sequence[Mapping[str, Quantity | None]],
    diverged: int,
) -> tuple[Criterion, ...]:
    """Judge the limits that apply by the intervals of the draws, where logs speak for them.

    `tables` hold the quantities of each draw, of which `diverged` are none for what the ship does:
    they are a defect of the model.
    """
    made = []
    unsteered = isinstance(own, TurningCircle) and own.rudder is None
    for criterion in own.criteria:
        name = CRITERIA.get(criterion.name, "")
        value = values.get(name)
        if criterion.limit is None:
            made.append(replace(criterion, reason="no angle steers") if unsteered else criterion)
            continue
        if value is None:
            made.append(
                replace(criterion, verdict=Compliance.OPEN, reason="the run does not reach it")
            )
            continue
        lengths = criterion.measured is None or criterion.measured.unit == "1"
        shown = value.scaled(1 / length, "1") if lengths else value
        judged = check_limit(criterion.name, shown, criterion.limit, criterion.reason)
        if judged.verdict is Compliance.PASS and not value.certain:
            most = criterion.limit * (length if lengths else 1.0)
            within = sum(q is not None and q.value <= most for q in (t.get(name) for t in tables))
            all_of = "all" if within == value.reached else f"{within} of the"
            lost = [f"{diverged} diverge"] * bool(diverged)
            short = value.draws - value.reached - diverged
            lost += [f"{short} do not complete it"] * (short > 0)
            reason = f"{all_of} {value.reached} draws that complete it meet it; {', '.join(lost)}"
            judged = replace(judged, verdict=Compliance.OPEN, reason=reason)
        if name in resting:
            judged = replace(judged, verdict=Compliance.OPEN)
        made.append(judged)
    return tuple(made)


def _label(kind: Kind, helm: Helm, task: Task, asked: Conditions) -> str:
    if task.order is None:
        share = stop_speed(kind, asked)
        what = "stop with full astern" if kind == "crash" else "stop without thrust"
        return what + (f", to {100 * share:g} % of the approach speed" if share else "")
    amount = {
        "rudder": f"rudder {math.degrees(task.order):.3g} deg",
        "azimuth": f"azimuths {math.degrees(task.order):.3g} deg",
        "difference": f"speeds {100 * task.order:.3g} % apart",
        "tunnel": f"tunnel speed {task.order:.4g}",
    }[helm.kind]
    if task.heading is None:
        return f"turning circle to {task.side}, {amount}"
    heading = f"{math.degrees(task.heading):.3g} deg"
    return f"zig-zag, first to {task.side}, {amount}, reversed at {heading} of heading"
