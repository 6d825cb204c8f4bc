"""The command line in the tests' own process, and in a shell."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import jaxphoto_command
from jaxphoto_command import output


def run(monkeypatch, capsys, *arguments) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `jaxphoto ...`, in this process."""
    # The compile time depends on the machine.
    monkeypatch.setattr(output, "COMPILE_NOTE_S", math.inf)
    # Messages are not wrapped.
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 1000)
    monkeypatch.setattr(sys, "argv", ["jaxphoto", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        jaxphoto_command.main()
    captured = capsys.readouterr()
    return stop.value.code or 0, captured.out, captured.err


def run_script(script, folder):
    """Run the shell lines of a page in a folder of their own, by the jaxphoto beside this Python."""
    beside = Path(sys.executable).parent
    assert shutil.which("jaxphoto", path=str(beside)), "jaxphoto is not installed beside this Python"
    found = subprocess.run(
        ["bash", "-euc", script],
        cwd=folder,
        env=os.environ | {"PATH": f"{beside}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr
