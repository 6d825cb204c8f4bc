"""What every command tells: a screen for people, one JSON object for programs, nothing where silence is wanted."""

import importlib
import json
import sys
import time
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
import typer

from jaxphoto import cli
from jaxphoto.adjustment.told import step_lines, tell_course
from jaxphoto.cli.app import COMMANDS, app
from jaxphoto.cli.compile_times import CompileTimes
from jaxphoto.cli.output import OF_OUTPUT, Output, command
from tests.blocks import adjusted
from tests.commands import run

TYPES = {
    "command": str, "version": str, "exit_code": int, "verdict": str | None, "findings": list, "warnings": list,
    "written": list, "summary": dict, "seconds": float, "compiling": dict,
}  # fmt: skip


def told(screen):
    """The JSON that a command printed, of the types that docs/command_line.md promises."""
    values = json.loads(screen, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
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


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_the_same_options_for_what_it_tells(name):
    importlib.import_module(f"jaxphoto.cli.{COMMANDS[name].module}")
    options = {p.name: p.opts for p in typer.main.get_command(app).commands[name].params}
    assert [options[one] for one in OF_OUTPUT] == [["--json"], ["--quiet", "-q"], ["--verbose", "-v"]]


def test_commands_print_by_their_output_alone():
    """What goes past it is printed in spite of --quiet and --json."""
    for path in Path(cli.__file__).parent.glob("*.py"):
        if path.stem not in ("__init__", "app", "console", "output"):
            text = path.read_text(encoding="utf-8")
            assert not any(word in text for word in ("plain_console", "typer.echo", " print(", "@app.command")), path


@pytest.fixture
def simulated(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(monkeypatch, capsys, "example", "recipe", "--quiet")
    return tmp_path


def test_a_program_gets_one_object_and_who_wants_silence_nothing(simulated, monkeypatch, capsys):
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
        values = told(screen)
        assert values["command"] == name and values["summary"]
        assert bool(values["written"]) == (name != "stability")
    assert run(monkeypatch, capsys, "stability", "cross_block", "camera.toml", "-q") == (0, "", "")
    code, screen, errors = run(monkeypatch, capsys, "stability", "cross_block", "nothing", "--json", "-q")
    assert code == 2 and screen == "" and "nothing" in errors
    code, _, errors = run(monkeypatch, capsys, "stability", "cross_block", "camera.toml", "-q", "-v")
    assert code == 2 and "contradict" in errors


def test_numbers_that_are_none_and_arrays_are_told_as_json_has_them(tmp_path):
    (tmp_path / "summary.json").write_text('{"verdict": "amber", "findings": [], "sigma0": NaN}')
    output = Output("adjust", quiet=True)
    output.close()
    output.wrote(tmp_path, "results")
    output.tell(n=np.int64(3), sigmas=np.array([1.0, np.inf]), path=tmp_path)
    output.show_warning("mind the gap")
    values = told(json.dumps(output.told(0)))
    assert values["verdict"] == "amber" and values["warnings"] == ["mind the gap"]
    assert values["summary"] == {"sigma0": None, "n": 3, "sigmas": [1.0, None], "path": str(tmp_path)}


def test_each_step_has_a_line_where_all_are_wanted(capsys):
    output = Output("adjust", verbose=True)
    output.close()
    with output.progress.status("reading") as status:
        for k in range(5):
            status.update(f"features: {k} of 5")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" s  ")[1] for line in lines] == ["reading", "features: 0 of 5"]


def test_each_iteration_of_any_command_has_a_line_where_all_are_wanted(capsys):
    result, output = adjusted("cross"), Output("halves", verbose=True)
    tell_course(result)
    output.close()
    tell_course(result)
    lines = [line.split(" s  ")[1] for line in capsys.readouterr().err.splitlines()]
    assert lines == [
        f"adjusted 10 images, {len(result.block.points)} points: {result.outcome.value}",
        *step_lines(result),
    ]


def test_compiling_is_timed_once_where_programs_are_compiled_within_each_other():
    times, said = CompileTimes(lambda name, seconds: said.append(name)), []
    began = time.perf_counter()

    @jax.jit
    def slowly_traced(x):
        time.sleep(0.2)
        return jax.jit(lambda x: x + 1)(x)

    slowly_traced(np.zeros(3))
    most = time.perf_counter() - began
    times.stop()
    assert times.programs["slowly traced"] > 0.2
    assert 0.2 < times.seconds < most
    assert "slowly traced" in said and "slowly traced" in times.sentence


def test_a_program_without_a_name_is_called_one():
    times = CompileTimes()
    jax.monitoring.record_event_duration_secs(
        "/jax/core/compile/backend_compile_duration", 1.0, fun_name="jit(<lambda>)"
    )
    times.stop()
    assert times.programs == {"a program": 1.0}


def test_compiling_that_took_long_is_told_beside_the_outcome(simulated, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["jaxphoto", "example"])
    monkeypatch.setattr("jaxphoto.cli.output.WORTH_TELLING_S", 0.0)
    with pytest.raises(SystemExit):
        cli.main()
    said = capsys.readouterr()
    assert said.err.startswith("compiling took 0.0 s") and "cross_block" in said.out


def test_a_command_that_cannot_tell_anything_is_none():
    with pytest.raises(TypeError, match="output"):
        command("nothing")(lambda: None)


def test_warnings_go_back_to_where_they_went(simulated, monkeypatch, capsys):
    with warnings.catch_warnings():
        run(monkeypatch, capsys, "example")
        assert warnings.showwarning is cli.show_warning
