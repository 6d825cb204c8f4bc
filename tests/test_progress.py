"""How long the rest takes, by the last steps, and the lines that say what is done off a terminal."""

import io
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
    now, written = [0.0], io.StringIO()
    console = Console(file=written, force_terminal=terminal, width=200)
    # Never started, so that on a terminal nothing is drawn between the lines.
    status = PlainStatus("reading", lambda: now[0], console=console)
    for k in range(1, 11):
        now[0] = 8.0 * k
        status.update(f"adjusting [round] {k}")
    lines = [] if terminal else ["adjusting [round] 4", "adjusting [round] 8"]
    assert written.getvalue().splitlines() == lines


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
