"""The start of the command line: the list of commands is whole, and a command brings only what it needs."""

import importlib
import inspect
import json
import os
import shlex
import subprocess
import sys

import pytest
import typer

from jaxphoto.cli.app import COMMANDS, app
from tests.commands import run


def after(*arguments):
    """Modules that `jaxphoto ...` has imported in a process of its own, and what it printed."""
    program = (
        "import sys\nfrom jaxphoto.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    print('MODULES', *sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    said, _, modules = done.stdout.partition("MODULES")
    return set(modules.split()), said


def test_help_lists_every_command_and_imports_none():
    modules, said = after("--help")
    for name, command in COMMANDS.items():
        assert name in said
        assert command.sentence.split()[0] in said
        assert f"jaxphoto.cli.{command.module}" not in modules
    assert not {"cv2", "pandas", "laspy", "rasterio", "matplotlib.figure"} & modules


def test_a_command_is_imported_when_it_is_called():
    modules, said = after("simulate", "--help")
    assert "Simulate a block with known truth." in said
    assert "jaxphoto.cli.simulate" in modules
    assert not {"jaxphoto.cli.calibrate", "jaxphoto.cli.lidar", "jaxphoto.cli.adjust"} & modules


def test_the_list_is_of_the_commands_that_there_are():
    """Every module registers what the list says of it, under that name, and nothing else is registered."""
    for command in COMMANDS.values():
        importlib.import_module(f"jaxphoto.cli.{command.module}")
    own = [known for known in app.registered_commands if known.callback.__module__ != "jaxphoto.cli.app"]
    registered = {known.name: known.callback for known in own}
    assert set(registered) == set(COMMANDS)
    for name, command in COMMANDS.items():
        assert registered[name].__module__ == f"jaxphoto.cli.{command.module}"
        assert inspect.getdoc(registered[name]).startswith(command.sentence.rstrip(".")), name


def test_importing_needs_no_list_of_cores():
    """Not every system says which cores a process may use (macOS and Windows do not)."""
    program = (
        "import os\nos.__dict__.pop('sched_getaffinity', None)\nimport jax, jaxphoto\n"
        "print(jax.device_count() == os.cpu_count())"
    )
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=clean)
    assert done.stdout.strip() == "True", done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_in_the_help_of_a_command_is_one(name):
    """Its own options take it, and nothing that they need is missing."""
    words = shlex.split(COMMANDS[name].example)
    assert words[:2] == ["jaxphoto", name]
    importlib.import_module(f"jaxphoto.cli.{COMMANDS[name].module}")
    commands = typer.main.get_command(app).commands
    assert commands[name].make_context(name, words[2:]).params is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.before])
def test_the_example_in_the_help_of_a_command_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in (*COMMANDS[name].before, COMMANDS[name].example):
        code, screen, errors = run(monkeypatch, capsys, *shlex.split(words)[1:], "--json")
        assert code in (0, 1), errors
        assert json.loads(screen)["written"]


def test_help_is_short_too_and_ends_with_an_example():
    _, said = after("compare", "-h")
    assert "Example: jaxphoto compare results_2025 results_2026" in said and "zrot | rot | spr" in said
    _, said = after("-h")
    headings = [said.index(title) for title in ("Adjust and judge", "From photographs", "Lidar", "Files and formats")]
    assert headings == sorted(headings) and headings[0] < said.index("monte-carlo") < headings[1]
