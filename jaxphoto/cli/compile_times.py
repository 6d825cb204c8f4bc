"""How long compiling took, and of which programs."""

import re
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import jax.monitoring

# What JAX does before a program runs: tracing it, lowering it, compiling it.
_STEPS = "/jax/core/compile/"
_LAST = f"{_STEPS}backend_compile_duration"
_LEAST_S = 0.1
_NAMED = 3


class CompileTimes:
    """Seconds that compiling took from now on, in all threads; `report` is told of each program of a tenth or more."""

    def __init__(self, report: Callable[[str, float], None] | None = None) -> None:
        self._report = report
        self._spans = list[tuple[float, float]]()
        self._programs: defaultdict[str, float] = defaultdict(float)
        self._under_way: defaultdict[str, float] = defaultdict(float)
        _heard_by.append(self)

    def stop(self) -> None:
        """Hear no more."""
        _heard_by.remove(self)

    def __call__(self, event: str, seconds: float, name: str) -> None:
        """A step of a program has ended, which took `seconds`."""
        now = time.perf_counter()
        self._spans.append((now - seconds, now))
        self._programs[name] += seconds
        self._under_way[name] += seconds
        if event == _LAST and (took := self._under_way.pop(name)) >= _LEAST_S and self._report:
            self._report(name, took)

    @property
    def seconds(self) -> float:
        """For how long anything was compiled: programs are compiled beside each other, and within each other."""
        total, until = 0.0, 0.0
        for began, ended in sorted(self._spans):
            total += max(0.0, ended - max(began, until))
            until = max(until, ended)
        return total

    @property
    def programs(self) -> dict[str, float]:
        """Seconds of each program of a tenth or more, the longest first."""
        return dict(sorted(((n, s) for n, s in self._programs.items() if s >= _LEAST_S), key=lambda of: -of[1]))

    @property
    def told(self) -> dict[str, Any]:
        """For other programs."""
        return {"seconds": self.seconds, "programs": self.programs}

    @property
    def sentence(self) -> str:
        """For a person."""
        longest = ", ".join(f"{name} {s:.1f} s" for name, s in list(self.programs.items())[:_NAMED])
        return f"compiling took {self.seconds:.1f} s (most: {longest}), which the next run of this kind is spared"


_heard_by: list[CompileTimes] = []


def _hear(event: str, duration_secs: float, **of: Any) -> None:
    if event.startswith(_STEPS) and event.endswith("_duration"):
        name = re.sub(r"^jit\((.*)\)$", r"\1", str(of.get("fun_name", ""))).replace("<lambda>", "")
        for times in tuple(_heard_by):
            times(event, duration_secs, name.removesuffix("_of_arrays").strip("_").replace("_", " ") or "a program")


# JAX has no way to hear no more.
jax.monitoring.register_event_duration_secs_listener(_hear)
