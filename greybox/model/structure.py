"""A structure: which terms stand in which equation, as one symbolic expression.

f(x, psi, tau, d, air, theta) is the one-step increment of the states with the
sampling time absorbed in the parameters (3.51). Everything else in the package
is a derivative or an evaluation of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import casadi as ca

from greybox.errors import StructureError, so_many, suggestion
from greybox.model.disturbances import SHOWN, DisturbanceKind, disturbance_names, disturbed_signals
from greybox.model.terms import SIGNALS, Term, parse_term
from greybox.notebook import DisplayMixin, items, text


@dataclass(frozen=True)
class Symbols:
    """The symbols of f, each a column vector.

    ``x`` (nx,) states [m/s, rad/s]; ``psi`` heading [rad]; ``tau`` (nu,)
    generalised inputs; ``d`` (nd,) disturbance means [m/s]; ``air`` (2,)
    measured velocity through the air [m/s]; ``theta`` (p,) parameters.
    """

    x: ca.SX
    psi: ca.SX
    tau: ca.SX
    d: ca.SX
    air: ca.SX
    theta: ca.SX


@cache
def _symbols(*names: tuple[str, ...]) -> Symbols:
    """Return the same symbols for equal structures, as long as expressions of them are kept."""
    states, inputs, disturbances, parameters = (
        ca.vertcat(*[ca.SX.sym(n) for n in group]) for group in names
    )
    air = ca.vertcat(ca.SX.sym("u_q"), ca.SX.sym("v_q"))
    return Symbols(states, ca.SX.sym("psi"), inputs, disturbances, air, parameters)


@dataclass(frozen=True, repr=False)
class Structure(DisplayMixin):
    """A set of terms over named states, inputs and disturbances.

    Parameters
    ----------
    name : str
        Name by which commands and model files know the structure.
    terms : tuple of Term
        In the order of the parameter vector.
    states : tuple of str
        One equation each.
    inputs : tuple of str
        Generalised inputs that terms may use.
    disturbance : {"marine", "additive", "none"}
        How disturbance means enter the signals.
    increment : bool
        True: the terms give x(k+1) − x(k), as (3.51). False: x(k+1), as (4.58).
    reference : str
        Where the structure was published.
    """

    name: str
    terms: tuple[Term, ...]
    states: tuple[str, ...] = ("u", "v", "r")
    inputs: tuple[str, ...] = ("taux", "tauy", "taun")
    disturbance: DisturbanceKind = "marine"
    increment: bool = True
    reference: str = ""

    def __post_init__(self) -> None:
        names = [term.name for term in self.terms]
        doubled = sorted({n for n in names if names.count(n) > 1})
        if doubled:
            raise StructureError(
                f"structure '{self.name}' has {doubled[0]} {names.count(doubled[0])} times, "
                f"a parameter stands once: remove the others."
            )
        keys: dict[object, str] = {}
        for term in self.terms:
            if term.state not in self.states:
                raise StructureError(
                    f"term {term.name} belongs to the equation of '{term.state}', which "
                    f"structure '{self.name}' lacks: it has {', '.join(self.states)}."
                )
            if term.key in keys:
                raise StructureError(
                    f"terms {keys[term.key]} and {term.name} are the same function, so their "
                    f"parameters cannot be told apart: remove one."
                )
            keys[term.key] = term.name

    def __hash__(self) -> int:
        # every run looks up by it what was compiled: terms and their factors would take longer
        return hash((self.name, self.parameters, self.states))

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of ``theta``."""
        return tuple(term.name for term in self.terms)

    @property
    def marine(self) -> bool:
        """Whether the structure is of a ship, which current and wind push by its heading."""
        return self.disturbance == "marine"

    @property
    def turns(self) -> bool:
        """Whether its heading can be simulated: a ship's, with a yaw rate."""
        return self.marine and "r" in self.states

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of the disturbance means, in the order of ``d``."""
        return disturbance_names(self.disturbance, self.states)

    def index(self, name: str) -> int:
        """Return the position of a parameter.

        Raises
        ------
        StructureError
            There is no such parameter; the nearest is suggested.
        """
        if name not in self.parameters:
            raise StructureError(
                f"structure '{self.name}' has no parameter '{name}'."
                f"{suggestion(name, self.parameters)} It has: {', '.join(self.parameters)}."
            )
        return self.parameters.index(name)

    def with_terms(self, *names: str | Term) -> Structure:
        """Return the structure with more terms, each a `Term` or its spelling.

        Examples
        --------
        >>> from greybox.model.catalogue import get_structure
        >>> get_structure("thesis").with_terms("N_|r|r", "X_uuu").parameters[-2:]
        ('N_|r|r', 'X_uuu')
        """
        added = tuple(parse_term(n) if isinstance(n, str) else n for n in names)
        inputs = self.inputs
        for term in added:
            for factor in term.factors:
                known = factor.signal in (*self.states, *inputs, "uq", "vq", "uc", "vc")
                if not known and factor.signal in SIGNALS:
                    inputs = (*inputs, factor.signal)
        return replace(self, terms=self.terms + added, inputs=inputs)

    def without(self, *names: str) -> Structure:
        """Return the structure without the named terms."""
        drop = {self.parameters[self.index(n)] for n in names}
        return replace(self, terms=tuple(t for t in self.terms if t.name not in drop))

    def estimable(self) -> Structure:
        """Return the structure of the terms whose coefficients a regression can find."""
        return replace(self, terms=tuple(t for t in self.terms if t.estimable))

    @property
    def symbols(self) -> Symbols:
        """The symbols that every expression of this structure is written in."""
        return _symbols(self.states, self.inputs, self.disturbances, self.parameters)

    def regressors(self, *, air_measured: bool) -> list[ca.SX]:
        """Return ∂f/∂θ, one expression per term, in the order of the terms."""
        s = self.symbols
        signals = disturbed_signals(
            self.disturbance,
            {name: s.x[i] for i, name in enumerate(self.states)},
            s.psi,
            s.d,
            s.air if air_measured else None,
        )
        signals |= {name: s.tau[i] for i, name in enumerate(self.inputs)}
        return [term.expression(signals) for term in self.terms]

    def increment_expression(self, *, air_measured: bool) -> ca.SX:
        """Return f, (nx,): the sum of the terms in each equation (3.51)."""
        rows = [ca.SX(0)] * len(self.states)
        for i, regressor in enumerate(self.regressors(air_measured=air_measured)):
            row = self.states.index(self.terms[i].state)
            rows[row] = rows[row] + self.symbols.theta[i] * regressor
        return ca.vertcat(*rows)

    @property
    def uses_air(self) -> bool:
        """Whether some term sees the velocity through the air."""
        return any(term.of_air for term in self.terms)

    def summary(self) -> str:
        """Return name, equations and source as text."""
        source = [self.reference] if self.reference else []
        return "\n".join([self._line(), *self.equations(), *source])

    def _line(self) -> str:
        return (
            f"structure '{self.name}': {so_many(len(self.terms), 'term')} in the equations of "
            f"{', '.join(self.states)}"
        )

    def _parts(self) -> tuple[str, ...]:
        return items("Increment of a sample", self.equations()), text(self.reference)

    def equations(self) -> list[str]:
        """Return the equations as readable lines, such as ``u⁺ = u + Xu·u_r + …``.

        Terms with bumps are one function g of the signals that they see.
        """
        shown = SHOWN if self.marine else {}
        lines = []
        for state in self.states:
            terms = [
                "·".join(
                    [t.name]
                    + [
                        f"|{shown.get(f.signal, f.signal)}|"
                        if f.modulus
                        else shown.get(f.signal, f.signal)
                        for f in t.factors
                    ]
                )
                for t in self.terms
                if t.state == state and not t.local
            ]
            start = [state] if self.increment else []
            local = [t for t in self.terms if t.state == state and t.local]
            if local:
                of = dict.fromkeys(f.signal for t in local for f in t.factors)
                arguments = ", ".join(shown.get(n, n) for n in of)
                terms.append(f"g_{state}({arguments})  [{so_many(len(local), 'bump')}]")
            lines.append(f"{state}⁺ = " + " + ".join(start + terms))
        return lines
