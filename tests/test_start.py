"""The start of the command line: a quick list of commands, and examples that are valid."""

import inspect
import json
import os
import shlex
import subprocess
import sys
from typing import get_args

import pytest
from typer.main import get_command

from jaxphoto.extras.formats import CAMERAS_WRITTEN, LOSS_PX
from jaxphoto.extras.photos.features import LONGEST_PX
from jaxphoto.georeferencing import PATTERNS, ScannerCalibration
from jaxphoto.io.clouds import Returns
from jaxphoto.io.shipped import EXAMPLES
from jaxphoto.lidar.heights import Method
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.losses import LOSSES
from jaxphoto.parameters import dynamic_fields
from jaxphoto.procedures.compare import CUTS
from jaxphoto.procedures.lidar.images_and_cloud import SHIFT_SIGMA
from jaxphoto.procedures.lidar.iterate_to_convergence import MAX_ROUNDS
from jaxphoto.procedures.lidar.strip_adjustment import MAX_STRIP_ROUNDS
from jaxphoto.procedures.lidar.vertical_control import METHODS
from jaxphoto.procedures.model_choice import FOLDS
from jaxphoto.sensitivity import PER
from jaxphoto.sensitivity.influence import DELTA0, Per
from jaxphoto.stability import METHODS as ALIGNMENTS
from jaxphoto.statistics import EOP_NAMES
from jaxphoto_command import app, blocks, examples, files, lidar
from tests.commands import run

COMMANDS = get_command(app).commands
_STRIPS = StripSettings()
# The command line states these without importing the library.
CHOICES = [
    (blocks.adjust, "rotations", EOP_NAMES),
    (blocks.adjust, "robust", LOSSES),
    (blocks.monte_carlo, "kind", [*PER, "noise"]),
    (blocks.sensitivity, "per", get_args(Per)),
    (blocks.halves, "method", ALIGNMENTS),
    (files.camera, "out_format", CAMERAS_WRITTEN),
    (lidar.lidar_control, "method", METHODS),
    (lidar.lidar_control, "returns", get_args(Returns)),
    (lidar.simultaneous, "method", get_args(Method)),
    (lidar.strips, "pattern", PATTERNS),
]
DEFAULTS = [
    (blocks.sensitivity, "delta0", DELTA0),
    (blocks.halves, "cuts", CUTS),
    (files.camera, "loss_px", LOSS_PX),
    (lidar.lidar_control, "max_rounds", MAX_ROUNDS),
    (lidar.simultaneous, "shift", f"{SHIFT_SIGMA:g}"),
    (lidar.strips, "max_rounds", MAX_STRIP_ROUNDS),
    (lidar.strips, "most_planes", _STRIPS.most),
    *((lidar.strips, name, getattr(_STRIPS, name)) for name in ("cell_m", "roughness_m", "knots_s", "correlation_s")),
    *((lidar.strips, name, getattr(_STRIPS, name)) for name in ("sigma_exposure_m", "sigma_exposure_deg")),
]


def after(*arguments):
    """Modules that `jaxphoto ...` has imported in a process of its own, and what it printed."""
    program = (
        "import sys\nfrom jaxphoto_command import main\n"
        "try:\n    main()\nexcept SystemExit:\n    print('MODULES', *sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    screen, _, modules = done.stdout.partition("MODULES")
    return set(modules.split()), screen


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("compare", "-h")])
def test_help_and_version_import_no_library(words):
    modules, screen = after(*words)
    assert not {"jax", "numpy", "jaxphoto"} & modules
    if words == ("--help",):
        assert all(name in screen for name in COMMANDS)
    if words == ("compare", "-h"):
        assert "Example: " in screen and "jaxphoto compare" in screen and "zrot|rot|spr" in screen


def test_panels_come_in_their_order(monkeypatch, capsys):
    screen = run(monkeypatch, capsys, "-h")[1]
    titles = ("Adjustment and assessment", "monte-carlo", "Photographs", "Camera comparison", "Lidar", "Files and")
    places = [screen.index(title) for title in titles]
    assert places == sorted(places)


@pytest.mark.parametrize(("command", "option", "names"), CHOICES)
def test_choices_are_those_of_the_library(command, option, names):
    annotation = inspect.signature(command).parameters[option].annotation
    literals = (annotation, *get_args(annotation), *get_args(get_args(annotation)[0]))
    choices = next(get_args(part) for part in literals if get_args(part) and isinstance(get_args(part)[0], str))
    assert set(choices) == set(names)


@pytest.mark.parametrize(("command", "option", "value"), DEFAULTS)
def test_defaults_are_those_of_the_library(command, option, value):
    assert inspect.signature(command).parameters[option].default == value


def test_other_names_are_those_of_the_library():
    assert set(examples.NEXT) == set(EXAMPLES)
    assert set(lidar.SCANNER) == {"boresight", *(n.replace("_", "-") for n in dynamic_fields(ScannerCalibration))}
    assert (LONGEST_PX, FOLDS) == (2400, 5)


def test_importing_needs_no_list_of_cores():
    """Not every system says which cores a process may use (macOS and Windows do not)."""
    program = (
        "import os\nos.__dict__.pop('sched_getaffinity', None)\nimport jax, jaxphoto\n"
        "print(jax.device_count() == os.cpu_count())"
    )
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=clean)
    assert done.stdout.strip() == "True", done.stderr


def _example(name):
    return [shlex.split(line)[1:] for line in COMMANDS[name].epilog.removeprefix("Example: ").split(" && ")]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_in_the_help_of_a_command_is_valid(name):
    command, *words = _example(name)[-1]
    assert command == name
    assert COMMANDS[name].make_context(name, words).params is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if _example(name)[0][0] == "example"])
def test_the_example_in_the_help_of_a_command_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in _example(name):
        code, screen, errors = run(monkeypatch, capsys, *words, "--json")
        assert code in (0, 1), errors
        assert json.loads(screen)["written"]
