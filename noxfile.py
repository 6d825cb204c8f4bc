"""Check a clean checkout: `nox` runs every session, `nox -s suite` one, `nox -l` lists them.

The suite is README's second command and runs on the oldest Python with the newest dependencies. Every other Python, and
the oldest dependencies, run README's first command and the quick tests.
"""

import os
import re
import subprocess
from pathlib import Path

import nox

nox.needs_version = ">=2025.2.9"
nox.options.default_venv_backend = "uv"
# Each process that recompiles all modules takes 5 s more, and the tests start hundreds.
os.environ["UV_COMPILE_BYTECODE"] = "1"
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A Python that is not on this machine is reported as skipped.
nox.options.download_python = "never"
nox.options.error_on_missing_interpreters = False

PROJECT = nox.project.load_toml("pyproject.toml")
PYTHONS = nox.project.python_versions(PROJECT)

# The suite runs where it compiles fastest: jaxlib 0.10, the last for Python 3.11, has an older code generator.
FIRST = PYTHONS[0]
_README = Path("README.md").read_text(encoding="utf-8")


def _readme_command(program: str) -> list[str]:
    """Return the part of README's command line that runs `program` of the environment made before it."""
    return re.search(rf"^python3 .*&& \.venv/bin/({program} .*)$", _README, re.MULTILINE)[1].split()


def _run_readme_first(session: nox.Session) -> None:
    command = _readme_command("jaxphoto")
    results = session.create_tmp()
    session.run(*command[:-1], f"{results}/results", env={"XDG_CACHE_HOME": results})


def _run_quick(session: nox.Session) -> None:
    session.run(*_readme_command("pytest"), "-m", "quick")


@nox.session(python=FIRST)
def checks(session: nox.Session) -> None:
    """Formatter, linter, types, import contracts, documentation."""
    session.install(".[dev]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports")
    site = session.create_tmp()
    session.run("mkdocs", "build", "--quiet", "--strict", "--site-dir", site, env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session(python=FIRST)
def wheel(session: nox.Session) -> None:
    """Test the wheel alone, as for a user without a checkout."""
    session.install("hatchling", "mypy", "pip")
    session.run(".ci/stranger", session.virtualenv.location, external=True)


@nox.session(python=FIRST)
def suite(session: nox.Session) -> None:
    """README's two commands with the newest dependencies."""
    session.install(".[dev]")
    _run_readme_first(session)
    session.run(*_readme_command("pytest"))


@nox.session(python=FIRST)
def slow(session: nox.Session) -> None:
    """Run a sixteenth of the slow tests, by turns from commit to commit."""
    session.install(".[dev]")
    count = subprocess.run(["git", "rev-list", "--count", "HEAD"], capture_output=True, text=True).stdout.strip()
    session.run(*_readme_command("pytest"), "-m", "slow", "--part", f"{int(count or 0) % 16 + 1}/16")


@nox.session(python=[version for version in PYTHONS if version != FIRST])
def other(session: nox.Session) -> None:
    """README's first command and the quick tests on another Python, with the newest dependencies."""
    session.install(".[dev]")
    _run_readme_first(session)
    _run_quick(session)


@nox.session(python=FIRST)
def lowest(session: nox.Session) -> None:
    """README's first command and the quick tests with the oldest dependencies that pyproject.toml allows."""
    session.install("--resolution", "lowest-direct", ".[dev]")
    _run_readme_first(session)
    _run_quick(session)
