"""How long the rest takes, by the last steps, and the lines that say what is done off a terminal."""

import io
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from jaxphoto.cli.cloud_progress import CloudProgress
from jaxphoto.cli.console import PlainStatus
from jaxphoto.cli.progress import StepsLeft, in_words
from jaxphoto.cloud import Cloud


@pytest.fixture
def shown():
    said = SimpleNamespace(now=0.0, lines=[], status="")
    said.print = lambda text, **options: said.lines.append(text)
    said.update = lambda text: setattr(said, "status", text)
    return said


@pytest.mark.parametrize("terminal", [False, True])
def test_off_a_terminal_a_line_now_and_then_says_what_is_done(terminal):
    written = io.StringIO()
    status = PlainStatus("reading", line_s=0.1, console=Console(file=written, force_terminal=terminal, width=200))
    with status:
        status.update("adjusting [round] 1")
        time.sleep(0.35)
    lines = written.getvalue().split("\n")
    time.sleep(0.2)
    assert written.getvalue().split("\n") == lines
    if not terminal:
        # As many as the time allows, on a busy machine fewer.
        assert 1 <= lines.count("adjusting [round] 1") <= 3 and set(lines) == {"adjusting [round] 1", ""}


def test_a_line_says_how_long_a_step_takes_where_it_does_not_say_how_long_the_rest_does():
    now = [100.0]
    status = PlainStatus("reading", lambda: now[0], console=Console(file=io.StringIO()))
    now[0] = 140.0
    assert status.line() == "reading (40 s)"
    status.update("features: 3 of 9, 5 s left")
    assert status.line() == "features: 3 of 9, 5 s left"
    now[0] = 150.0
    status.update("features: 9 of 9")
    assert status.line() == "features: 9 of 9 (10 s)"


def test_a_status_that_numbers_its_steps_says_how_long_the_rest_takes():
    now = [0.0]
    status = PlainStatus("reading", lambda: now[0], console=Console(file=io.StringIO()))
    said = []
    for number in range(1, 5):
        now[0] += 5.0
        status.update(f"adjusting halves: cut {number} of 4")
        said.append(status.line())
    halves = "adjusting halves: cut"
    # Three, two and one of them are still to be made.
    assert said == [f"{halves} 1 of 4", *(f"{halves} {n} of 4, {5 * (5 - n)} s left" for n in (2, 3, 4))]


def test_what_is_left_is_judged_by_the_last_steps(shown):
    steps = StepsLeft(shown, shown, clock=lambda: shown.now)
    for k in range(1, 5):
        shown.now = 8.0 * k
        steps("features", k, 10)
    assert shown.status == "features: 4 of 10, 48 s left"
    shown.now = 80.0
    steps("features", 10, 10)
    assert shown.status == "features: 10 of 10"
    shown.now = 95.0
    steps("matches", 5, 50)
    assert shown.status == "matches: 5 of 50, 2 min left"


def test_one_hint_where_it_takes_long(shown):
    steps = StepsLeft(shown, shown, "take fewer", clock=lambda: shown.now)
    for k in range(1, 60):
        # The first are there from an earlier run.
        shown.now += 0.0 if k < 30 else 2.0
        steps("matches", k, 2000)
    assert len(shown.lines) == 1 and shown.lines[0].endswith("; take fewer")
    assert shown.status == "matches: 59 of 2000, 65 min left"


def test_durations_in_words():
    assert [in_words(s) for s in (0.2, 89, 100, 3600, 7000)] == ["1 s", "89 s", "2 min", "60 min", "1.9 h"]


def test_parts_of_a_cloud_are_counted_until_it_has_passed_and_anew_when_it_passes_again(shown):
    cloud = Cloud(np.zeros((30, 3)))

    def parts():
        for first in (0, 10, 20):
            shown.now += 5.0
            yield cloud.take(np.arange(first, first + 10))

    progress = CloudProgress(StepsLeft(shown, shown, clock=lambda: shown.now), shown, 30)
    told, said = progress.passes(parts), []
    for _ in range(2):
        for part in told():
            assert len(part) == 10
            said.append(shown.status)
        # Work between one pass and the next says nothing of how long that takes.
        shown.now += 3600.0
    progress.begins()
    shown.now += 4.0
    progress("writing", cloud.take(np.arange(10)))
    assert shown.status == "writing: 10 of 30, 8 s left"
    progress("writing", cloud.take(np.arange(20)))
    assert said[:3] == ["reading the cloud: 10 of 30, 10 s left", "reading the cloud: 20 of 30, 5 s left",
                        "reading the cloud: 30 of 30"]  # fmt: skip
    assert said[3] == "reading the cloud again: 10 of 30, 10 s left" and shown.status == "writing: 30 of 30"
    unknown = CloudProgress(StepsLeft(shown, shown), shown, None)
    unknown("reading", cloud)
    assert shown.status == "reading: 30 points"
