"""Shares of trials."""

from __future__ import annotations

from math import sqrt

_Z = 1.959963984540054


def wilson_interval(share: float, trials: float) -> tuple[float, float]:
    """Return the 95 % interval of a probability.

    Parameters
    ----------
    share : float
        Of the trials that succeeded.
    trials : float
        Independent trials; a fraction where dependent ones are worth one.

    References
    ----------
    Wilson (1927).
    """
    if trials <= 0:
        return 0.0, 1.0
    middle = (share + _Z**2 / (2 * trials)) / (1 + _Z**2 / trials)
    spread = sqrt(share * (1 - share) / trials + _Z**2 / (4 * trials**2))
    half = _Z / (1 + _Z**2 / trials) * spread
    # rounding must not push a bound past the share itself
    return max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half))
