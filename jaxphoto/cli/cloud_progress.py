"""How much of a cloud has passed, part by part, and how long the rest takes."""

from collections.abc import Callable, Iterator

from rich.status import Status

from jaxphoto.cli.progress import StepsLeft
from jaxphoto.cloud import Cloud


class CloudProgress:
    """To be told of each part of a cloud of `most` points, None where only reading tells how many there are."""

    def __init__(self, left: StepsLeft, status: Status, most: int | None) -> None:
        self._left, self._status, self._most = left, status, most
        self._what, self._passed = "", 0

    def __call__(self, what: str, part: Cloud) -> None:
        """A `part` more has passed of `what` is being done."""
        self._passed = len(part) + (self._passed if what == self._what else 0)
        self._what = what
        if self._most is None:
            self._status.update(f"{what}: {self._passed} points")
        else:
            self._left(what, self._passed, self._most)

    def begins(self) -> None:
        """The cloud begins to pass now."""
        self._left.begins()

    def passes(self, parts: Callable[[], Iterator[Cloud]]) -> Callable[[], Iterator[Cloud]]:
        """`parts`, telling of each; they are read for the first time, and perhaps once more."""
        names = iter(("reading the cloud", "reading the cloud again"))

        def told() -> Iterator[Cloud]:
            what = next(names)
            self.begins()
            for part in parts():
                self(what, part)
                yield part

        return told
