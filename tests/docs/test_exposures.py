"""The code on docs/exposures.md runs and says what the page is about: a gap and a solution."""

import contextlib
import io
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "exposures.md"


def test_the_page_runs():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "exposures.md", "exec"), {"__name__": "page"})
    said, position = printed.getvalue().splitlines()
    assert "4 of 5 photographs" in said and "none for 100_0042_0003" in said
    assert "fix='fixed'" in position
