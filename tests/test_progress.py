"""How long the rest takes, by the last steps, and the lines that say so off a terminal."""

from types import SimpleNamespace

import pytest

from jaxphoto.cli.progress import StepsLeft, in_words


@pytest.fixture
def shown():
    said = SimpleNamespace(now=0.0, lines=[], status="", is_terminal=False)
    said.print = lambda text, **options: said.lines.append(text)
    said.update = lambda text: setattr(said, "status", text)
    return said


def test_lines_off_a_terminal_say_what_is_left(shown):
    steps = StepsLeft(shown, shown, clock=lambda: shown.now)
    for k in range(1, 11):
        shown.now = 8.0 * k
        steps("features", k, 10)
    assert shown.lines == ["features: 4 of 10, 48 s left", "features: 8 of 10, 16 s left"]
    shown.now = 95.0
    steps("matches", 5, 50)
    assert shown.status == "matches: 5 of 50, 2 min left"


def test_on_a_terminal_there_are_no_lines_but_one_hint_where_it_takes_long(shown):
    shown.is_terminal = True
    steps = StepsLeft(shown, shown, "take fewer", clock=lambda: shown.now)
    for k in range(1, 60):
        # The first are there from an earlier run.
        shown.now += 0.0 if k < 30 else 2.0
        steps("matches", k, 2000)
    assert len(shown.lines) == 1 and shown.lines[0].endswith("; take fewer")
    assert shown.status == "matches: 59 of 2000, 65 min left"


def test_durations_in_words():
    assert [in_words(s) for s in (0.2, 89, 100, 3600, 7000)] == ["1 s", "89 s", "2 min", "60 min", "1.9 h"]
