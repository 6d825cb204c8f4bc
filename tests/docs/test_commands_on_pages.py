"""Every command line on the pages is one that the program knows, and its inputs are made on the page."""

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from jaxphoto_command import app
from tests.commands import run_script
from tests.docs.shell_blocks import USERS_OWN

COMMANDS = get_command(app).commands
ROOT = Path(__file__).resolve().parents[2]
# extending.md declares commands of its own.
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.stem != "extending")]
# Parameters that name what is written; `second` is the target of `convert` and `camera` without --out.
_OUTPUT = {"out", "second"}
_LISTING = re.compile(r"^```(?:sh)?\n(.*?)^```", re.MULTILINE | re.DOTALL)


def command_lines(page):
    """Every call of jaxphoto in the listings of a page."""
    for listing in _LISTING.findall(page.read_text(encoding="utf-8")):
        for line in listing.replace("\\\n", " ").splitlines():
            for part in re.split(r"&&|\||;", line):
                # Only what stands as a command: no sentence, no output.
                if found := re.match(r"\s*(?:\.venv/bin/)?jaxphoto ((?:[a-z]+-)*[a-z]+(?: .*)?$)", part):
                    yield found[1]


@pytest.mark.parametrize("page", [p for p in PAGES if list(command_lines(p))], ids=lambda p: p.name)
def test_command_lines_are_commands_with_options_that_exist(page):
    for line in command_lines(page):
        command, *words = shlex.split(line.replace("[", "").replace("]", ""), comments=True)
        assert command in COMMANDS, f"{page.name}: jaxphoto {line}"
        known = COMMANDS[command]
        options = {name for parameter in known.params for name in (*parameter.opts, *parameter.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= options, f"{page.name}: jaxphoto {line}"
        # What may be left out stands in brackets, with words for what the user puts there.
        if "[" not in line:
            known.make_context(command, words)


@pytest.mark.parametrize("page", [p for p in PAGES if list(command_lines(p))], ids=lambda p: p.name)
def test_inputs_are_made_by_an_earlier_line_of_the_page(page):
    listed = USERS_OWN.get(page.relative_to(ROOT).as_posix())
    made = {*re.findall(r"^mkdir (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE), listed}
    for line in command_lines(page):
        command, *words = shlex.split(line, comments=True)
        values = COMMANDS[command].make_context(command, words).params
        lists = [value if isinstance(value, list) else [value] for name, value in values.items() if name not in _OUTPUT]
        read = [path for paths in lists for path in paths if isinstance(path, Path)]
        assert {path.parts[0] for path in read} <= made, f"{page.name}: jaxphoto {line}"
        made |= {str(values[name]) for name in _OUTPUT & values.keys()}
        if command == "example":
            made |= {values["name"], f"{values['name']}.toml"}


@pytest.mark.slow
@pytest.mark.parametrize("paper", ["000", "001", "003", "004"])
def test_what_does_a_paper_again_runs(paper, tmp_path):
    page = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
    section = page.split(f"\n## {paper}: ")[1].split("\n## ")[0] if paper in ("001", "003") else page
    script = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)[0]
    run_script(script.replace("experiment 000", f"experiment {paper}"), tmp_path)
    assert (tmp_path / {"001": "both", "003": "boresight"}.get(paper, "runs") / "report.html").is_file()
