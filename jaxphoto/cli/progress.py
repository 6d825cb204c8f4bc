"""How far a command is and how long the rest takes, in its status."""

import time
from collections import deque
from collections.abc import Callable

from rich.console import Console
from rich.status import Status

# Before a hint is worth its line.
_LONG_S = 600.0
# The last steps, by which the rest is judged: those of a run that goes on from an earlier one begin fast.
_LAST = 20
FEWER_PAIRS = "--pairs similar:20, sequence:K or position:K compares fewer pairs"


class Pace:
    """How long the rest takes, by how long the last steps took."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._what = clock, ""
        self._steps: deque[tuple[float, int]] = deque(maxlen=_LAST)
        self._began = clock()

    def begins(self) -> None:
        """What comes next begins now, where other work lies between it and the steps before."""
        self._began = self._clock()

    def left(self, what: str, done: int, of: int) -> float:
        """Seconds until all `of` steps of `what` are done, of which `done` are."""
        now = self._clock()
        if what != self._what:
            self._what = what
            self._steps.clear()
            self._steps.append((self._began, 0))
        self._steps.append((now, done))
        self._began = now
        first, before = self._steps[0]
        return (now - first) / max(done - before, 1) * (of - done)

    @property
    def sure(self) -> bool:
        """Whether as many steps are known as are asked for."""
        return len(self._steps) == _LAST


class StepsLeft:
    """To be called with what is done, how much of it is, and of how much; `hint` is said once where it takes long."""

    def __init__(
        self, console: Console, status: Status, hint: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console, self._status, self._hint, self._pace = console, status, hint, Pace(clock)

    def begins(self) -> None:
        """What comes next begins now, where other work lies between it and the steps before."""
        self._pace.begins()

    def __call__(self, what: str, done: int, of: int) -> None:
        """`done` of the `of` steps of `what` are done."""
        left = self._pace.left(what, done, of)
        said = f"{what}: {done} of {of}" + (f", {in_words(left)} left" if done < of else "")
        self._status.update(said)
        if self._hint and self._pace.sure and left > _LONG_S:
            self._console.print(f"{said}; {self._hint}", soft_wrap=True)
            self._hint = ""


def in_words(seconds: float) -> str:
    """A duration as it is worth knowing beforehand."""
    if seconds < 90:
        return f"{max(1, round(seconds)):d} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
