"""An identified model: structure, parameters, their covariance, and where they came from."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError, ModelFileError, so_many, suggestion
from greybox.files import nearest_file, plain, write_json
from greybox.model.disturbances import DisturbanceKind
from greybox.model.noise import (
    BandCalibration,
    NoiseLevels,
    calibration_from_dict,
    noise_from_dict,
)
from greybox.model.run.changes import Change, factors_at, require_parameters
from greybox.model.run.step import Integrator
from greybox.model.structure import Structure
from greybox.model.terms import Factor, Term, parameter_unit
from greybox.model.versions import VERSION, upgraded
from greybox.notebook import DisplayMixin, items, parameters, text
from greybox.trial.validity import Validity, in_words, validity_from_dict, validity_to_dict
from greybox.vessel.toml import vessel_from_dict, vessel_to_dict
from greybox.vessel.vessel import Vessel

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)
FORMAT = "greybox-model"
_MAX_BYTES = 50_000_000


@dataclass(frozen=True, repr=False, eq=False)
class ManoeuvringModel(DisplayMixin):
    """A model that can be simulated, compared, saved and designed with.

    Parameters
    ----------
    structure : Structure
    theta : ndarray
        (p,) discrete parameters at `sample_time`, in the order of the structure.
    covariance : ndarray
        (p, p)
    sample_time : float
        Ts [s].
    vessel : Vessel
    integrator : {"euler", "rk4"}
    disturbances : mapping of str to (float, float)
        Known disturbance means and their standard errors [m/s].
    disturbance_covariance : ndarray
        (p + m, m) covariance of the parameters, then of the m means in the order of
        `disturbances`, with these means; (0, 0) where only standard errors are known.
    residual_std : ndarray
        (nx,) standard deviation of the one-step residuals.
    noise : NoiseLevels, optional
        What the estimate found of the noises.
    sums : mapping of str to tuple of str
        Parameters that stand for a sum, such as Xuu for Xuu + Wuu.
    record : mapping
        What the estimate reported: fit, tests, method, notes, provenance.
    changes : tuple of Change
        Parameters that change during a log.
    conditions : mapping of str to tuple
        Draught, trim, loading, water depth and sea state of the logs that it was estimated
        on, as far as they state them: see `greybox.trial.validity`.
    calibration : BandCalibration, optional
        How far its bands must reach to hold what it lacks; None where nothing was held out.

    Raises
    ------
    StructureError
        A change is of no parameter of the structure.
    """

    structure: Structure
    theta: Array
    covariance: Array
    sample_time: float
    vessel: Vessel
    integrator: Integrator = "euler"
    disturbances: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    disturbance_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    residual_std: Array = field(default_factory=lambda: np.zeros(0))
    noise: NoiseLevels | None = None
    sums: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)
    changes: tuple[Change, ...] = ()
    conditions: Validity = field(default_factory=dict)
    calibration: BandCalibration | None = None

    def __post_init__(self) -> None:
        require_parameters(self.changes, self.names, self.structure.name)

    def __eq__(self, other: object) -> bool:
        """Whether both are the same model: their files would hold the same."""
        if not isinstance(other, ManoeuvringModel):
            return NotImplemented
        return self is other or self._content() == other._content()

    def __hash__(self) -> int:
        return hash((self.names, self.theta.tobytes(), self.sample_time, self.integrator))

    def _content(self) -> str:
        return json.dumps(self.to_dict(), sort_keys=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.structure.parameters

    @property
    def std(self) -> Array:
        """Standard errors, (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def force_unit(self) -> str:
        """Unit of the generalised force: N, or that of the propeller speed."""
        return self.vessel.force_unit

    @property
    def units(self) -> list[str]:
        """Unit of each parameter."""
        return [parameter_unit(t, self.force_unit) for t in self.structure.terms]

    @property
    def d(self) -> Array:
        """Disturbance means in the order of the structure, zero where unknown (nd,)."""
        return np.array(
            [self.disturbances.get(n, (0.0, 0.0))[0] for n in self.structure.disturbances]
        )

    def at_final_parameters(self) -> ManoeuvringModel:
        """Return the model as it is after its last change."""
        if not self.changes:
            return self
        now = factors_at(self.changes, self.names, np.inf)
        covariance = self.covariance * np.outer(now, now)
        shared = self.disturbance_covariance
        if shared.size:
            shared = shared * np.append(now, np.ones(len(shared) - len(now)))[:, None]
        return replace(
            self,
            theta=self.theta * now,
            covariance=covariance,
            disturbance_covariance=shared,
            changes=(),
        )

    def estimable(self) -> ManoeuvringModel:
        """Return the model of the terms that a regression can find; nothing else changes."""
        kept = [i for i, t in enumerate(self.structure.terms) if t.estimable]
        if len(kept) == len(self.theta):
            return self
        shared = self.disturbance_covariance
        rows = [*kept, *range(len(self.theta), len(shared))]
        return replace(
            self,
            structure=self.structure.estimable(),
            theta=self.theta[kept],
            covariance=self.covariance[np.ix_(kept, kept)],
            disturbance_covariance=shared[rows] if shared.size else shared,
        )

    def coefficient_model(self) -> ManoeuvringModel:
        """Return the model whose coefficients may be interpreted.

        It is this one, unless its file holds a second estimate beside the one that predicts.
        """
        other = self.record.get("coefficients")
        return self if not isinstance(other, dict) else model_from_dict(other, "coefficients")

    def settled(self) -> ManoeuvringModel:
        """Return `at_final_parameters` under its former name, which is deprecated."""
        warnings.warn(
            "ManoeuvringModel.settled() is deprecated: write at_final_parameters().",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.at_final_parameters()

    def label(self, name: str) -> str:
        """Return a parameter's name with the terms it sums, such as ``Xuu+Wuu``."""
        return "+".join(self.sums.get(name, (name,)))

    @property
    def step_states(self) -> tuple[str, ...]:
        """Names of ``x`` of `step_function`."""
        from greybox.model.run.whole_ship import state_names

        return state_names(self)

    def step_function(self) -> ca.Function:
        """Return one sample of the whole ship, ``(x, command[, wind]) -> x_next``.

        For controllers, observers and simulators: see `greybox.model.run.whole_ship.whole_step`.
        The commands are ``vessel.commands``, their limits ``vessel.limits``.
        """
        from greybox.model.run.whole_ship import whole_step

        return whole_step(self)

    def rhs_function(self) -> ca.Function:
        """Return the time derivatives ``(x, command[, wind]) -> x_dot``.

        Its Euler step is `step_function`: see `greybox.model.run.whole_ship.whole_rate`.
        """
        from greybox.model.run.whole_ship import whole_rate

        return whole_rate(self)

    def summary(self) -> str:
        """Return the equations and the parameters, per sample and per second."""
        wide = max(16, *(len(self.label(name)) for name, *_ in self.shown_parameters()))
        lines = [
            f"Model of {self.vessel.name}: structure '{self.structure.name}', "
            f"sample time {self.sample_time:g} s, {self.integrator}",
            "",
            *self.structure.equations(),
            "u_r, v_r: velocity through the water; u_q, v_q: through the air",
            "",
            f"{'parameter':<{wide}}{'value':>13}{'std err':>12}{'per second':>13}  unit per sample",
        ]
        for name, value, std, unit in self.shown_parameters():
            lines.append(
                f"{self.label(name):<{wide}}{value:>13.5g}{std:>12.2g}"
                f"{value / self.sample_time:>13.5g}  {unit}"
            )
        for name, (value, std) in self.disturbances.items():
            lines.append(f"{name:<{wide}}{value:>13.5g}{std:>12.2g}{'':>13}  m/s")
        lines += [f"{c.sentence}, of the log's clock" for c in self.changes]
        if self.conditions:
            lines.append(f"estimated at {in_words(self.conditions)}")
        return "\n".join(lines)

    def shown_parameters(self) -> list[tuple[str, float, float, str]]:
        """Return name, value, standard error and unit; of an equation's bumps the largest one."""
        rows = []
        local: dict[str, list[int]] = {}
        for i, term in enumerate(self.structure.terms):
            if term.local:
                local.setdefault(term.state, []).append(i)
            else:
                rows.append((term.name, i))
        for state, at in local.items():
            most = max(at, key=lambda i: abs(self.theta[i]))
            rows.append((f"g_{state} at most", most))
        units = self.units
        return [(name, float(self.theta[i]), float(self.std[i]), units[i]) for name, i in rows]

    def _parts(self) -> tuple[str, ...]:
        judged = self.record.get("verdict")
        said = judged if isinstance(judged, dict) else {}
        rows = [(self.label(n), v, s, u) for n, v, s, u in self.shown_parameters()]
        known = [(n, value, std, "m/s") for n, (value, std) in self.disturbances.items()]
        return (
            *(
                text(f"{what.capitalize()} of the estimate: {said[what]['text']}")
                for what in ("prediction", "coefficients")
                if what in said
            ),
            parameters([*rows, *known]),
            items("Changes", [c.sentence for c in self.changes]),
            text(f"Estimated at {in_words(self.conditions)}" if self.conditions else ""),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the model as the tables of its JSON file."""
        s = self.structure
        data = {
            "format": FORMAT,
            "version": VERSION,
            "sample_time": self.sample_time,
            "integrator": self.integrator,
            "structure": {
                "name": s.name,
                "reference": s.reference,
                "states": list(s.states),
                "inputs": list(s.inputs),
                "disturbance": s.disturbance,
                "increment": s.increment,
                "terms": [
                    {"name": t.name, "state": t.state, "factors": [str(f) for f in t.factors]}
                    for t in s.terms
                ],
                "equations": s.equations(),
            },
            "names": list(self.names),
            "theta": self.theta,
            "std": self.std,
            "units": self.units,
            "theta_per_second": self.theta / self.sample_time,
            "covariance": self.covariance,
            "sums": {k: list(v) for k, v in self.sums.items()},
            "disturbances": {
                k: {"value": v, "std": e, "unit": "m/s"} for k, (v, e) in self.disturbances.items()
            },
            "disturbance_covariance": self.disturbance_covariance,
            "residual_std": dict(zip(s.states, self.residual_std, strict=False)),
            "noise": None if self.noise is None else self.noise.to_dict(),
            "vessel": vessel_to_dict(self.vessel),
        }
        if self.changes:
            data["changes"] = [vars(c) for c in self.changes]
        if self.conditions:
            data["conditions"] = validity_to_dict(self.conditions)
        if self.calibration is not None:
            data["calibration"] = self.calibration.to_dict()
        out: dict[str, Any] = plain(data | dict(self.record))
        return out

    def save(self, path: str | Path) -> None:
        """Write the model as JSON, in one step."""
        write_json(self.to_dict(), path)


_CORE = {
    "format", "version", "sample_time", "integrator", "structure", "names", "theta", "std",
    "units", "theta_per_second", "covariance", "sums", "disturbances",
    "disturbance_covariance", "residual_std", "noise", "vessel", "changes",
    "conditions", "calibration",
}  # fmt: skip


def model_from_dict(data: Any, source: str = "model") -> ManoeuvringModel:
    """Build a model from the tables of its file.

    Raises
    ------
    ModelFileError
        It is not a model, of a newer version, or inconsistent. Files of earlier
        versions are read as they were meant.
    """
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ModelFileError(
            f"'{source}' is not a model file: make one with 'greybox estimate … --out MODEL'."
        )
    from greybox.model.schema import require_tables

    data = upgraded(data, source)
    require_tables(data, source)
    integrators = get_args(Integrator)
    if data["integrator"] not in integrators:
        raise ModelFileError(
            f"'{source}' has the integrator '{data['integrator']}', which is not known."
            f"{suggestion(data['integrator'], integrators)} Known: {', '.join(integrators)}."
        )
    widths = (
        {len(row) for row in data["covariance"]},
        {len(r) for r in data["disturbance_covariance"]},
    )
    if any(len(w) > 1 for w in widths):
        raise ModelFileError(
            f"'{source}' has a covariance with rows of different lengths: estimate the model again."
        )
    try:
        s = data["structure"]
        terms = tuple(
            Term(
                str(t["name"]),
                str(t["state"]),
                tuple(Factor.read(str(f)) for f in t["factors"]),
            )
            for t in s["terms"]
        )
        structure = Structure(
            str(s["name"]),
            terms,
            tuple(s["states"]),
            tuple(s["inputs"]),
            s["disturbance"],
            bool(s["increment"]),
            str(s.get("reference", "")),
        )
        theta = np.array(data["theta"], float)
        covariance = np.array(data["covariance"], float)
        if theta.shape != (len(terms),) or covariance.shape != (len(terms), len(terms)):
            raise ModelFileError(
                f"'{source}' has {so_many(len(terms), 'term')} but "
                f"{so_many(theta.size, 'parameter')}: "
                f"estimate the model again."
            )
        if s["disturbance"] not in get_args(DisturbanceKind):
            raise ModelFileError(
                f"'{source}' has the disturbance '{s['disturbance']}', which is not known: "
                f"estimate the model again."
            )
        if not 0 < float(data["sample_time"]) < float("inf"):
            raise ModelFileError(
                f"'{source}' has the sample time {data['sample_time']}, it must be positive."
            )
        if not np.isfinite(theta).all():
            raise ModelFileError(f"'{source}' holds a parameter that is not a finite number.")
        means = len(data["disturbances"])
        shared = np.array(data["disturbance_covariance"], float)
        if not np.isfinite(shared).all():
            shared = np.zeros_like(shared)
        if shared.size and shared.shape != (len(terms) + means, means):
            raise ModelFileError(
                f"'{source}' has {len(terms)} parameters and {means} disturbances, but a "
                f"covariance between them of shape {shared.shape}: estimate the model again."
            )
        list(structure.regressors(air_measured=False))
        return ManoeuvringModel(
            structure=structure,
            theta=theta,
            # of which a part is not known there is none: zeros beside others would be exact
            covariance=covariance if np.isfinite(covariance).all() else np.zeros_like(covariance),
            sample_time=float(data["sample_time"]),
            vessel=vessel_from_dict(data["vessel"]),
            integrator=data["integrator"],
            disturbances={
                k: (float(v["value"]), float(v["std"] or 0.0))
                for k, v in data["disturbances"].items()
            },
            disturbance_covariance=shared if shared.size else np.zeros((0, 0)),
            residual_std=np.array(list(data["residual_std"].values()), float),
            noise=(noise_from_dict(data["noise"], structure.states) if data["noise"] else None),
            sums={k: tuple(v) for k, v in data["sums"].items()},
            record={k: v for k, v in data.items() if k not in _CORE},
            changes=_changes(data.get("changes", []), structure.parameters, source),
            conditions=validity_from_dict(data.get("conditions", {})),
            calibration=(
                calibration_from_dict(data["calibration"], structure.states)
                if data.get("calibration")
                else None
            ),
        )
    except ModelFileError:
        raise
    except GreyboxError as error:
        raise ModelFileError(
            f"'{source}' is a damaged model file ({str(error).rstrip('.')}): estimate the model "
            f"again."
        ) from error
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise ModelFileError(
            f"'{source}' is a damaged model file, whose entries do not fit each other: estimate "
            f"the model again."
        ) from error


def _changes(rows: Any, names: tuple[str, ...], source: str) -> tuple[Change, ...]:
    found = []
    for row in rows if isinstance(rows, list) else [rows]:
        if not isinstance(row, dict) or row.keys() != {"parameter", "factor", "time"}:
            raise ModelFileError(
                f"'{source}' has the change {row!r}, where parameter, factor and time [s] are "
                f"needed: write them."
            )
        name = row["parameter"]
        if name not in names:
            raise ModelFileError(
                f"'{source}' has a change of '{name}', which is no parameter of the model."
                f"{suggestion(str(name), names)} It has: {', '.join(names)}."
            )
        for key in ("factor", "time"):
            value = row[key]
            if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
                raise ModelFileError(
                    f"'{source}' has a change of {name} with the {key} {value!r}, a finite number "
                    f"is needed: correct it."
                )
        found.append(Change(name, float(row["factor"]), float(row["time"])))
    return tuple(found)


def load_model(path: str | Path) -> ManoeuvringModel:
    """Read a model file.

    Parameters
    ----------
    path : str or Path
        JSON, as `ManoeuvringModel.save` and ``greybox estimate --out`` write it.

    Returns
    -------
    ManoeuvringModel

    Raises
    ------
    ModelFileError
        The file is missing, no JSON, or no model.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ModelFileError(
                f"'{path.name}' has {path.stat().st_size / 1e6:.0f} MB, and no model file has more "
                f"than {_MAX_BYTES / 1e6:.0f} MB: is it a log?"
            )
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelFileError(
            f"cannot read '{path}': {error.strerror}.{nearest_file(path)} Name a file that "
            f"'greybox estimate … --out' wrote."
        ) from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ModelFileError(
            f"'{path.name}' is not a model file, which is JSON: name the file that "
            f"'greybox estimate … --out' wrote."
        ) from error
    model = model_from_dict(data, path.name)
    _log.info(
        "read model %s: structure %s, %d parameters, sample time %g s", path, model.structure.name,
        len(model.names), model.sample_time,
    )  # fmt: skip
    return model
