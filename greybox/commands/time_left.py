"""How long a command still takes, by the shares of its time that its stages usually take."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

# words with which a command tells that a stage begins, and the share of its time, in any unit
Stage = tuple[str, float]
# seconds, and share of what is to do, before which nothing can be told of the rest
_SURE, _LEAST = 2.0, 0.03


class TimeLeft:
    """The seconds that a command still needs, from what it tells of itself.

    What is left is the time so far times the shares of the stages to come over those that are
    done. A stage that is told by count, 2 of 7 logs, is done in part.

    Parameters
    ----------
    stages : sequence of (str, float)
        In their order; the words "" begin with whatever is told first. One that never comes
        counts until a later one has begun.
    clock : callable
        Seconds.
    """

    def __init__(
        self, stages: Sequence[Stage] = (), clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._stages = list(stages)
        self._clock = clock
        self._made = self._began = self._since = clock()
        self._at, self._over, self._part = -1, 0.0, 0.0
        self._heard = False

    def tell(self, text: str, done: int = 0, total: int | None = None) -> None:
        """Take note of what is done now, and of some steps how many are done."""
        now = self._clock()
        if not self._heard and not done:
            # to start up takes no longer where there is more to do
            self._began = self._since = now
        self._heard = True
        later = enumerate(self._stages[self._at + 1 :], self._at + 1)
        found = next((k for k, (words, _) in later if words in text), None)
        if found is not None:
            self._over += self._stages[self._at][1] if self._at >= 0 else 0.0
            self._at, self._since, self._part = found, now, 0.0
        elif total and (self._at < 0 or self._stages[self._at][0] not in text):
            # steps that are no known stage tell of themselves alone
            self._stages = [(text.partition(":")[0], 1.0)]
            self._made = self._began = self._since
            self._at, self._over = 0, 0.0
        if total:
            self._part, self._since = done / total, now

    def seconds(self) -> float | None:
        """Return the seconds that are left, None where nothing tells yet."""
        share = self._stages[self._at][1] if self._at >= 0 else 0.0
        over = self._over + share * self._part
        now, rest = self._clock(), share * (1 - self._part)
        later = sum(s for _, s in self._stages[self._at + 1 :])
        # what is counted tells from its first step on
        little = not self._part and over < _LEAST * (over + rest + later)
        if not over or little or now - self._made < _SURE:
            return None
        pace = (self._since - self._began) / over
        # what takes longer than usual lets expect the same of the stages to come
        slower = max(pace, (now - self._began) / (over + rest))
        return max(pace * (rest + later) - (now - self._since), slower * later)

    def share(self) -> float | None:
        """Return which part of its time a command has used, None where nothing tells yet."""
        left, used = self.seconds(), self._clock() - self._made
        return None if left is None or not left + used else used / (left + used)


def in_words(seconds: float) -> str:
    """Return a time that is left, as coarse as it is known."""
    if seconds < 10:
        return "a few seconds left"
    if seconds < 90:
        return f"about {5 * round(seconds / 5)} s left"
    if seconds < 5400:
        return f"about {round(seconds / 60)} min left"
    return f"about {seconds / 3600:.1f} h left"
