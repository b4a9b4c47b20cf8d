"""One term of a structure: a parameter times a product of signals and moduli.

A term is data, not code: it can be written to a model file and read back
without evaluating anything. Its regressor is a CasADi expression, so that every
derivative of the model follows by differentiation.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite

import casadi as ca

from greybox.errors import StructureError, suggestion

# velocity through the air -> the state it would be in still air
_AIR = {"uq": "u", "vq": "v"}
# velocity of the water, in body axes
_WATER = {"uc", "vc"}
# signals that change their sign when port and starboard change places
_TURNED = {"v", "r", "vq", "vc", "tauy", "taun", "race", "rudder"}
# equation letter of SNAME -> state whose increment the equation gives
EQUATIONS = {"X": "u", "Y": "v", "N": "r"}

# signals that a term may name, with the exponents of metre, second and the unit of force
# (angles are pure numbers); longest first so that greedy reading is unambiguous
_UNITS = {
    "rudder_drag": (0, 0, 0),
    "race_drag": (0, 0, 1),
    "rudder": (0, 0, 0),
    "race": (0, 0, 1),
    "taux": (0, 0, 1),
    "tauy": (0, 0, 1),
    "taun": (1, 0, 1),
    "uq": (1, -1, 0),
    "vq": (1, -1, 0),
    "uc": (1, -1, 0),
    "vc": (1, -1, 0),
    "u": (1, -1, 0),
    "v": (1, -1, 0),
    "r": (0, -1, 0),
}
SIGNALS = tuple(_UNITS)
# characters of a damaged factor that a message repeats
_LONGEST = 40
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_BUMP = re.compile(rf"bump\(([A-Za-z_]\w*),({_NUMBER}),({_NUMBER})(?:,({_NUMBER}))?\)", re.ASCII)


@dataclass(frozen=True)
class Factor:
    """One signal, its modulus, or a bump of it, in a product.

    Parameters
    ----------
    signal : str
    modulus : bool
        Its modulus instead.
    centre, width, flat : float, optional
        The bump max(0, 1 − (d/width)²)² instead, with d = max(0, |s − centre| − flat) and one
        continuous derivative: one up to `flat` from the centre, and zero from `flat` + `width`
        on; in the unit of the signal.

    Raises
    ------
    StructureError
        The width of a bump is not positive, the flat part is negative, or a number is not finite.

    References
    ----------
    Wendland (1995), on kernels that vanish beyond a distance.
    """

    signal: str
    modulus: bool = False
    centre: float = 0.0
    width: float | None = None
    flat: float = 0.0

    def __post_init__(self) -> None:
        if self.width is None:
            return
        numbers = (self.centre, self.width, self.flat)
        if not (all(map(isfinite, numbers)) and self.width > 0 and self.flat >= 0):
            raise StructureError(
                f"a bump of {self.signal} has the centre {self.centre:g}, the width "
                f"{self.width:g} and a flat part of {self.flat:g}: all must be finite, the width "
                f"positive and the flat part not negative."
            )

    @classmethod
    def read(cls, text: str) -> Factor:
        """Return the factor that a model file writes as ``u``, ``|u|`` or ``bump(u,0.4,0.3)``.

        Raises
        ------
        StructureError
            It begins as a bump and is none.
        """
        if not text.startswith("bump("):
            return cls(text.strip("|"), text.startswith("|"))
        match = _BUMP.fullmatch(text)
        if match is None:
            raise StructureError(
                f"the factor '{text[:_LONGEST]}' is no bump: bump(SIGNAL,CENTRE,WIDTH) or "
                f"bump(SIGNAL,CENTRE,WIDTH,FLAT) with numbers is needed."
            )
        signal, *numbers = match.groups()
        centre, width, flat = (float(n or 0.0) for n in numbers)
        return cls(signal, centre=centre, width=width, flat=flat)

    @property
    def bump(self) -> bool:
        """Whether it is a bump: a pure number between 0 and 1."""
        return self.width is not None

    def of(self, value: ca.SX) -> ca.SX:
        """Return the factor of the signal's value."""
        if self.width is not None:
            away = value - self.centre
            if self.flat:
                away = ca.fmax(0, ca.fabs(away) - self.flat)
            return ca.fmax(0, 1 - (away / self.width) ** 2) ** 2
        return ca.fabs(value) if self.modulus else value

    def __str__(self) -> str:
        if self.width is not None:
            # digits enough to read the same numbers back
            numbers = (self.centre, self.width, *((self.flat,) if self.flat else ()))
            return f"bump({','.join([self.signal, *(repr(float(n)) for n in numbers)])})"
        return f"|{self.signal}|" if self.modulus else self.signal


@dataclass(frozen=True)
class Term:
    """A parameter times a product of factors, added to one equation.

    Parameters
    ----------
    name : str
        Name of the parameter, unique in a structure.
    state : str
        State whose one-step increment the term enters.
    factors : tuple of Factor
        The regressor is their product.
    """

    name: str
    state: str
    factors: tuple[Factor, ...]

    def expression(self, signals: Mapping[str, ca.SX]) -> ca.SX:
        """Return the regressor as a symbolic expression of `signals`.

        Raises
        ------
        StructureError
            A factor is not among `signals`.
        """
        product = ca.SX(1)
        for factor in self.factors:
            if factor.signal not in signals:
                raise StructureError(
                    f"term {self.name} uses the signal '{factor.signal}', which this structure "
                    f"does not have.{suggestion(factor.signal, signals)} "
                    f"It has: {', '.join(signals)}."
                )
            product = product * factor.of(signals[factor.signal])
        return product

    @property
    def local(self) -> bool:
        """Whether it is zero outside a range of some signal, as with a bump among its factors."""
        return any(f.bump for f in self.factors)

    @property
    def estimable(self) -> bool:
        """Whether a regression can find its coefficient.

        None can where it has a bump, one of many that only together mean something, or is zero
        without a current.
        """
        return not self.local and not self.of_water

    @property
    def of_water(self) -> bool:
        """Whether it has the water's own velocity among its factors: zero without a current."""
        return any(f.signal in _WATER for f in self.factors)

    @property
    def of_air(self) -> bool:
        """Whether it has the velocity through the air among its factors."""
        return any(f.signal in _AIR for f in self.factors)

    @property
    def of_thrust(self) -> int:
        """How many of its factors are in proportion to the thrust; a rudder's angle is none."""
        return sum(_UNITS[f.signal][2] for f in self.factors if f.signal in _UNITS)

    @property
    def key(self) -> tuple[str, tuple[tuple[str, bool, float, float, float], ...]]:
        """Equation and factors without order: equal for terms that are the same function."""
        return self.state, tuple(
            sorted((f.signal, f.modulus, f.centre, f.width or 0.0, f.flat) for f in self.factors)
        )

    @property
    def even(self) -> bool:
        """Whether the regressor stays the same when port and starboard change places."""
        turned = [f for f in self.factors if not f.modulus and f.signal in _TURNED]
        if any(f.bump and f.centre != 0 for f in turned):
            return False
        return sum(not f.bump for f in turned) % 2 == 0

    @property
    def dissipates(self) -> bool:
        """Whether a negative parameter takes energy out: state times regressor is never negative.

        Velocities through the air count as those over ground, as in still air.
        """
        powers: dict[str, int] = {}
        for factor in self.factors:
            # neither a modulus nor a bump is ever negative
            if not factor.modulus and not factor.bump:
                signal = _AIR.get(factor.signal, factor.signal)
                powers[signal] = powers.get(signal, 0) + 1
        powers[self.state] = powers.get(self.state, 0) + 1
        own = powers.pop(self.state)
        return own > 1 and own % 2 == 0 and all(v % 2 == 0 for v in powers.values())

    def __str__(self) -> str:
        return "·".join([self.name, *map(str, self.factors)])


def mirror_sign(signal: str) -> int:
    """Return the sign that a signal has when port and starboard change places."""
    return -1 if signal in _TURNED else 1


def _term(name: str, equation: str, *factors: str) -> Term:
    return Term(
        name,
        EQUATIONS.get(equation, equation),
        tuple(Factor(f.strip("|"), f.startswith("|")) for f in factors),
    )


# the terms of (3.51), by the names that the thesis gives their parameters (3.55)
THESIS_TERMS: dict[str, Term] = {
    t.name: t
    for t in (
        _term("Xu", "X", "u"),
        _term("Xvr", "X", "v", "r"),
        _term("Xuu", "X", "|u|", "u"),
        _term("Wuu", "X", "|uq|", "uq"),
        _term("Xmu", "X", "taux"),
        _term("Xkappa", "X", "u", "taux"),
        _term("Yv", "Y", "v"),
        _term("Yur", "Y", "u", "r"),
        _term("Yvv", "Y", "|v|", "v"),
        _term("Yvr", "Y", "|v|", "r"),
        _term("Wvv", "Y", "|vq|", "vq"),
        _term("Ymu", "Y", "tauy"),
        _term("Nr", "N", "r"),
        _term("Nuv", "N", "u", "v"),
        _term("Nvv", "N", "|v|", "v"),
        _term("Nvr", "N", "|v|", "r"),
        _term("Wuv", "N", "uq", "vq"),
        _term("Nmu", "N", "taun"),
    )
}
_BY_KEY = {t.key: t for t in THESIS_TERMS.values()}
_TOKEN = re.compile(
    r"\|(?P<modulus>" + "|".join(SIGNALS) + r")\||(?P<plain>" + "|".join(SIGNALS) + r")|[*.]"
)


def parse_term(name: str) -> Term:
    """Return the term that `name` spells.

    A name of (3.55) such as ``Xvr`` or ``Nmu`` gives that term. Any other is
    spelled by equation and factors: ``N_|r|r``, ``Y_|r|v``, ``X_uuu``,
    ``Y_race``, ``Y_u*race``; ``X_0`` is a constant force. A spelling that
    equals a term of (3.55) gets its name there (``X_|u|u`` is ``Xuu``).

    Raises
    ------
    StructureError
        The name is neither; the nearest known name is suggested.
    """
    if name in THESIS_TERMS:
        return THESIS_TERMS[name]
    equation, separator, body = name.partition("_")
    if not separator or equation not in EQUATIONS or not body:
        raise StructureError(
            f"'{name}' is not a term.{suggestion(name, THESIS_TERMS)} Use a name of (3.55) or "
            f"spell it by equation and factors, such as N_|r|r or X_uuu."
        )
    if body == "0":
        return Term(name, EQUATIONS[equation], ())
    factors: list[Factor] = []
    position = 0
    while position < len(body):
        match = _TOKEN.match(body, position)
        if match is None:
            raise StructureError(
                f"term '{name}' cannot be read at '{body[position:]}'."
                f"{suggestion(body[position:], SIGNALS)} Factors are "
                f"{', '.join(reversed(SIGNALS))}, in bars for the modulus."
            )
        signal = match["modulus"] or match["plain"]
        if signal:
            factors.append(Factor(signal, bool(match["modulus"])))
        position = match.end()
    term = Term(name, EQUATIONS[equation], tuple(factors))
    return _BY_KEY.get(term.key, term)


def parameter_unit(term: Term, force_unit: str = "n") -> str:
    """Return the unit of a discrete parameter, such as ``s/m`` for ``Xuu``.

    Parameters
    ----------
    term : Term
    force_unit : str
        Unit of the thrust law: ``N``, or ``n`` and ``n²`` where the force is
        kept in units of propeller speed.
    """
    if term.state not in _UNITS or any(f.signal not in _UNITS for f in term.factors):
        return "1"
    total = Counter(dict(enumerate(_UNITS[term.state])))
    for factor in term.factors:
        for i, power in enumerate(_UNITS[factor.signal]):
            total[i] -= 0 if factor.bump else power
    up, down = [], []
    for i, symbol in enumerate(("m", "s", force_unit)):
        power = abs(total[i])
        text = symbol if power == 1 else f"{symbol}^{power}"
        if total[i] > 0:
            up.append(text)
        elif total[i] < 0:
            down.append(text)
    if not up and not down:
        return "1"
    under = down[0] if len(down) == 1 else f"({' '.join(down)})"
    return (" ".join(up) or "1") + (f"/{under}" if down else "")
