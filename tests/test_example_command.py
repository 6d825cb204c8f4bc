"""What comes with jaxphoto, from a clone and from a wheel."""

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from typer.main import get_command

import jaxphoto
from jaxphoto.errors import InputError
from jaxphoto.io import read_recipe
from jaxphoto.io.shipped import EXAMPLES, shipped
from jaxphoto_command import app
from jaxphoto_command.examples import NEXT
from tests.commands import run

ROOT = Path(__file__).resolve().parents[1]


def test_the_block_arrives_whole_and_can_be_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, screen, _ = run(monkeypatch, capsys, "example", "cross_block")
    assert code == 0 and "next: jaxphoto adjust cross_block --out results" in screen
    assert len(jaxphoto.read_block(tmp_path / "cross_block").images) == 31


def test_recipes_arrive_under_the_name_that_is_asked_for(tmp_path, monkeypatch, capsys):
    for name in ("recipe", "boresight"):
        out = tmp_path / f"my_{name}.toml"
        assert run(monkeypatch, capsys, "example", name, "--out", out)[0] == 0
        assert read_recipe(out).title
        code, _, error = run(monkeypatch, capsys, "example", name, "--out", out)
        assert code == 2 and "exists already" in error


def test_experiments_arrive_with_their_papers_numbers(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, capsys, "example", "experiments", "--out", tmp_path / "e")[0] == 0
    assert (tmp_path / "e/000/experiment.py").is_file() and (tmp_path / "e/000/published.csv").is_file()
    assert not list((tmp_path / "e").rglob("__pycache__"))


def test_without_a_name_they_are_listed_and_a_wrong_one_is_said(tmp_path, monkeypatch, capsys):
    _, screen, _ = run(monkeypatch, capsys, "example")
    assert [line.split()[0] for line in screen.splitlines()] == list(EXAMPLES)
    code, _, error = run(monkeypatch, capsys, "example", "crossblock")
    assert code == 2 and "unknown example crossblock; choose one of cross_block, recipe" in error
    for flight in ("lidar", "strips"):
        assert read_recipe(shipped(flight)).lidar is not None
    monkeypatch.setattr("jaxphoto.io.shipped._PACKAGE", tmp_path / "jaxphoto")
    with pytest.raises(InputError, match="has no examples"):
        shipped("recipe")


@pytest.mark.parametrize("example", EXAMPLES)
def test_what_is_to_be_typed_next_is_a_command_and_its_options(example):
    program, command, *words = NEXT[example].split()
    assert program == "jaxphoto"
    assert get_command(app).commands[command].make_context(command, words).params is not None


@pytest.mark.slow
def test_the_wheel_has_all_that_its_user_needs(tmp_path):
    if find_spec("hatchling") is None:
        pytest.skip("hatchling builds the wheel: install it, as pip install -e '.[dev]' does")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path]
    subprocess.run(build, check=True, cwd=ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        packed.extractall(tmp_path / "site")
    folders = (ROOT / "jaxphoto", ROOT / "jaxphoto_command")
    files = [p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".toml", ".typed")]
    assert {str(p.relative_to(ROOT)) for p in files} <= names
    for folder in ("examples", "experiments"):
        tracked = subprocess.run(["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True)
        assert {f"jaxphoto/shipped/{name}" for name in tracked.stdout.split()} <= names
    metadata = (tmp_path / "site" / f"jaxphoto-{jaxphoto.__version__}.dist-info/METADATA").read_text(encoding="utf-8")
    assert "Classifier: Typing :: Typed" in metadata
    # Away from the clone: nothing but what is in the wheel can be found.
    program = "import jaxphoto_command; jaxphoto_command.main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "example", "cross_block"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "wrote cross_block" in done.stdout and (tmp_path / "cross_block/block.toml").is_file()
