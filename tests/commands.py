"""The command line in the tests' own process."""

import sys

import pytest

from jaxphoto import cli


def run(monkeypatch, capsys, *arguments) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `jaxphoto ...`, in this process."""
    monkeypatch.setattr(sys, "argv", ["jaxphoto", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    captured = capsys.readouterr()
    return stop.value.code or 0, captured.out, captured.err
