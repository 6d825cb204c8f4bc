"""Output of commands: text for people, one JSON object for programs, progress, and nothing with --quiet."""

import io
import json
import logging
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import typer
from rich.console import Console
from rich.progress import Progress as Bar

from jaxphoto.adjustment.iteration_log import log_iterations, step_lines
from jaxphoto.compiling.run import WAITED
from jaxphoto_command import app
from jaxphoto_command import output as output_module
from jaxphoto_command.output import Output, Progress
from tests.blocks import adjusted
from tests.commands import run

TYPES = {
    "command": str, "version": str, "exit_code": int, "verdict": str | None, "findings": list, "warnings": list,
    "written": list, "summary": dict, "seconds": float, "compiling": dict,
}  # fmt: skip


def json_values(screen):
    """The JSON object of a command, with the types that docs/command_line.md states."""
    values = json.loads(screen, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert list(values) == list(TYPES)
    for name, value in values.items():
        assert isinstance(value, TYPES[name]), name
    assert values["verdict"] in (None, "green", "amber", "red")
    assert all(
        set(finding) == {"code", "severity", "subject", "value", "limit", "hint", "text"}
        for finding in values["findings"]
    )
    assert all(Path(file).is_file() for file in values["written"])
    return values


def output(as_json=False, quiet=False, verbose=False):
    context = typer.Context(typer.main.get_command(app).commands["simulate"], info_name="simulate")
    return Output(context, as_json, quiet, verbose)


@pytest.fixture
def folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(monkeypatch, capsys, "example", "recipe", "--quiet")
    return tmp_path


def test_every_command_has_the_output_options():
    for command in typer.main.get_command(app).commands.values():
        options = {p.name: p.opts for p in command.params}
        names = ("json", "quiet", "verbose")
        assert [options[name] for name in names] == [["--json"], ["--quiet", "-q"], ["--verbose", "-v"]]


def test_commands_print_one_json_object_or_nothing(folder, monkeypatch, capsys):
    calls = {
        "example": ("example", "cross_block"),
        "simulate": ("simulate", "recipe.toml", "--out", "block"),
        "convert": ("convert", "block", "--out", "copy"),
        "camera": ("camera", "cross_block", "--out", "camera.toml"),
        "stability": ("stability", "cross_block", "camera.toml"),
    }
    for name, words in calls.items():
        code, screen, errors = run(monkeypatch, capsys, *words, "--json")
        assert code == 0 and errors == "", errors
        values = json_values(screen)
        assert values["command"] == name and values["summary"]
        assert bool(values["written"]) == (name != "stability")
    assert run(monkeypatch, capsys, "stability", "cross_block", "camera.toml", "-q") == (0, "", "")
    code, screen, errors = run(monkeypatch, capsys, "stability", "cross_block", "nothing", "--json", "-q")
    assert code == 2 and screen == "" and "nothing" in errors
    code, _, errors = run(monkeypatch, capsys, "stability", "cross_block", "camera.toml", "-q", "-v")
    assert code == 2 and "contradict" in errors


def test_json_has_null_for_nan_and_lists_for_arrays(tmp_path, capsys):
    (tmp_path / "summary.json").write_text('{"verdict": "amber", "findings": [], "sigma0": NaN}')
    with output(as_json=True) as out:
        out.wrote(tmp_path, "results")
        out.add(n=np.int64(3), sigmas=np.array([1.0, np.inf]), path=tmp_path)
        out.warn("mind the gap")
    values = json_values(capsys.readouterr().out)
    assert values["verdict"] == "amber" and values["warnings"] == ["mind the gap"]
    assert values["summary"] == {"sigma0": None, "n": 3, "sigmas": [1.0, None], "path": str(tmp_path)}


def test_verbose_logs_steps_iterations_and_compilations(capsys):
    result = adjusted("cross")
    with output(verbose=True) as out:
        with out.progress("reading") as progress:
            for k in range(5):
                progress.steps("features", k, 5)
        log_iterations(result)
        jax.monitoring.record_event_duration_secs(
            "/jax/core/compile/backend_compile_duration", 1.0, fun_name="jit(solve)"
        )
    log_iterations(result)
    lines = [line.split(" ms  ")[1] for line in capsys.readouterr().err.splitlines()]
    course = [f"adjusted 10 images, {len(result.block.points)} points: {result.outcome.value}", *step_lines(result)]
    assert lines == ["reading", "features", *course, "compiled solve in 1.0 s"]
    assert not logging.getLogger("jaxphoto").handlers


def test_a_compilation_is_noticed_while_it_lasts(monkeypatch):
    monkeypatch.setattr(output_module, "_NOTICEABLE_S", 0.0)
    seen = []
    with output() as out:
        seen.append(out._is_compiling)
        jax.monitoring.record_scalar("/jax/core/compile/backend_compile_duration", 0.0, fun_name="f")
        seen.append(out._is_compiling)
        jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 0.1, fun_name="f")
        seen.append(out._is_compiling)
    assert seen == [False, True, False]


def test_a_note_states_a_long_wait_for_compilations(capsys):
    with output() as out:
        # Two programs at the same time.
        for name in "fg":
            jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 3.0, fun_name=name)
        jax.monitoring.record_event_duration_secs(WAITED, 3.0)
        out.say("done")
    screen = capsys.readouterr()
    assert "3.0 s" in screen.err and screen.out == "done\n"


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_is_shown_on_a_terminal_only(terminal):
    written = io.StringIO()
    with Bar(console=Console(file=written, force_terminal=terminal, width=200), transient=True) as bar:
        progress = Progress(bar, "reading [cloud]")
        progress.steps("reading points", 10, 30)
        progress.steps("reading points", 30, 30)
        (task,) = bar.tasks
        assert (task.completed, task.total) == (30, 30)
    assert ("reading" in written.getvalue()) == terminal


@pytest.mark.parametrize("name", ["[/red]", "[bold]x", ":smile:", "$\\frac{1$", "a$b$c", "\\$"])
def test_names_are_printed_as_they_are(name, capsys):
    out = output()
    out.say(f"wrote {name}")
    out.table(name, (name,), iter([(name,)]))
    assert capsys.readouterr().out.count(name) == 4


def test_interruption_is_one_line_and_exit_code_130(folder, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxphoto.simulation.simulate", interrupted)
    monkeypatch.setattr(sys, "argv", ["jaxphoto", "simulate", "recipe.toml", "--out", "block"])
    assert run(monkeypatch, capsys, *sys.argv[1:]) == (130, "", "jaxphoto: interrupted\n")
    assert not (folder / "block").exists()
