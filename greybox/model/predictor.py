"""One-step predictors: the regressors of the parameters and of the biases.

In a sign regime f is polynomial in the disturbance means d, so
f(x, d) = f(x, 0) + Σ dᵢ ∂f/∂dᵢ + ½ ΣΣ dᵢdⱼ ∂²f/∂dᵢ∂dⱼ + … exactly. The
bias-capturing regressors of chapter 5 are therefore the distinct functions
among ∂ⁿ⁺¹f/∂θ∂dⁿ at d = 0. They are derived here by differentiation for any
structure; equal and linearly dependent ones are merged by their values at
points of the regime, constants apart (zero-mean instruments remove those).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement
from math import factorial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from greybox.errors import StructureError, so_many
from greybox.model.disturbances import CURRENT, WIND
from greybox.model.predictor_kinds import PREDICTORS
from greybox.model.spelling import atoms, spelled_expression, spellings
from greybox.model.structure import Structure
from greybox.model.terms import Term
from greybox.notebook import DisplayMixin, table
from greybox.numerics.vectorised import Vectorised

Array = NDArray[np.float64]

# signs that each state takes in the data, such as {"u": (1,), "v": (1, -1)}
Regime = tuple[tuple[str, tuple[int, ...]], ...]

_SIGNS = {(1,): "positive only", (-1,): "negative only", (1, -1): "of both signs"}
_POINTS = 400
_TOLERANCE = 1e-8


@dataclass(frozen=True)
class Column:
    """One regressor of one equation.

    ``terms`` are the parameters whose sum is its coefficient (empty for a
    bias-capturing regressor); ``name`` is the first of them, or the function.
    """

    name: str
    state: str
    terms: tuple[str, ...]

    @property
    def is_bias(self) -> bool:
        """Whether the column only captures a bias."""
        return not self.terms

    @property
    def label(self) -> str:
        """Name with the merged terms, such as ``Xuu+Wuu``."""
        return "+".join(self.terms) or self.name


@dataclass(frozen=True)
class BiasShare:
    """How one derivative of f spreads over the columns of its equation.

    The coefficient of column j holds ``weight · θ[term] · Π d[monomial] · shares[j]``.
    """

    state: str
    term: str
    monomial: tuple[int, ...]
    weight: float
    shares: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class Predictor(DisplayMixin):
    """The regressors of every equation in order, and how they were derived.

    Parameters
    ----------
    structure : Structure
        The structure whose derivatives the regressors are.
    kind : {"basic", "augmented", "wind", "basic+wind"}
        (6.3); (5.61, 5.70, 5.85); (5.64, 5.75, 5.88); (7.4-7.6).
    regime : Regime
        Signs of the states over which regressors were merged.
    columns : tuple of Column
        All equations after one another, each with its parameters first.
    biases : tuple of BiasShare
        From which the disturbance means follow (5.30), (5.63).
    """

    structure: Structure
    kind: str
    regime: Regime
    columns: tuple[Column, ...]
    biases: tuple[BiasShare, ...]
    _spelled: tuple[str, ...]

    @property
    def air_measured(self) -> bool:
        """Whether the velocity through the air is a measured regressor."""
        return PREDICTORS[self.kind].air_measured

    @property
    def augmented(self) -> bool:
        """Whether bias-capturing regressors are included."""
        return any(c.is_bias for c in self.columns)

    def summary(self) -> str:
        """Return the regressors of each equation as text."""
        return "\n".join([self._line(), *(f"{s}⁺: {', '.join(n)}" for s, n in self._spelt())])

    def _line(self) -> str:
        signs = ", ".join(f"{s} {_SIGNS.get(v, v)}" for s, v in self.regime)
        where = f", {signs}" if signs else ""
        return (
            f"predictor '{self.kind}' of structure '{self.structure.name}': "
            f"{so_many(len(self.columns), 'regressor')}, {len(self.parameter_columns)} of them "
            f"of parameters{where}"
        )

    def _parts(self) -> tuple[str, ...]:
        return (table(("equation", "regressors"), [(s, ", ".join(n)) for s, n in self._spelt()]),)

    def _spelt(self) -> list[tuple[str, list[str]]]:
        return [
            (s, [self.columns[i].label for i in self.equation(s)]) for s in self.structure.states
        ]

    def equation(self, state: str) -> list[int]:
        """Return the positions of the columns of one equation."""
        return [i for i, c in enumerate(self.columns) if c.state == state]

    @property
    def constants(self) -> list[int]:
        """Positions of the columns that never vary."""
        structure = self.structure
        return [
            i
            for i, c in enumerate(self.columns)
            if c.name == "1"
            or (c.terms and not structure.terms[structure.index(c.terms[0])].factors)
        ]

    @property
    def parameter_columns(self) -> list[int]:
        """Positions of the columns that carry parameters of the structure."""
        return [i for i, c in enumerate(self.columns) if not c.is_bias]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters that the predictor estimates."""
        return tuple(c.name for c in self.columns if not c.is_bias)

    def without_bias(self, column: int) -> Predictor:
        """Return the predictor without one bias-capturing column."""
        state = self.columns[column].state
        position = self.equation(state).index(column)
        shares = tuple(
            replace(b, shares=b.shares[:position] + b.shares[position + 1 :])
            if b.state == state
            else b
            for b in self.biases
        )
        return Predictor(
            self.structure,
            self.kind,
            self.regime,
            self.columns[:column] + self.columns[column + 1 :],
            shares,
            self._spelled[:column] + self._spelled[column + 1 :],
        )

    def with_terms(self, structure: Structure, terms: Sequence[Term]) -> Predictor:
        """Return the predictor of a larger structure, each further term a column of its own.

        Parameters
        ----------
        structure : Structure
            This predictor's with the terms.
        terms : sequence of Term
        """
        columns, spelled, biases = list(self.columns), list(self._spelled), list(self.biases)
        for term in terms:
            mine = [i for i, c in enumerate(columns) if c.state == term.state]
            position = sum(not columns[i].is_bias for i in mine)
            columns.insert(mine[0] + position, Column(term.name, term.state, (term.name,)))
            spelled.insert(mine[0] + position, "")
            biases = [
                replace(b, shares=(*b.shares[:position], 0.0, *b.shares[position:]))
                if b.state == term.state
                else b
                for b in biases
            ]
        return replace(
            self,
            structure=structure,
            columns=tuple(columns),
            biases=tuple(biases),
            _spelled=tuple(spelled),
        )

    @property
    def contaminated(self) -> tuple[str, ...]:
        """Parameters whose own regressor also carries a disturbance moment.

        Their estimates stay biased by it, whatever the amount of data.
        """
        found = []
        for b in self.biases:
            columns = [self.columns[i] for i in self.equation(b.state)]
            for column, share in zip(columns, b.shares, strict=True):
                if column.terms and abs(share) > 1e-6 and column.name not in found:
                    found.append(column.name)
        return tuple(found)

    @cached_property
    def expressions(self) -> list[ca.SX]:
        """The regressors as expressions of the structure's symbols at d = 0."""
        return _column_expressions(self.structure, self.air_measured, self.columns, self._spelled)

    def increment_expression(self, coefficients: ca.SX) -> ca.SX:
        """Return what a sample adds to the states (nx,), as `Structure.increment_expression`.

        Terms see the disturbance means; biases stand for what the means do not tell, of a
        wind that is not measured all.

        Parameters
        ----------
        coefficients : SX
            (p,) of all columns.
        """
        structure = self.structure
        d, names = structure.symbols.d, structure.disturbances
        unknown = [] if self.air_measured else [d[names.index(n)] for n in WIND if n in names]
        regressors = structure.regressors(air_measured=self.air_measured)
        rows = [ca.SX(0)] * len(structure.states)
        for i, column in enumerate(self.columns):
            regressor = self.expressions[i]
            if column.terms:
                regressor = regressors[structure.index(column.terms[0])]
            if unknown:
                regressor = ca.substitute(
                    regressor, ca.vertcat(*unknown), ca.SX.zeros(len(unknown))
                )
            rows[structure.states.index(column.state)] += coefficients[i] * regressor
        return ca.vertcat(*rows)

    @cached_property
    def _program(self) -> Vectorised:
        s = self.structure.symbols
        scalars = [*ca.vertsplit(s.x), s.psi, *ca.vertsplit(s.tau), *ca.vertsplit(s.air)]
        return Vectorised(self.expressions, scalars)

    def __getstate__(self) -> dict[str, object]:
        """Drop what belongs to one process when pickled."""
        return {k: v for k, v in self.__dict__.items() if k not in ("expressions", "_program")}

    def evaluate(
        self,
        x: list[Array],
        psi: Array | float,
        tau: list[Array],
        air: tuple[Array, Array] | None = None,
        out: Array | None = None,
    ) -> Array:
        """Return the regressors at many samples.

        Parameters
        ----------
        x : list of ndarray
            One array of shape S a state [m/s, rad/s].
        psi : ndarray
            Shape S, heading [rad].
        tau : list of ndarray
            One array of shape S a generalised input.
        air : pair of ndarray, optional
            Shape S each, velocity through the air [m/s]; needed when `air_measured`.
        out : ndarray, optional
            (p, *S) array to fill.

        Returns
        -------
        ndarray
            (p, *S), in the order of `columns`.

        Raises
        ------
        StructureError
            The velocity through the air is needed and was not given.
        """
        if self.air_measured and air is None:
            raise StructureError(
                f"predictor '{self.kind}' needs the measured velocity through the air "
                f"(u_q, v_q), and none was given: use 'augmented' or 'basic'."
            )
        if out is None:
            out = np.empty((len(self.columns), *np.shape(x[0])))
        return self._program(self._arguments(x, psi, tau, air), out)

    def _arguments(
        self,
        x: list[Array],
        psi: Array | float,
        tau: list[Array],
        air: tuple[Array, Array] | None,
    ) -> list[Array | float]:
        return [*x, psi, *tau, *(air if air is not None else (0.0, 0.0))]

    def prepare(
        self,
        psi: Array | float,
        tau: list[Array],
        air: tuple[Array, Array] | None,
    ) -> dict[int, Array | float]:
        """Evaluate once what does not depend on the states, for `evaluate_prepared`."""
        states = len(self.structure.states)
        known = self._arguments([], psi, tau, air)
        return self._program.prepare({states + i: a for i, a in enumerate(known)})

    def evaluate_prepared(
        self, x: list[Array], prepared: dict[int, Array | float], out: Array
    ) -> Array:
        """Fill `out` (p, *S) with the regressors at states `x`, the rest being prepared."""
        rest = len(self.structure.inputs) + 3
        return self._program([*x, *[0.0] * rest], out, prepared)


def _sample_points(structure: Structure, regime: Regime, seed: int) -> list[Array]:
    """Return arrays for x, psi, tau and air at random points of the regime."""
    rng = np.random.default_rng(seed)
    signs = dict(regime)
    unknown = set(signs) - set(structure.states)
    if unknown:
        raise StructureError(f"the regime names {sorted(unknown)}, which are no states")
    points = []
    for state in structure.states:
        sign = rng.choice(signs.get(state, (1, -1)), _POINTS)
        points.append(sign * rng.uniform(0.3, 2.0, _POINTS))
    points.append(rng.uniform(-np.pi, np.pi, _POINTS))
    points += [rng.uniform(-2, 2, _POINTS) for _ in structure.inputs]
    return points + [rng.uniform(-2, 2, _POINTS) for _ in range(2)]


class _Span:
    """Columns chosen so far, with the constant, as an orthonormal basis at the points."""

    def __init__(self, size: int) -> None:
        self.values: list[Array] = [np.ones(size)]
        self._basis: list[Array] = [np.ones(size) / np.sqrt(size)]

    def residual(self, values: Array) -> Array:
        """Return what of each row lies outside the span, zero where nothing does."""
        basis = np.array(self._basis)
        rest = np.array(values, dtype=float)
        for _ in range(2):
            rest -= (rest @ basis.T) @ basis
        small = np.linalg.norm(rest, axis=-1) <= _TOLERANCE * np.linalg.norm(values, axis=-1)
        rest[small] = 0.0
        return rest

    def add_if_new(self, value: Array) -> bool:
        residual = self.residual(value[None])[0]
        norm = np.linalg.norm(residual)
        if norm == 0.0:
            return False
        self._basis.append(residual / norm)
        self.values.append(value)
        return True


@lru_cache(maxsize=64)
def _derivatives(
    structure: Structure, air_measured: bool, only: tuple[str, ...] | None
) -> list[tuple[int, tuple[int, ...], ca.SX]]:
    """Return (term, monomial in d, ∂ⁿ⁺¹f/∂θ∂dⁿ at d = 0) until the derivatives vanish."""
    s = structure.symbols
    names = structure.disturbances
    if structure.marine and air_measured:
        names = CURRENT
    if only is not None:
        names = tuple(n for n in names if n in only)
    wanted = [structure.disturbances.index(n) for n in names]
    zero = ca.SX.zeros(s.d.numel())
    found = []
    for t, regressor in enumerate(structure.regressors(air_measured=air_measured)):
        level: dict[tuple[int, ...], ca.SX] = {(): regressor}
        for order in range(1, 7):
            deeper: dict[tuple[int, ...], ca.SX] = {}
            for monomial in combinations_with_replacement(wanted, order):
                parent = level.get(monomial[:-1])
                if parent is None:
                    continue
                derivative = ca.jacobian(parent, s.d[monomial[-1]])
                if derivative.nnz():
                    deeper[monomial] = derivative
            for monomial, derivative in deeper.items():
                found.append((t, monomial, ca.substitute(derivative, s.d, zero)))
            level = deeper
            if not level:
                break
    return found


def _column_expressions(
    structure: Structure,
    air_measured: bool,
    columns: tuple[Column, ...],
    spelled: tuple[str, ...],
) -> list[ca.SX]:
    s = structure.symbols
    zero = ca.SX.zeros(s.d.numel())
    regressors = structure.regressors(air_measured=air_measured)
    by_name = {
        term.name: ca.substitute(r, s.d, zero) if s.d.numel() else r
        for term, r in zip(structure.terms, regressors, strict=True)
    }
    out = []
    for column, spelling in zip(columns, spelled, strict=True):
        if column.terms:
            out.append(by_name[column.terms[0]])
        elif spelling.startswith("d/"):
            out.append(_derivative_by_name(structure, air_measured, spelling))
        else:
            out.append(spelled_expression(structure, spelling))
    return out


def _derivative_by_name(structure: Structure, air_measured: bool, spelling: str) -> ca.SX:
    _, term, monomial = spelling.split("/")
    for t, m, e in _derivatives(structure, air_measured, None):
        if structure.terms[t].name == term and ",".join(map(str, m)) == monomial:
            return e
    raise StructureError(f"there is no derivative {spelling}")


def _unit_rows(values: Array) -> Array:
    size = np.maximum(np.linalg.norm(values, axis=1), 1e-300)
    return np.asarray(values / size[:, None])


def _same_direction(unit: Array, value: Array) -> int | None:
    """Return the first row of `unit` that equals `value` up to scale, if one does."""
    norm = float(np.linalg.norm(value))
    if norm == 0.0 or not len(unit):
        return None
    hits = np.flatnonzero(np.abs(unit @ value) > (1 - 1e-10) * norm)
    return int(hits[0]) if len(hits) else None


@lru_cache(maxsize=64)
def build_predictor(
    structure: Structure,
    kind: str = "augmented",
    regime: Regime | None = None,
    biases: tuple[str, ...] | None = None,
    disturbances: tuple[str, ...] | None = None,
    intercept: bool = False,
) -> Predictor:
    """Derive the regressors of a predictor from the structure.

    Parameters
    ----------
    structure : Structure
        Terms over states, inputs and disturbances.
    kind : {"basic", "augmented", "wind", "basic+wind"}
        ``basic`` neither measures nor models disturbances (6.3); ``augmented``
        captures current and wind (5.61), (5.70), (5.85); ``wind`` captures the
        current and measures the wind (5.64), (5.75), (5.88); ``basic+wind``
        measures the wind and captures nothing (7.4)-(7.6).
    regime : Regime, optional
        Signs that each state takes; by default both of each. In one sign of v
        |v| cos ψ and v cos ψ are the same function; across both they are two.
    biases : tuple of str, optional
        Spelled bias-capturing regressors, ``state:function``, in place of the
        derived ones, as (7.1)-(7.3) have them.
    disturbances : tuple of str, optional
        Only these means are unknown; by default all that are not measured.
    intercept : bool
        Add a constant to each equation. The derived regressors leave constants
        out, which only zero-mean instruments remove by themselves.

    Returns
    -------
    Predictor

    Raises
    ------
    StructureError
        The kind is unknown, or a spelled regressor cannot be read.

    References
    ----------
    Ljungberg (2020), sections 5.1.2 and 5.2.
    """
    asked = PREDICTORS[kind]
    if regime is None:
        regime = tuple((s, (1, -1)) for s in structure.states)
    air_measured = asked.air_measured
    points = _sample_points(structure, regime, seed=20)
    s = structure.symbols
    scalars = [*ca.vertsplit(s.x), s.psi, *ca.vertsplit(s.tau), *ca.vertsplit(s.air)]
    zero = ca.SX.zeros(s.d.numel())

    def values(expressions: list[ca.SX]) -> Array:
        at_zero = [ca.substitute(e, s.d, zero) if s.d.numel() else e for e in expressions]
        return Vectorised(at_zero, scalars)(points, np.empty((len(expressions), _POINTS)))

    own = values(structure.regressors(air_measured=air_measured))
    derived = (
        _derivatives(structure, air_measured, disturbances)
        if asked.captures and biases is None
        else []
    )
    derived_values = values([e for _, _, e in derived]) if derived else np.empty((0, _POINTS))
    names = spellings(structure) if derived else []
    known = atoms(structure)
    at_points = dict(zip(known, values(list(known.values())), strict=True))
    spelled_values = np.array(
        [np.prod([at_points[f] for f in n.split("*")], axis=0) for n in names]
    ).reshape(-1, _POINTS)
    unit = _unit_rows(spelled_values)

    columns: list[Column] = []
    spelled: list[str] = []
    shares: list[BiasShare] = []
    for state in structure.states:
        span = _Span(_POINTS)
        start = len(columns)
        for t, term in enumerate(structure.terms):
            if term.state != state:
                continue
            same = [
                i
                for i in range(start, len(columns))
                if np.allclose(own[structure.index(columns[i].terms[0])], own[t], rtol=1e-12)
            ]
            if same:
                merged = columns[same[0]]
                columns[same[0]] = Column(merged.name, state, (*merged.terms, term.name))
                continue
            if term.of_water:
                raise StructureError(
                    f"the regressor of {term.name} is zero where the water rests, so a regression "
                    f"cannot find its coefficient: fit free runs in a current (--method oe "
                    f"--predictor augmented), or leave it out of --structure."
                )
            if term.factors and not span.add_if_new(own[t]):
                kept = ", ".join(
                    f"{s} {_SIGNS.get(v, 'of both signs')}"
                    for s, v in regime
                    if s in structure.states
                )
                raise StructureError(
                    f"with {kept} the regressor of {term.name} is a combination of the others in "
                    f"its equation (Remark 4.1): use trials with both signs, or leave it out "
                    f"(--structure '{structure.name}-{term.name}')."
                )
            columns.append(Column(term.name, state, (term.name,)))
            spelled.append("")
        if len(columns) == start:
            raise StructureError(
                f"structure '{structure.name}' has no term in the {state} equation: add one "
                f"(+TERM), or use a structure without that state."
            )
        mine = [k for k, (t, _, _) in enumerate(derived) if structure.terms[t].state == state]
        # first derivatives before second ones, those with a plain name before the others
        named = {k: _same_direction(unit, derived_values[k]) for k in mine}
        mine.sort(key=lambda k: (len(derived[k][1]), named[k] is None))
        for k in mine:
            t, monomial, _ = derived[k]
            beyond = span.residual(derived_values[k][None])[0]
            if not beyond.any():
                continue
            plain = named[k]
            if plain is None:
                # a function that completes the same span under a plain name
                plain = _same_direction(_unit_rows(span.residual(spelled_values)), beyond)
            if plain is not None:
                name = code = names[plain]
                span.add_if_new(spelled_values[plain])
            else:
                means = [structure.disturbances[i] for i in monomial]
                name = f"∂{structure.terms[t].name}/" + "".join(f"∂{m}" for m in means)
                code = f"d/{structure.terms[t].name}/{','.join(map(str, monomial))}"
                span.add_if_new(derived_values[k])
            columns.append(Column(name, state, ()))
            spelled.append(code)
        for spelling in biases or ():
            owner, _, function = spelling.partition(":")
            if owner == state:
                columns.append(Column(function, state, ()))
                spelled.append(function)
        if intercept:
            columns.append(Column("1", state, ()))
            spelled.append("1")
        if mine:
            basis = np.array(span.values).T
            solution = np.linalg.lstsq(basis, derived_values[mine].T, rcond=None)[0][1:].T
            # a constant term is no column of the basis, which has the constant already
            for position, column in enumerate(columns[start:]):
                if column.terms and not structure.terms[structure.index(column.terms[0])].factors:
                    solution = np.insert(solution, position, 0.0, axis=1)
            for k, row in zip(mine, solution, strict=True):
                t, monomial, _ = derived[k]
                weight = 1.0
                for i in set(monomial):
                    weight /= factorial(monomial.count(i))
                clean = np.where(np.abs(row) < 1e-9, 0.0, row)
                clean = np.append(clean, np.zeros(len(columns) - start - len(clean)))
                shares.append(
                    BiasShare(state, structure.terms[t].name, monomial, weight, tuple(clean))
                )
    return Predictor(structure, kind, regime, tuple(columns), tuple(shares), tuple(spelled))
