"""The application that every command registers with, and where each command is.

A command brings what it needs, some of it heavy (OpenCV, SciPy's optimisers, laspy). Its module is imported when it is
called; the list of all commands needs none: it has a line for each from here.
"""

import gc
import importlib
from functools import partial
from typing import Annotated, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

import jaxphoto


class _Command(NamedTuple):
    """The module of `jaxphoto.cli` that has a command, how its docstring begins, and how it is called."""

    module: str
    sentence: str
    example: str
    before: tuple[str, ...] = ()
    """Commands that make what the example reads; where there are none it is the user's own."""

    @property
    def epilog(self) -> str:
        """The example, as it can be typed."""
        return "Example: " + " && ".join([*self.before, self.example])


_BLOCK = ("jaxphoto example cross_block",)
_RESULTS = (*_BLOCK, "jaxphoto adjust cross_block --out results")
_LIDAR = ("jaxphoto example lidar",)


_CONTENTS = {
    "Adjust and judge": {
        "adjust": _Command(
            "adjust",
            "Adjust a block and write tables, statistics and a report.",
            "jaxphoto adjust cross_block --out results",
            _BLOCK,
        ),
        "boresight": _Command(
            "boresight",
            "Boresight misalignment in four steps.",
            "jaxphoto boresight flight --out boresight",
            ("jaxphoto example boresight", "jaxphoto simulate boresight.toml --out flight"),
        ),
        "certificate": _Command(
            "certificate",
            "Write the certificate of a calibration.",
            "jaxphoto certificate results --out camera.pdf",
            _RESULTS,
        ),
        "tables": _Command(
            "tables",
            "Write tables of results as CSV, Parquet, Markdown or LaTeX.",
            "jaxphoto tables results --to latex --only interior --out tables",
            _RESULTS,
        ),
        "monte-carlo": _Command(
            "monte_carlo",
            "Re-adjust a block with drawn errors.",
            "jaxphoto monte-carlo cross_block --bias station --per strip --sigma-m 0.15 --draws 1000 --out draws",
            _BLOCK,
        ),
        "sensitivity": _Command(
            "sensitivity",
            "Exact sensitivity of the interior orientation and the check points to stations, and to undetected errors.",
            "jaxphoto sensitivity cross_block --out sensitivity",
            _BLOCK,
        ),
        "halves": _Command(
            "halves",
            "Judge the standard deviations of a calibration by random halves of its block.",
            "jaxphoto halves cross_block --by image --cuts 64 --out halves",
            _BLOCK,
        ),
    },
    "From photographs": {
        "fly": _Command(
            "fly",
            "Calibrate the camera of a flight from its photographs and their positions.",
            "jaxphoto fly photographs --out flight",
        ),
        "control": _Command(
            "control",
            "Adjust an oriented block with control: surveyed points and where photographs show them.",
            "jaxphoto control flight/block gcp_list.txt --out controlled",
        ),
        "calibrate": _Command(
            "calibrate",
            "Calibrate a camera with photographs of a board.",
            "jaxphoto calibrate board/*.jpg --board chessboard:8x6:square_mm=30 --out camera",
        ),
        "orient": _Command(
            "orient",
            "Orient photographs to one another from their features alone.",
            "jaxphoto orient photographs/*.jpg --out BLOCK",
        ),
        "undistort": _Command(
            "undistort",
            "Resample photographs to a camera without distortion.",
            "jaxphoto undistort photographs --camera results --out straight",
        ),
    },
    "Cameras compared": {
        "stability": _Command(
            "stability",
            "Compare the bundles of rays of two interior orientations.",
            "jaxphoto stability camera_2025 camera_2026 --out stability",
        ),
        "compare": _Command(
            "compare",
            "Test whether a camera has changed between two calibrations.",
            "jaxphoto compare results_2025 results_2026",
        ),
        "combine": _Command(
            "combine",
            "Combine calibrations of one camera by their full covariances.",
            "jaxphoto combine 2023 2024 2025 --out camera.toml",
        ),
        "models": _Command(
            "model_choice",
            "Compare distortion models by cross-validation, information criteria and significance.",
            "jaxphoto models cross_block --models brown:k1,brown:k1+k2,opencv --out models",
            _BLOCK,
        ),
    },
    "Lidar": {
        "lidar-control": _Command(
            "lidar",
            "Give tie points the height of the laser points there as control.",
            "jaxphoto lidar-control lidar lidar/cloud.laz --out with_heights",
            _LIDAR,
        ),
        "roof-control": _Command(
            "lidar",
            "Hold tie points on the planes of roof faces.",
            "jaxphoto roof-control lidar lidar/cloud.laz --out with_roofs",
            _LIDAR,
        ),
        "simultaneous": _Command(
            "lidar",
            "Adjust a block and a cloud together.",
            "jaxphoto simultaneous lidar lidar/cloud.laz --trajectory lidar/trajectory.csv --out both",
            _LIDAR,
        ),
        "strips": _Command(
            "strips",
            "Fit the strips of a cloud to each other.",
            "jaxphoto strips strips/cloud.laz --trajectory strips/trajectory.csv --cell-m 8 --out fitted",
            ("jaxphoto example strips",),
        ),
        "dsm": _Command(
            "surface_model",
            "Make a surface model of a cloud.",
            "jaxphoto dsm lidar/cloud.laz --out dsm.tif --cell-m 4 --hillshade hill.png",
            _LIDAR,
        ),
        "orthophoto": _Command(
            "surface_model",
            "Adjust a block, and lay the photograph of one of its images over a surface model.",
            "jaxphoto orthophoto BLOCK photo.jpg dsm.tif --image A1 --out ortho.tif",
        ),
    },
    "Files and formats": {
        "convert": _Command(
            "convert",
            "Turn another program's files into a block folder, or what was adjusted into files of others.",
            "jaxphoto convert results --to colmap --out sparse",
            _RESULTS,
        ),
        "camera": _Command("camera", "Convert a camera file.", "jaxphoto camera results --out cameras.txt", _RESULTS),
    },
    "Examples and simulation": {
        "example": _Command(
            "example",
            "Write an example block, recipe or experiment that comes with jaxphoto.",
            "jaxphoto example cross_block",
        ),
        "simulate": _Command(
            "simulate",
            "Simulate a block with known truth.",
            "jaxphoto simulate recipe.toml --out block --seed 1",
            ("jaxphoto example recipe",),
        ),
        "experiment": _Command(
            "experiment",
            "Run experiments; write tables.csv and report.html, ours beside what the paper prints.",
            "jaxphoto experiment 000 --layouts 4 --out runs",
            ("jaxphoto example experiments",),
        ),
    },
}
COMMANDS = {name: command for commands in _CONTENTS.values() for name, command in commands.items()}
"""All commands in the order of `jaxphoto --help`: what they are about in one line each, and how they are called."""


class _Readable:
    """A command or group whose flags are shown without the type that they cannot be given, and whose arguments without
    the type that they have in Python."""

    def get_params(self, ctx):
        """All parameters, that of the help, too."""
        params = super().get_params(ctx)  # type: ignore[misc]
        for parameter in params:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = ""
            if parameter.param_type_name == "argument":
                parameter.display_type_rich = partial(_argument_word, several=parameter.nargs != 1)
        return params


def _argument_word(ctx: object, several: bool) -> str:
    """What stands behind the name of an argument: its name and help say what it is."""
    return "one or more" if several else ""


class ReadableCommand(_Readable, TyperCommand):
    """A command of `app`."""


class _WhenCalled(_Readable, TyperGroup):
    """The commands, of which that one is imported that is called."""

    def resolve_command(self, ctx, args):
        """Put the command itself in the place of its line, then go on as always."""
        if args[0] in COMMANDS:
            importlib.import_module(f"jaxphoto.cli.{COMMANDS[args[0]].module}")
            # What importing made will stay: the collector need not look through it again and again.
            gc.freeze()
            # Made anew, the group has what the module has just registered.
            self.commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
            self.commands[args[0]].epilog = COMMANDS[args[0]].epilog
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_WhenCalled,
    help="Differentiable photogrammetry: calibrate a camera as it flies.",
    epilog="Begin with: jaxphoto example cross_block, then jaxphoto adjust cross_block --out results",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
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


for _title, _commands in _CONTENTS.items():
    for _name, _known in _commands.items():
        app.command(_name, help=_known.sentence, rich_help_panel=_title)(_in_its_module)
