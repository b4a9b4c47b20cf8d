"""Reading a log from CSV or Parquet, with the vessel's column names and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from greybox.channels import CHANNELS, unit_factor
from greybox.errors import LogError, suggestion
from greybox.files import sha256
from greybox.trial.conditioning import velocities_from_positions
from greybox.trial.log import Provenance, TrialLog
from greybox.trial.wind import relative_wind
from greybox.vessel.vessel import Vessel

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_MIN_SAMPLES = 3
# share of a sample by which a time step may differ from the others
_JITTER = 0.2
# samples by which a time may differ from a uniform clock
_DRIFT = 0.6


def read_log(
    path: str | Path,
    vessel: Vessel,
    *,
    states: tuple[str, ...] = (),
    fill: Mapping[str, float] | None = None,
) -> TrialLog:
    """Read one log file for a vessel.

    Parameters
    ----------
    path : str or Path
        CSV or Parquet (by its ending), one row a sample.
    vessel : Vessel
        Its ``[columns]`` rename and convert; its thruster columns are required.
    states : tuple of str
        States that must be there or follow from the rest; u, v, r by default.
    fill : mapping of str to float, optional
        Constant values of channels that the file may lack, such as the start of
        a plan that holds commands only.

    Returns
    -------
    TrialLog
        SI and radians, ψ unwrapped, velocities derived where absent (3.57), (3.64).

    Raises
    ------
    LogError
        The file cannot be read; a column is missing (the nearest name is
        suggested); a value is not a number; time does not increase; or there
        are two sample times.
    """
    path = Path(path)
    table = _read_table(path)
    channels, text = _canonical(table, vessel, path, plan=bool(fill))
    if "t" not in channels:
        raise LogError(
            f"'{path.name}' has no column 't'.{suggestion('t', map(str, table.columns))} "
            f"Map the time column in the vessel file's [columns] with its unit."
        )
    t = channels.pop("t")
    if len(t) < _MIN_SAMPLES:
        raise LogError(
            f"'{path.name}' has {len(t)} samples, at least {_MIN_SAMPLES} are needed: "
            f"use a longer log."
        )
    sample_time = _sample_time(t, path.name)
    derived: list[str] = []
    for name in ("psi", "gamma_q"):
        if name in channels:
            channels[name] = np.unwrap(channels[name])
    for name in vessel.angle_commands & channels.keys():
        channels[name] = np.unwrap(channels[name])
    _derive_velocities(channels, vessel, sample_time, derived)
    if "V_q" in channels and "gamma_q" in channels and "u_q" not in channels:
        channels["u_q"], channels["v_q"] = relative_wind(channels["V_q"], channels["gamma_q"])
        derived.append("u_q, v_q from V_q, gamma_q (5.41-5.43)")
    for name, value in (fill or {}).items():
        channels.setdefault(name, np.full(len(t), float(value)))
    _require(channels, vessel, states or ("u", "v", "r"), path.name, [str(c) for c in table])
    closed, known = np.zeros(len(t), bool), False
    if vessel.closed_loop is not None and vessel.closed_loop[0] in text:
        closed = np.isin(text[vessel.closed_loop[0]], vessel.closed_loop[1])
        known = True
    log = TrialLog(
        path.stem,
        sample_time,
        t,
        channels,
        vessel,
        closed,
        known,
        Provenance(path.name, sha256(path), tuple(derived)),
    )
    if any(d.startswith("u, v") for d in derived):
        # the first and last sample have only one neighbour (3.57)
        log = replace(log.window(1, len(log) - 1), name=log.name)
    return log


def _read_table(path: Path) -> pd.DataFrame:
    if not path.exists():
        raise LogError(f"there is no file '{path}': name an existing log.")
    import pandas as pd

    suffix = path.suffix.lower()
    try:
        if suffix in (".parquet", ".pq"):
            return pd.read_parquet(path)
        if suffix in (".csv", ".txt", ""):
            return pd.read_csv(path, skipinitialspace=True)
    except (OSError, ValueError, pd.errors.ParserError, ImportError) as error:
        reason = " ".join(str(error).split())
        raise LogError(
            f"cannot read '{path.name}' as {'Parquet' if 'p' in suffix else 'CSV'}: {reason}. "
            f"Name a table with one header line."
        ) from None
    raise LogError(f"'{path.name}' ends in '{suffix}': logs are CSV (.csv) or Parquet (.parquet).")


def _canonical(
    table: pd.DataFrame, vessel: Vessel, path: Path, *, plan: bool
) -> tuple[dict[str, Array], dict[str, NDArray[Any]]]:
    """Return the numeric channels in SI, and the text columns, by canonical name."""
    columns = [str(c) for c in table.columns]
    channels: dict[str, Array] = {}
    text: dict[str, NDArray[Any]] = {}
    source = {m.name: raw for raw, m in vessel.columns.items() if raw in columns}
    missing = [raw for raw, m in vessel.columns.items() if raw not in columns]
    for name in [*CHANNELS, *vessel.commands]:
        if name in columns and name not in source:
            source[name] = name
    loop = vessel.closed_loop[0] if vessel.closed_loop else None
    if loop is not None and loop in columns:
        text[loop] = table[loop].astype(str).to_numpy()
    positions = {"x_n", "y_n"}
    if {"u", "v"} | positions <= source.keys():
        # positions are not needed where velocities were logged: they may have holes
        holes = table[[source[n] for n in sorted(positions)]].isna().to_numpy().any()
        source = {n: raw for n, raw in source.items() if not holes or n not in positions}
    for name, raw in source.items():
        target = CHANNELS[name].unit if name in CHANNELS else None
        if name in vessel.angle_commands:
            target = "rad"
        mapping = vessel.columns.get(raw)
        factor = 1.0
        if mapping is not None and mapping.unit is not None:
            factor = unit_factor(mapping.unit, target, raw)
        channels[name] = _numeric(table[raw], raw, path.name) * factor
    for raw in missing:
        name = vessel.columns[raw].name
        if name not in channels and (name in vessel.commands or not plan):
            raise LogError(
                f"'{path.name}' has no column '{raw}', which [columns] maps to '{name}'."
                f"{suggestion(raw, columns)} Correct the name in the vessel file."
            )
    return channels, text


def _numeric(column: pd.Series[Any], name: str, source: str) -> Array:
    import pandas as pd

    values = np.array(pd.to_numeric(column, errors="coerce"), dtype=float)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raw = column.iloc[int(bad[0])]
        raise LogError(
            f"column '{name}' of '{source}' holds '{raw}' in row {int(bad[0]) + 2} and "
            f"{len(bad)} of {len(values)} values that are no finite number: "
            f"cut those rows or repair them."
        )
    return values


def _sample_time(t: Array, name: str) -> float:
    steps = np.diff(t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        k = int(wrong[0])
        raise LogError(
            f"time in '{name}' goes from {t[k]:.6g} to {t[k + 1]:.6g} s in row {k + 3}, "
            f"it must increase: sort the rows and drop repeated ones."
        )
    usual = float(np.median(steps))
    off = np.flatnonzero(np.abs(steps - usual) > _JITTER * usual)
    if len(off):
        k = int(off[0])
        raise LogError(
            f"'{name}' has two sample times: {usual:.6g} s, but {steps[k]:.6g} s after "
            f"t = {t[k]:.6g} s ({len(off)} of {len(steps)} steps differ). "
            f"Resample it to one, or split it at the gaps."
        )
    mean = float((t[-1] - t[0]) / (len(t) - 1))
    drift = np.abs(t - t[0] - mean * np.arange(len(t)))
    if drift.max() > _DRIFT * mean:
        k = len(t) // 2
        one, two = ((t[k] - t[0]) / k, (t[-1] - t[k]) / (len(t) - 1 - k))
        raise LogError(
            f"'{name}' has two sample times: {one:.6g} s on average in its first half and "
            f"{two:.6g} s in its second. Resample it to one."
        )
    return round(mean, 9)


def _derive_velocities(
    channels: dict[str, Array], vessel: Vessel, sample_time: float, derived: list[str]
) -> None:
    wanted = [n for n in ("u", "v", "r") if n not in channels]
    if not wanted or "psi" not in channels:
        return
    positioned = "x_n" in channels and "y_n" in channels
    if not positioned and wanted != ["r"]:
        return
    zeros = np.zeros_like(channels["psi"])
    u, v, r = velocities_from_positions(
        channels["x_n"] if positioned else zeros,
        channels["y_n"] if positioned else zeros,
        channels["psi"],
        sample_time,
        heading_std=vessel.std("psi") or 0.0,
        antenna=vessel.sensors.get("antenna", (0.0, 0.0)),
    )
    for name, value in zip("uvr", (u, v, r), strict=True):
        if name in wanted:
            channels[name] = value
    made = ", ".join(wanted)
    derived.append(f"{made} from positions and heading by central differences (3.57)")


def _require(
    channels: dict[str, Array],
    vessel: Vessel,
    states: tuple[str, ...],
    name: str,
    columns: list[str],
) -> None:
    for column in vessel.commands:
        if column not in channels:
            raise LogError(
                f"'{name}' has no column '{column}', which moves a thruster of "
                f"'{vessel.name}'.{suggestion(column, columns)} Its columns: "
                f"{', '.join(columns[:30])}."
            )
    for state in states:
        if state not in channels:
            need = "psi and x_n, y_n" if state in "uv" else "psi"
            raise LogError(
                f"'{name}' has no '{state}' and it cannot be derived without {need}."
                f"{suggestion(state, columns)} Map the columns in the vessel file's [columns]."
            )
    if "psi" not in channels and set(states) & {"v", "r"}:
        raise LogError(
            f"'{name}' has no heading 'psi'.{suggestion('psi', columns)} "
            f"Map it in the vessel file's [columns] with its unit."
        )
