"""Without the packages that docs/install.md makes optional: imports that still work, and the error message."""

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

from typer.main import get_command

from jaxphoto_command import app
from jaxphoto_command.application import OPTIONAL_PACKAGES

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")


def bare(requirement):
    return re.match(r"[\w-]+", requirement)[0]


def without(program):
    """A process of its own that finds none of the packages."""
    hidden = f"import sys; sys.modules.update(dict.fromkeys({list(OPTIONAL_PACKAGES)}))\n"
    return subprocess.run(
        [sys.executable, "-c", hidden + program], env=os.environ, capture_output=True, text=True, check=False
    )


def imports(function):
    """The imports inside a function, as lines."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]


def test_the_lean_line_is_all_but_what_may_be_left_out():
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (line,) = re.findall(r"^pip install (jax .*)$", PAGE, re.MULTILINE)
    assert set(line.split()) == {bare(r) for r in needed} - {bare(p) for p in OPTIONAL_PACKAGES.values()}


def test_commands_that_the_page_does_not_name_import_without():
    (rows,) = re.findall(r"^\| left out \|.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    commands = get_command(app).commands
    named = {name for name in re.findall(r"`([a-z-]+)`", rows) if name in commands}
    assert {"fly", "dsm", "monte-carlo"} <= named
    functions = [inspect.unwrap(command.callback) for name, command in commands.items() if name not in named]
    done = without("\n".join(line for function in functions for line in imports(function)))
    assert done.returncode == 0, done.stderr


def test_a_missing_package_is_named_with_the_line_that_installs_it(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    words = ["jaxphoto", "orient", str(tmp_path / "a.jpg"), "--out", str(tmp_path / "out")]
    done = without(f"sys.argv = {words}\nfrom jaxphoto_command import main\nmain()")
    assert done.returncode == 2
    package = "opencv-python-headless"
    assert done.stderr.splitlines() == [f"jaxphoto: {package} is not installed: pip install '{package}'"]
