"""The command line in the tests' own process, and in a shell."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from markupsafe import Markup

import jaxphoto_command
from jaxphoto.report import page, plots
from jaxphoto_command import output


def run(monkeypatch, capsys, *arguments, pictures: bool = False) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `jaxphoto ...`, in this process.

    Pictures of reports are drawn, but rendered only if `pictures`: that takes two thirds of the time of a command.
    """
    if not pictures:
        monkeypatch.setattr(page, "_svg", _drawn)
    # The compile time depends on the machine.
    monkeypatch.setattr(output, "COMPILE_NOTE_S", math.inf)
    # Messages are not wrapped.
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 1000)
    monkeypatch.setattr(sys, "argv", ["jaxphoto", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        jaxphoto_command.main()
    captured = capsys.readouterr()
    return stop.value.code or 0, captured.out, captured.err


def _drawn(plot: page.Plot) -> Markup:
    """A picture that is drawn and not rendered."""
    if callable(plot.figure):
        plot.figure(plots.new_figure(4.8, plot.height).subplots())
    return Markup('<figure role="img" aria-label="{}"><svg></svg></figure>').format(plot.alt)


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
