"""What the shell blocks of the pages need, in one place: what a page takes for given, and what does not run, and why.

The blocks of a page run one after another in one folder. What the user has (BLOCK, CLOUD.laz, photographs) is made
there under that very name; a word that is no name of a file (FORMAT) is replaced.
"""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md")])
_LISTING = re.compile(r"^```([a-z]*)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^(?:jaxphoto|pip|python3?) (?!.*: )", re.MULTILINE)
_OPTIONAL = re.compile(r"\[[^\[\]]*\]")


class Given(NamedTuple):
    """What makes a page's inputs (lines of shell), and what its words stand for."""

    made_by: str
    words: dict[str, str] = {}  # noqa: RUF012


_BLOCK = "jaxphoto example cross_block --out BLOCK\n"
_RESULTS = "jaxphoto example cross_block\njaxphoto adjust cross_block --out RESULTS\n"
_FLIGHT = "made_photographs flight PHOTOGRAPHS\ncp PHOTOGRAPHS.txt FILE\n"
_YEARS = """for year in LAST_YEAR THIS_YEAR; do
    jaxphoto simulate examples/recipe.toml --seed $((seed = ${seed:-0} + 1)) --out of_$year
    jaxphoto adjust of_$year --out $year
done
"""

GIVEN = {
    "docs/boresight.md": Given(
        "",
        {
            # The verdict on so small a flight may be red.
            "--out JOINT": "--knots-s 5 --out JOINT || test $? = 1",
            "--out ADJUSTED": "--out ADJUSTED || test $? = 1",
            "--out DRAWS": "--draws 20 --out DRAWS",
        },
    ),
    "docs/clouds.md": Given("made_photographs blank PHOTO\n"),
    "docs/command_line.md": Given(_BLOCK),
    "docs/control.md": Given(_FLIGHT + "jaxphoto orient PHOTOGRAPHS/*.jpg --out BLOCK\n"),
    "docs/photographs.md": Given(_FLIGHT),
    "docs/solver.md": Given(_BLOCK + "cp -r BLOCK block\necho 'import jaxphoto' > my_script.py\n"),
    "docs/statistics.md": Given(_BLOCK),
    "docs/stability.md": Given(
        _BLOCK + _RESULTS + _YEARS + "cp -r RESULTS RESULTS_A\ncp -r RESULTS RESULTS_B\n", {"--cuts 64": "--cuts 8"}
    ),
    "docs/strip_adjustment.md": Given(
        "jaxphoto example strips --out SURVEYED\n"
        "echo point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m > surveyed.csv\n"
        "sed '1d; s/$/,0.02,0.02,0.02/' SURVEYED/truth/object_points.csv >> surveyed.csv\n"
    ),
    "docs/target_calibration.md": Given(
        "made_photographs board photographs\nmade_photographs board odd\nmade_photographs board even\n"
    ),
    "docs/trust.md": Given(_BLOCK),
    "README.md": Given("", {".venv/bin/": ""}),
}

# Pieces of blocks that do not run, and why; what is left of their lines does.
_INSTALLS = "installs from a registry; .ci/run does so"
NOT_RUN = {
    "README.md": {
        "python3 -m venv .venv && .venv/bin/pip install -q . && ": _INSTALLS,
        "python3 -m venv .venv && .venv/bin/pip install -q '.[dev]' && .venv/bin/pytest -n 2": _INSTALLS,
    },
    "CONTRIBUTING.md": {
        ".ci/run\n": "runs these tests",
        "python3 -m venv .venv && .venv/bin/pip install -e '.[dev]'\n": _INSTALLS,
        ".venv/bin/ruff check --fix . && .venv/bin/ruff format . && .venv/bin/mypy && .venv/bin/lint-imports\n": "the "
        "checks that .ci/run makes",
        ".venv/bin/pytest -m quick\n.venv/bin/pytest -n 2 tests/camera\n": "runs these tests",
    },
    "docs/formats.md": {
        **{
            f"jaxphoto convert cross_block {name} --to {format} --adjust\n\njaxphoto convert {name} from_{name}\n"
            f"jaxphoto adjust from_{name} --out results_{name}\n": "runs in test_other_programs.py"
            for name, format in (("metashape", "metashape"), ("colmap", "colmap"), ("pix4d", "opk"))
        },
        'jaxphoto convert "$JAXPHOTO_DATA/sxb" strasbourg\njaxphoto adjust strasbourg --out results_dbat\n': "runs in "
        "test_other_programs.py",
    },
    "docs/half_an_hour.md": {"python3 -m venv venv && . venv/bin/activate && pip install jaxphoto": _INSTALLS},
    "docs/install.md": {
        "pip install 'jaxphoto'\n": _INSTALLS,
    },
    "docs/solver.md": {
        "srun --cpus-per-task=32 --cpu-bind=cores python adjust_block.py\n": "wants a cluster with Slurm"
    },
}


# Whose blocks are of `py`, which does not run: they want several processes, as tests/adjustment/test_shards.py has.
PYTHON_NOT_RUN = ("docs/solver.md",)
# Pages whose blocks run in a test of their own, which looks at what comes out.
ELSEWHERE = {
    "docs/half_an_hour.md": "test_half_an_hour.py",
    "docs/papers.md": "test_commands_on_pages.py",
}
_FIRST = f"""cp -r "{ROOT}/examples" .
made_photographs() {{ PYTHONPATH="{ROOT}" python -m tests.docs.made_photographs "$@"; }}
"""


def languages(page: Path) -> set[str]:
    """Of the blocks of a page."""
    return {language for language, _ in _LISTING.findall(page.read_text(encoding="utf-8"))}


def listings(page: Path) -> list[str]:
    """The blocks of a page that are for a shell; of those without a language what may be left out is left out."""
    found = []
    for language, text in _LISTING.findall(page.read_text(encoding="utf-8")):
        if not language and _COMMAND.search(text):
            while _OPTIONAL.search(text):
                text = _OPTIONAL.sub("", text)
        if language in ("sh", "bash") or (not language and _COMMAND.search(text)):
            found.append(text)
    return found


def script(page: Path) -> str:
    """All blocks of a page, with what makes their inputs before them; empty if none of them runs."""
    text, name = "".join(listings(page)), page.relative_to(ROOT).as_posix()
    given = GIVEN.get(name, Given(""))
    left_out = dict.fromkeys(NOT_RUN.get(name, {}), "")
    for piece, instead in (left_out | given.words).items():
        assert piece in text, f"{name} has no {piece!r} for tests/docs/shell_blocks.py"
        text = text.replace(piece, instead)
    return f"{_FIRST}{given.made_by}\n{text}" if text.strip() else ""
