"""Exceptions of the shell blocks of the pages, in one place: what only the user has, what does not run, and why.

The blocks of a page run one after another in one folder and make their inputs by `jaxphoto example`.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.md")])
_LISTING = re.compile(r"^```([a-z]*)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^(?:jaxphoto|pip|python3?) (?!.*: )", re.MULTILINE)
_OPTIONAL = re.compile(r"\[[^\[\]]*\]")


# What pages take for given: a clone of the repository, and data that only the user has.
USERS_OWN = {"README.md": "examples", "docs/formats.md": "$JAXPHOTO_DATA"}

# Words of a page, and what runs in their place.
INSTEAD = {
    "docs/boresight.md": {
        # The verdict on so small a flight may be red.
        "--out JOINT": "--knots-s 5 --out JOINT || test $? = 1",
        "--out ADJUSTED": "--out ADJUSTED || test $? = 1",
        "--out DRAWS": "--draws 20 --out DRAWS",
    },
    "docs/solver.md": {"python my_script.py": "python -c 'import jaxphoto'"},
    "docs/stability.md": {"--cuts 64": "--cuts 8"},
    "README.md": {".venv/bin/": ""},
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
    """All blocks of a page; empty if none of them runs."""
    text, name = "".join(listings(page)), page.relative_to(ROOT).as_posix()
    left_out = dict.fromkeys(NOT_RUN.get(name, {}), "")
    for piece, instead in (left_out | INSTEAD.get(name, {})).items():
        assert piece in text, f"{name} has no {piece!r} for tests/docs/shell_blocks.py"
        text = text.replace(piece, instead)
    return f'cp -r "{ROOT}/examples" .\n{text}' if text.strip() else ""
