"""Without the extras: what starts, and the line that a missing extra names."""

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

from jaxphoto.optional import EXTRAS
from jaxphoto_command import app

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")


def without_extras(program):
    """Run a program in a process that finds no optional module."""
    hidden = f"import sys; sys.modules.update(dict.fromkeys({list(EXTRAS)}))\n"
    return subprocess.run(
        [sys.executable, "-c", hidden + program], env=os.environ, capture_output=True, text=True, check=False
    )


def imports(function):
    """Return the imports inside a function, as lines."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def test_every_extra_is_declared_and_documented():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(EXTRAS.values()) <= set(declared)
    assert set(re.findall(r"^\| `(\w+)` \(", PAGE, re.MULTILINE)) == set(EXTRAS.values())


def test_commands_without_an_extra_start():
    (rows,) = re.findall(r"^\| extra \|.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    commands = get_command(app).commands
    named = {name for name in re.findall(r"`([a-z-]+)`", rows) if name in commands}
    assert {"fly", "strips", "monte-carlo"} <= named
    functions = [inspect.unwrap(command.callback) for name, command in commands.items() if name not in named]
    done = without_extras("\n".join(line for function in functions for line in imports(function)))
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("program", "module", "extra"),
    [
        (
            "sys.argv = ['jaxphoto', 'orient', 'a.jpg', '--out', 'out']\nfrom jaxphoto_command import main\nmain()",
            "cv2",
            "photos",
        ),
        pytest.param("from jaxphoto.io import clouds; clouds._laspy()", "laspy", "lidar", marks=pytest.mark.slow),
    ],
)
def test_a_missing_extra_is_named_with_the_line_that_installs_it(program, module, extra):
    done = without_extras(program)
    assert done.returncode and f"{module} is not installed: pip install 'jaxphoto[{extra}]'" in done.stderr
