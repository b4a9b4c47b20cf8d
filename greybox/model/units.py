"""Units of parameters, from the units of what they multiply."""

from __future__ import annotations

from collections import Counter

from greybox.model.terms import Term

# exponents of metre, second and the unit of force; angles are pure numbers
_SIGNAL = {
    "u": (1, -1, 0),
    "v": (1, -1, 0),
    "uq": (1, -1, 0),
    "vq": (1, -1, 0),
    "r": (0, -1, 0),
    "taux": (0, 0, 1),
    "tauy": (0, 0, 1),
    "taun": (1, 0, 1),
    "race": (0, 0, 1),
    "race_drag": (0, 0, 1),
    "rudder": (0, 0, 0),
    "rudder_drag": (0, 0, 0),
}


def parameter_unit(term: Term, force_unit: str = "n") -> str:
    """Return the unit of a discrete parameter, such as ``s/m`` for ``Xuu``.

    Parameters
    ----------
    term : Term
    force_unit : str
        Unit of the thrust law: ``N``, or ``n`` and ``n²`` where the force is
        kept in units of propeller speed.
    """
    if term.state not in _SIGNAL or any(f.signal not in _SIGNAL for f in term.factors):
        return "1"
    total = Counter(dict(enumerate(_SIGNAL[term.state])))
    for factor in term.factors:
        for i, power in enumerate(_SIGNAL[factor.signal]):
            total[i] -= power
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
