"""The code on docs/extending_files.md runs, and prints what the page says."""

import contextlib
import io
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_runs(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "extending_files.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 7
    shutil.copytree(ROOT / "examples" / "cross_block", tmp_path / "examples" / "cross_block")
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    for code in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, "extending_files.md", "exec"), names)
        said = re.findall(r"^print\(.*\)\n# (.*)$", code, re.MULTILINE)
        assert printed.getvalue().splitlines() == said
