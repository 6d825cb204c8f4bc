"""The application that every command registers with, and where each command is.

A command brings what it needs, some of it heavy (OpenCV, SciPy's optimisers, laspy). Its module is imported when it is
called; the list of all commands needs none: it has a line for each from here.
"""

import gc
import importlib
from typing import Annotated, NamedTuple

import typer
from typer.core import TyperGroup

import jaxphoto


class _Command(NamedTuple):
    """The module of `jaxphoto.cli` that has a command, and how its docstring begins."""

    module: str
    sentence: str


COMMANDS = {
    "adjust": _Command("adjust", "Adjust a block and write tables, statistics and a report."),
    "boresight": _Command("boresight", "Boresight misalignment in four steps."),
    "calibrate": _Command("calibrate", "Calibrate a camera with photographs of a board."),
    "orient": _Command("orient", "Orient photographs to one another from their features alone."),
    "fly": _Command("fly", "Calibrate the camera of a flight from its photographs and their positions."),
    "control": _Command(
        "control", "Adjust an oriented block with control: surveyed points and where photographs show them."
    ),
    "certificate": _Command("certificate", "Write the certificate of a calibration."),
    "models": _Command(
        "model_choice", "Compare distortion models by cross-validation, information criteria and significance."
    ),
    "stability": _Command("stability", "Compare the bundles of rays of two interior orientations."),
    "compare": _Command("compare", "Test whether a camera has changed between two calibrations."),
    "combine": _Command("combine", "Combine calibrations of one camera by their full covariances."),
    "halves": _Command("halves", "Judge the standard deviations of a calibration by random halves of its block."),
    "camera": _Command("camera", "Convert a camera file."),
    "tables": _Command("tables", "Write tables of results as CSV, Parquet, Markdown or LaTeX."),
    "convert": _Command(
        "convert",
        "Turn another program's files into a block folder, or what was adjusted into files of others.",
    ),
    "undistort": _Command("undistort", "Resample photographs to a camera without distortion."),
    "example": _Command("example", "Write an example block, recipe or experiment that comes with jaxphoto."),
    "simulate": _Command("simulate", "Simulate a block with known truth."),
    "sensitivity": _Command(
        "sensitivity",
        "Exact sensitivity of the interior orientation and the check points to stations, and to undetected errors.",
    ),
    "monte-carlo": _Command("monte_carlo", "Re-adjust a block with drawn errors."),
    "lidar-control": _Command("lidar", "Give tie points the height of the laser points there as control."),
    "roof-control": _Command("lidar", "Hold tie points on the planes of roof faces."),
    "simultaneous": _Command("lidar", "Adjust a block and a cloud together."),
    "strips": _Command("strips", "Fit the strips of a cloud to each other."),
    "dsm": _Command("surface_model", "Make a surface model of a cloud."),
    "orthophoto": _Command(
        "surface_model", "Adjust a block, and lay the photograph of one of its images over a surface model."
    ),
    "experiment": _Command(
        "experiment", "Run experiments; write tables.csv and report.html, ours beside what the paper prints."
    ),
}
"""All commands in the order of `jaxphoto --help`: what they are about in one line each."""


class _WhenCalled(TyperGroup):
    """The commands, of which that one is imported that is called."""

    def resolve_command(self, ctx, args):
        """Put the command itself in the place of its line, then go on as always."""
        if args[0] in COMMANDS:
            importlib.import_module(f"jaxphoto.cli.{COMMANDS[args[0]].module}")
            # What importing made will stay: the collector need not look through it again and again.
            gc.freeze()
            # Made anew, the group has what the module has just registered.
            self.commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_WhenCalled,
    help="Differentiable photogrammetry: calibrate a camera as it flies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _root(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if show_version:
        typer.echo(f"jaxphoto {jaxphoto.__version__}")
        raise typer.Exit


def _in_its_module() -> None:
    """Stands in the list for a command whose module is not imported yet."""


for _name, _known in COMMANDS.items():
    app.command(_name, help=_known.sentence)(_in_its_module)
