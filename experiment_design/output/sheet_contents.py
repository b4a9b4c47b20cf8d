"""The contents of the trial sheet for the bridge, in words and cells, without layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiment_design.output.legs import Leg, planned_ends
from experiment_design.output.prediction import MotionBand
from experiment_design.output.result import Design
from experiment_design.request.regimes import spell_regime
from greybox.errors import UsageError, so_many
from greybox.prediction.helm import find_helm
from greybox.report.page import tie_units
from greybox.trial.plan_parts import VALIDATION
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]
Samples = NDArray[np.intp]

KNOT = 0.514444
# corridor that no helmsman or sensor is asked to keep closer than, and its least in ship lengths
HEADING_FLOOR = np.deg2rad(10.0)
POSITION_FLOOR = 10.0
# heading past which "off the plan" has no meaning
_BLIND = np.deg2rad(90.0)
# what no cap limits is stopped at this over the band's edge, at most at that over the plan's own
# largest value: the band of a poor model ends nowhere
_OVER, _MOST = 1.1, 1.5
_LONGEST_NAME = 60
_SIDES = {
    ("u", 1): "ahead",
    ("u", -1): "astern",
    ("v", 1): "to starboard",
    ("v", -1): "to port",
    ("r", 1): "to starboard",
    ("r", -1): "to port",
}
_WORDS = {"u": "Surge", "v": "Sway", "r": "Yaw rate"}


@dataclass(frozen=True)
class Column:
    """A column of the way-point table: name and unit, and a cell for each way-point.

    One of `words` is read from its left edge.
    """

    name: str
    unit: str
    cells: tuple[str, ...]
    words: bool = False

    @property
    def width(self) -> int:
        """Characters that it needs."""
        return max(len(c) for c in (self.name, self.unit, *self.cells))


@dataclass(frozen=True)
class SheetContents:
    """One trial in words.

    Parameters
    ----------
    title, subtitle : str
    facts : tuple of (str, str)
        What holds at the start and around the trial.
    warnings : tuple of str
        What the master must know before he agrees, empty where all is kept.
    abort : tuple of str
    columns : tuple of Column
        Way-points in time, with angles in degrees and radians.
    narrow : tuple of Column
        The same with angles in degrees only.
    note : str
        How the table is read.
    """

    title: str
    subtitle: str
    facts: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    abort: tuple[str, ...]
    columns: tuple[Column, ...]
    narrow: tuple[Column, ...]
    note: str

    @property
    def rows(self) -> int:
        """Number of way-points."""
        return len(self.columns[0].cells)


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, such as 4:05."""
    tenths = round(seconds * 10)
    minutes, rest = divmod(tenths, 600)
    return f"{minutes}:{rest // 10:02d}" + (f".{rest % 10}" if rest % 10 else "")


def compass(angle: float) -> str:
    """Return an angle [rad] as a compass direction in degrees, 000 to 359."""
    return f"{round(np.rad2deg(angle)) % 360:03d}"


def signed(value: float, decimals: int = 0) -> str:
    """Return a number with a true minus sign and no negative zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−")


def tie(text: str) -> str:
    """Return text in which a line ends neither between a number and its unit nor in a pair."""
    return tie_units(text).replace("(N, E)", "(N,\u00a0E)")


def plain_name(name: str) -> str:
    """Return a vessel's name as one line of a bearable length."""
    line = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    return line if len(line) <= _LONGEST_NAME else line[: _LONGEST_NAME - 1] + "…"


def sheet_contents(
    design: Design, band: MotionBand, legs: tuple[Leg, ...] | None = None
) -> SheetContents:
    """Return one trial of a design as the words and cells of its sheet.

    Parameters
    ----------
    design : Design
    band : MotionBand
        Of the trial.
    legs : tuple of Leg, optional
        Of the trial, in place of its commands by the clock.
    """
    r = design.request
    which = f"trial {band.trial + 1} of {r.trials}" if r.trials > 1 else "trial"
    regime = r.regimes[band.trial]
    sides = ", ".join(
        f"{_WORDS[s].lower()} {_SIDES[s, sign]}" for s, sign in regime if (s, sign) in _SIDES
    )
    ramp = max(r.schedule.ramp) > 1
    note = (
        "Commands "
        + ("start to move, at the rate limit, at" if ramp else "change at")
        + " the time of their row and hold until the next row; times without a change are left "
        "out. Heading, speed over ground and position (N, E) are those expected at that time."
    )
    if legs is not None:
        note = (
            "Each row is held until its condition is met; commands move at the rate limit. "
            "Times within a row count from its start. Time in the first column, heading, speed "
            "over ground and position (N, E) are those expected at its start."
        )
    if not band.certain:
        by = " by the clock" if legs is not None else ""
        note += f" ±: 95 % of the motions predicted{by} have stayed within since the start."
    signs = signs_words(r.vessel)
    note = f"{signs[:1].upper()}{signs[1:]} {note}".lstrip()
    return SheetContents(
        f"{plain_name(r.vessel.name)}: identification {which}"
        + (", planned without an estimated model" if r.untried else ""),
        f"Duration {clock(r.duration)} min{_parts_words(design, band)}, commands change at most "
        f"every {r.hold:g} s, regime {spell_regime(regime)}" + (f" ({sides})" if sides else ""),
        _facts(design, band),
        _warnings(design, band),
        _abort(design, band),
        _columns(design, band, legs, radians=True),
        _columns(design, band, legs, radians=False),
        note,
    )


def _parts_words(design: Design, band: MotionBand) -> str:
    own = [p for p in design.parts if p.trial == band.trial]
    if not own:
        return ""
    said = [f"{p.name} from {clock(p.begin)} to {clock(p.end)}" for p in own]
    judged = [p for p in own if p.name == VALIDATION]
    if judged:
        said[own.index(judged[0])] += (
            f", {100 * design.share(judged[0]):.0f} %, by which an estimate of the rest is judged"
        )
    return f" ({', '.join(said)})"


def leg_words(leg: Leg, design: Design, trial: int) -> str:
    """Return a leg in a seaman's words.

    Parameters
    ----------
    leg : Leg
    design : Design
        What it is a leg of.
    trial : int
        Counted from 0.
    """
    words = _command_words(leg.commands, design)
    start = float(design.request.starts[trial][-1])
    return f"{words[0].upper()}{words[1:]}; {_until_words(leg, start)}"


def _command_words(commands: Mapping[str, float], design: Design) -> str:
    """Return one command each, rudders first, such as rudder port 20.1°, n 11.0."""
    r = design.request
    rudders = [t.rudder for t in r.vessel.thrusters if t.rudder is not None]
    said = []
    for i, (name, value) in enumerate(commands.items()):
        shown, sign = shown_as(r.vessel, name)
        if name not in r.vessel.angle_commands:
            span = float(r.schedule.upper[i] - r.schedule.lower[i])
            said.append(f"{shown} {_speed_cells(np.array([sign * value]), span)[0]}")
            continue
        what = name
        if name in rudders:
            what = "rudder" if len(set(rudders)) == 1 else f"rudder {name}"
        angle, turns = degrees(value), steers(r.vessel, name)
        if angle == "0°":
            said.append(f"{what} midships")
            continue
        if name in rudders:
            words = f"{what} {side(value)} {angle}"
        elif turns:
            words = f"{what} {angle} to turn her to {side(turns * value)}"
        else:
            words = f"{what} pushing {angle} to {side(value)}"
        if sign < 0:
            words += f" ({shown} {signed(float(np.rad2deg(sign * value)), 1)}°)"
        said.append(words)
    return ", ".join(sorted(said, key=lambda text: not text.startswith("rudder")))


def shown_as(vessel: Vessel, name: str) -> tuple[str, int]:
    """Return the name and sign under which a log of the vessel shows a command.

    They differ from the vessel file's where every raw column that it reads as the command has the
    sign turned.
    """
    raw = {column: c.sign for column, c in vessel.columns.items() if c.name == name}
    turned = name in vessel.sensors.get("reversed", ())
    signs = {sign * (-1 if turned else 1) for sign in (raw.values() or (1,))}
    return (next(iter(raw), f"{name} (as logged)"), -1) if signs == {-1} else (name, 1)


def steers(vessel: Vessel, name: str) -> int:
    """Return 1 where a positive angle turns the ship to starboard, −1 to port, 0 for neither.

    A rudder's does; an azimuth's where nothing else steers, because its angle is the direction in
    which it pushes, and several that push one way may turn her either way.
    """
    if any(t.rudder == name for t in vessel.thrusters):
        return 1
    if len(vessel.angle_commands) > 1:
        return 0
    try:
        helm = find_helm(vessel, (name,), limited=False)
    except UsageError:
        return 0
    return int(np.sign(helm.steer[helm.columns.index(name)]))


def side(value: float) -> str:
    """Return the side of an angle or rate of turn."""
    return "starboard" if value > 0 else "port"


def signs_words(vessel: Vessel) -> str:
    """Return what a positive angle does, of each angle as its log shows it."""
    said = []
    for name in sorted(vessel.angle_commands):
        shown, sign = shown_as(vessel, name)
        turns = steers(vessel, name)
        what = f"turns her to {side(sign * turns)}" if turns else f"pushes to {side(sign)}"
        said.append(f"positive {shown} {what}")
    return f"{'; '.join(said)}." if said else ""


def turned_notes(vessel: Vessel) -> list[str]:
    """Return which commands of a plan a log of the vessel shows with the other sign."""
    shown = {name: shown_as(vessel, name) for name in vessel.commands}
    return [
        f"the plan and its legs hold {name} as the vessel file defines it, which the log's {raw} "
        f"shows with the other sign: an autopilot that is ordered by {raw} needs it turned, and "
        f"the sheet and words have it so"
        for name, (raw, sign) in shown.items()
        if sign < 0
    ]


def degrees(value: float) -> str:
    """Return the size of an angle [rad] in degrees, to a tenth where there is one."""
    return f"{round(abs(float(np.rad2deg(value))), 1):g}°"


def _until_words(leg: Leg, start: float) -> str:
    latest = f", at the latest after {_seconds(leg.at_most)}"
    if leg.until == "time":
        return f"for {_seconds(leg.value)}"
    if leg.until == "heading":
        turn = "starboard" if leg.rising else "port"
        if leg.since == "trial":
            heading = compass(start + leg.value)
            return f"until heading is {heading}°, turning to {turn}{latest}"
        return f"until heading has changed {degrees(leg.value)} to {turn}{latest}"
    away = leg.rising == (leg.value > 0)
    if leg.until == "speed":
        how = "risen" if leg.rising else "fallen"
        return f"until speed has {how} to {leg.value:.3g} m/s ({leg.value / KNOT:.1f} kn){latest}"
    if leg.value == 0:
        return f"until she has stopped turning{latest}"
    rate = f"{abs(float(np.rad2deg(leg.value))):.3g}°/s to {side(leg.value)}"
    return f"until yaw rate has {'risen' if away else 'fallen'} to {rate}{latest}"


def _seconds(value: float) -> str:
    return f"{value:.4g} s" if value < 120 else f"{clock(value)} min"


def _facts(design: Design, band: MotionBand) -> tuple[tuple[str, str], ...]:
    r = design.request
    start = [f"heading {compass(band['psi'].nominal[0])}°"]
    for name in r.structure.states:
        if name not in _WORDS:
            continue
        value = float(band[name].nominal[0])
        side = _SIDES[name, 1 if value >= 0 else -1] if round(value, 3) else ""
        if name == "r":
            text = f"yaw rate {abs(np.rad2deg(value)):.2f}°/s"
        else:
            text = f"{_WORDS[name].lower()} {abs(value):.2f} m/s ({abs(value) / KNOT:.1f} kn)"
        start.append(f"{text} {side}".rstrip())
    held = r.commands_at_start(band.trial)
    if held is not None:
        start.append(f"to set it up, hold {_command_words(held, design)} until she is steady")
    where = f"N {signed(band['x_n'].nominal[0])} m, E {signed(band['y_n'].nominal[0])} m"
    d = np.zeros(4)
    d[: min(4, r.d.size)] = r.d[:4]
    expected = []
    if d[:2].any():
        speed = float(np.hypot(*d[:2]))
        expected.append(
            f"current {speed:.2f} m/s ({speed / KNOT:.1f} kn) setting towards "
            f"{compass(np.arctan2(d[1], d[0]))}°"
        )
    if d[2:].any():
        speed = float(np.hypot(*d[2:]))
        expected.append(
            f"wind {speed:.1f} m/s ({speed / KNOT:.0f} kn) from "
            f"{compass(np.arctan2(-d[3], -d[2]))}°"
        )
    return (
        ("Start", "; ".join(start)),
        ("Position", f"{where} at the start (metres from the origin of the plan)"),
        ("Expected", " and ".join(expected) or "no current, no wind"),
    )


def _warnings(design: Design, band: MotionBand) -> tuple[str, ...]:
    found = []
    broken = [
        x.name + (f" by {x.missed:.3g} {x.unit}".rstrip() if np.isfinite(x.missed) else "")
        for x in design.broken
        if x.trial == band.trial
    ]
    if broken:
        found.append(f"This plan breaks its limits: {', '.join(broken)}.")
    keeping = design.keeping
    if keeping is not None and design.doubtful:
        found.append(
            f"Limits are kept with probability {keeping.probability:.2f} only; "
            f"{design.request.probability:g} was asked for."
        )
    if band.lost:
        found.append(
            f"{band.lost} of {so_many(band.draws, 'model')} drawn from the prior "
            f"{'runs' if band.lost == 1 else 'run'} away on this plan."
        )
    return tuple(found)


def corridor(design: Design, band: MotionBand) -> tuple[Array, Array]:
    """Return how far heading [rad] and position [m] may be off the plan, each (N+1,)."""
    floor = _position_floor(design)
    return np.maximum(band.heading_off, HEADING_FLOOR), np.maximum(band.position_off, floor)


def _position_floor(design: Design) -> float:
    return max(POSITION_FLOOR, design.request.vessel.length)


def _extent(design: Design, band: MotionBand) -> float:
    """Return how far from its start the plan goes [m]: a larger corridor limits nothing."""
    north, east = band["x_n"].nominal, band["y_n"].nominal
    farthest = float(np.hypot(north - north[0], east - east[0]).max())
    return max(farthest, _position_floor(design))


def _over(largest: float, edge: float) -> tuple[float, str]:
    """Return where a plan without a cap is stopped, by its largest value and its band's edge."""
    over = min(_OVER * max(largest, edge), _MOST * largest)
    share = 100 * (over / largest - 1) if largest else 0.0
    return over, (
        f", {share:.0f} % more than the plan's largest; no cap was set: stop, and tell who "
        f"planned the trial"
    )


def _abort(design: Design, band: MotionBand) -> tuple[str, ...]:
    r = design.request
    limits = r.limits
    said = []
    largest = float(band["speed"].nominal.max())
    cap, why = limits.speed_cap, f"; the plan's largest is {largest:.2f} m/s"
    if cap is None:
        cap, why = _over(largest, float(band["speed"].high.max()))
    said.append(f"Speed over ground above {cap:.2f} m/s ({cap / KNOT:.1f} kn){why}.")
    if "r" in band:
        rate = band["r"]
        largest = float(np.abs(rate.nominal).max())
        cap, why = limits.yaw_cap, f"; the plan's largest is {np.rad2deg(largest):.1f}°/s"
        if cap is None:
            cap, why = _over(largest, float(np.abs([rate.low, rate.high]).max()))
        # a plan that does not turn is left by its heading
        if round(np.rad2deg(cap), 1):
            said.append(
                f"Yaw rate above {np.rad2deg(cap):.1f}°/s ({cap:.3f} rad/s) to either side{why}."
            )
    if "edge" in band:
        edge = band["edge"]
        text = (
            f"Nearer than {limits.clearance:.0f} m to the edge of the sea room"
            if limits.clearance
            else "Reaching the edge of the sea room"
        )
        text += f"; the plan comes within {signed(edge.nominal.min())} m"
        if not band.certain:
            low = band.edge_kept
            text += (
                f", 97.5 % of the predicted motions stay at least {low:.0f} m inside"
                if low > 0
                else f", 2.5 % of the predicted motions come {-low:.0f} m or more outside"
            )
        said.append(text + ".")
    heading, place = corridor(design, band)
    if band.certain:
        said.append(
            f"Heading more than {np.rad2deg(heading[-1]):.0f}° or position more than "
            f"{place[-1]:.0f} m off the table."
        )
    else:
        blind = heading > _BLIND
        last = len(heading) - 1 if not blind.any() else max(int(blind.argmax()) - 1, 0)
        half = last // 2
        text = (
            f"Heading more than {np.rad2deg(heading[half]):.0f}° or position more than "
            f"{place[half]:.0f} m off the table until {clock(band.t[half])}, "
            f"{np.rad2deg(heading[last]):.0f}° or {place[last]:.0f} m until "
            f"{clock(band.t[last])} (between: columns ±)"
        )
        if blind.any():
            text += (
                f". After that the model cannot tell the heading within "
                f"{np.rad2deg(_BLIND):.0f}°: keep the other limits"
            )
            if place[-1] <= _extent(design, band):
                text += f", position within {place[-1]:.0f} m"
        said.append(text + ".")
    for name, sign in r.regimes[band.trial]:
        margin = limits.margins.get(name, 0.0)
        symbol = {"u": "|u|", "v": "|v|"}.get(name, f"|{name}|")
        least = design.margins.get(name)
        if name == "r":
            bound = f"{np.rad2deg(margin):.2f}°/s"
        else:
            bound = f"{margin:.2f} m/s ({margin / KNOT:.1f} kn)"
        text = f"{_WORDS.get(name, name)} {_SIDES.get((name, sign), '')} below {bound}"
        text += f", margin of {symbol}"
        if least is not None and name != "r":
            text += f"; least expected {signed(least, 2)} m/s"
        if design.lead_in_s:
            text += f"; from {clock(design.lead_in_s)} on, not in the lead-in"
        said.append(text + ". Not dangerous, but the trial loses its value.")
    return tuple(said)


def _columns(
    design: Design, band: MotionBand, legs: tuple[Leg, ...] | None, *, radians: bool
) -> tuple[Column, ...]:
    if legs is not None:
        ends = planned_ends(design.levels[band.trial], design.request.schedule)[1]
        words = tuple(leg_words(leg, design, band.trial) for leg in legs)
        own = [Column("do", "", (*words, "end"), words=True)]
        return _table_of(design, band, np.array([0, *ends]), own)
    r = design.request
    schedule = r.schedule
    levels = design.levels[band.trial]
    shown = [shown_as(r.vessel, name) for name in schedule.commands]
    made = [
        _command_cells(
            shown[i][0],
            shown[i][1] * levels[:, i],
            float(schedule.upper[i] - schedule.lower[i]),
            name in r.vessel.angle_commands,
            radians,
        )
        for i, name in enumerate(schedule.commands)
    ]
    rows = list(zip(*[c.cells for c in made], strict=True))
    part = design.part_names(band.trial, np.arange(len(rows)) * r.hold) or ("",) * len(rows)
    changed = [
        k for k in range(len(rows)) if k == 0 or (rows[k], part[k]) != (rows[k - 1], part[k - 1])
    ]
    samples = np.array([*(k * schedule.hold for k in changed), len(band.t) - 1])
    return _table_of(
        design,
        band,
        samples,
        [Column(c.name, c.unit, (*(c.cells[k] for k in changed), "end")) for c in made],
    )


def _table_of(
    design: Design, band: MotionBand, samples: Samples, made: list[Column]
) -> tuple[Column, ...]:
    """Return what is done, with what is expected at the samples (M,) where it begins."""
    heading, place = band["psi"].nominal[samples], [
        band[n].nominal[samples] for n in ("x_n", "y_n")
    ]  # fmt: skip
    fine = 0 if max(np.abs(p).max() for p in place) >= 100 else 1
    columns = [Column("time", "min:s", tuple(clock(band.t[k]) for k in samples))]
    part = design.part_names(band.trial, band.t[samples[:-1]])
    if part:
        columns.append(Column("part", "", (*part, ""), words=True))
    columns += [
        *made,
        Column("hdg", "°", tuple(compass(h) for h in heading)),
        Column("speed", "m/s", tuple(f"{v:.2f}" for v in band["speed"].nominal[samples])),
        Column("N", "m", tuple(signed(v, fine) for v in place[0])),
        Column("E", "m", tuple(signed(v, fine) for v in place[1])),
    ]
    if not band.certain:
        off = corridor(design, band)
        turned = np.rad2deg(off[0][samples])
        blind, extent = np.rad2deg(_BLIND), _extent(design, band)
        columns += [
            Column("±", "°", tuple(f"{v:.0f}" if v <= blind else "–" for v in turned)),
            Column("±", "m", tuple(f"{v:.0f}" if v <= extent else "–" for v in off[1][samples])),
        ]
    return tuple(columns)


def _command_cells(name: str, values: Array, span: float, angle: bool, radians: bool) -> Column:
    """Return a command's levels as text: angles in degrees, speeds in the log's unit."""
    if angle:
        degrees = [signed(float(np.rad2deg(v)), 1) for v in values]
        if not radians:
            return Column(name, "°", tuple(degrees))
        both = [f"{d} ({signed(float(v), 2)})" for d, v in zip(degrees, values, strict=True)]
        return Column(name, "° (rad)", tuple(both))
    return Column(name, "as log", tuple(_speed_cells(values, span)))


def _speed_cells(values: Array, span: float) -> list[str]:
    size = span or float(np.abs(values).max(initial=0.0)) or 1.0
    decimals = int(np.clip(2 - np.floor(np.log10(size)), 0, 4))
    return [signed(float(v), decimals) for v in values]
