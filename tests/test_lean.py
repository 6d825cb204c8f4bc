"""Without the packages that docs/install.md says may be left out: what still starts, and what the rest says."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from jaxphoto.cli import _LEFT_OUT
from jaxphoto.cli.app import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")


def bare(requirement):
    return re.match(r"[\w-]+", requirement)[0]


def without(program):
    """A process of its own that finds none of the packages."""
    hidden = f"import sys; sys.modules.update(dict.fromkeys({list(_LEFT_OUT)}))\n"
    return subprocess.run(
        [sys.executable, "-c", hidden + program], env=os.environ, capture_output=True, text=True, check=False
    )


def test_the_lean_line_is_all_but_what_may_be_left_out():
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (line,) = re.findall(r"^pip install (jax .*)$", PAGE, re.MULTILINE)
    assert set(line.split()) == {bare(r) for r in needed} - {bare(p) for p in _LEFT_OUT.values()}


def test_commands_that_the_page_does_not_name_start_without():
    (rows,) = re.findall(r"^\| left out \|.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    named = {name for name in re.findall(r"`([a-z-]+)`", rows) if name in COMMANDS}
    assert {"fly", "dsm", "monte-carlo"} <= named
    modules = {f"jaxphoto.cli.{command.module}" for name, command in COMMANDS.items() if name not in named}
    done = without(f"import importlib\nfor module in {sorted(modules)}: importlib.import_module(module)")
    assert done.returncode == 0, done.stderr


def test_what_is_not_there_is_named_with_the_line_that_installs_it():
    done = without("sys.argv = ['jaxphoto', 'orient', '--help']\nfrom jaxphoto.cli import main\nmain()")
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "jaxphoto: opencv-python-headless is needed for this and not there: pip install 'opencv-python-headless'"
    ]
