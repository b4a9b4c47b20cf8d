"""One way in which a ship may differ from its model: a few numbers with a null value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from greybox.diagnosis.ship import Ship

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """A number of a cause.

    Parameters
    ----------
    name : str
        As in the JSON of a diagnosis.
    unit : str
    start : float
        Where its search begins, and its sensitivity is taken: off the null where
        it vanishes there.
    low, high : float
        Physical bounds.
    null : float
        The value that leaves the model as it is.
    coarse : float
        Standard error that sampling leaves at least.
    reach : float
        Distance within which its likelihood has several hills; 0 where it has one.
    step : float
        For its derivative by differences, and its scale.
    least : float
        Distance from the null below which sampling itself looks alike.
    over : float
        What is told is this over the number, where it is not 0: a rate of which the number is the
        time, so that no limit is at zero and not at infinity.
    """

    name: str
    unit: str
    start: float
    low: float = -np.inf
    high: float = np.inf
    null: float = 0.0
    step: float = 1e-4
    least: float = 0.0
    coarse: float = 0.0
    reach: float = 0.0
    over: float = 0.0

    def told(self, value: float, std: float) -> tuple[float, float]:
        """Return what is told of an estimate, and its standard error."""
        if not self.over:
            return value, std
        size = max(abs(value), self.step)
        return self.over / size, self.over / size * (std / size)


@dataclass(frozen=True)
class Hypothesis:
    """A cause with its place: which thruster, which coefficient, which channel.

    Parameters
    ----------
    cause : str
        Id of the cause.
    key : str
        Unique among all hypotheses, such as ``thruster_gain:n1``.
    parameters : tuple of Parameter
    columns : tuple of str
        Coefficients or currents that the parameters are, in their order; empty
        where `apply` is needed.
    apply : callable, optional
        ``(ship, values) -> ship``.
    starts : tuple of tuple of float
        Further values to begin from, where the likelihood has several hills.
    co_freed : tuple of str
        Coefficients that become free with the cause, because without it others imitate
        them.
    variants : tuple of Hypothesis
        The same with other conventions of sampling, of which the likeliest is kept.
    arguments : tuple of str
        Signals that its force, or one that looks like it, is a function of at the same moment,
        where it has an `apply`.
    parity : {0, 1, -1}
        Whether the force of a hypothesis with `arguments` keeps the ship's symmetry of port and
        starboard where its thruster does (1), breaks it (-1), or has parts of both (0).
    far : tuple of tuple of float
        Values so far off that other coefficients are likely there: those of least squares are a
        start at the likeliest.
    refit_from_scratch : bool
        Whether the coefficients must be sought anew: what it changes is too much for
        derivatives.
    multiplied : str
        Coefficient that its first number multiplies: what is tested is by how much that changes,
        which is known where it is told from another one less surely than its sum with that.
    place : str
        What of the vessel it is of alone, such as the column of one command, where no name of its
        parameters tells it.
    unit : str
        Of the number in its sentence, where that tells one; held, it has no parameters.
    only : bool
        Whether a ship has room for one hypothesis of this cause.
    past : bool
        Whether it changes how a force follows earlier commands, as no force of motion and present
        commands can.
    """

    cause: str
    key: str
    parameters: tuple[Parameter, ...]
    columns: tuple[str, ...] = ()
    apply: Callable[[Ship, Array], Ship] | None = None
    starts: tuple[tuple[float, ...], ...] = ()
    variants: tuple[Hypothesis, ...] = ()
    co_freed: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    parity: int = 0
    far: tuple[tuple[float, ...], ...] = ()
    refit_from_scratch: bool = False
    multiplied: str = ""
    place: str = ""
    unit: str = ""
    only: bool = False
    past: bool = False

    @property
    def id(self) -> str:
        """The cause's id, with the place where there is one, as results name it."""
        return f"{self.cause}:{self.place}" if self.place else self.cause

    def held_at(self, value: Array) -> Hypothesis:
        """Return the hypothesis in force with these values, none of them free."""
        apply = self.apply
        assert apply is not None
        return replace(
            self, parameters=(), apply=lambda ship, _: apply(ship, value), starts=(), variants=(),
            far=(), only=True,
        )  # fmt: skip

    @property
    def start(self) -> Array:
        """Values to begin from."""
        return np.array([p.start for p in self.parameters])
