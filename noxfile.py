"""Check a clean checkout: `nox` runs every session, `nox -s suite` one, `nox -l` lists them.

The suite is README's second command and runs on the newest Python of this machine, with the newest dependencies. Every
other Python, and the oldest dependencies, run README's first command and the quick tests.
"""

import re
import shutil
import subprocess
from pathlib import Path

import nox

nox.needs_version = ">=2025.2.9"
nox.options.default_venv_backend = "uv"
# A Python that is not on this machine is reported as skipped.
nox.options.download_python = "never"
nox.options.error_on_missing_interpreters = False

PROJECT = nox.project.load_toml("pyproject.toml")
PYTHONS = nox.project.python_versions(PROJECT)


def _runs(version: str) -> bool:
    program = shutil.which(f"python{version}")
    return program is not None and subprocess.run([program, "--version"], capture_output=True).returncode == 0


NEWEST = next(filter(_runs, reversed(PYTHONS)), PYTHONS[0])
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


# The oldest Python is what the types are written for.
@nox.session(python=PYTHONS[0])
def checks(session: nox.Session) -> None:
    """Formatter, linter, types, import contracts, documentation."""
    session.install(".[dev]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("mypy")
    session.run("lint-imports")
    site = session.create_tmp()
    session.run("mkdocs", "build", "--quiet", "--strict", "--site-dir", site, env={"NO_MKDOCS_2_WARNING": "1"})


@nox.session(python=NEWEST)
def wheel(session: nox.Session) -> None:
    """The wheel alone, as a user without a checkout has it."""
    session.install("hatchling", "mypy", "pip")
    session.run(".ci/stranger", session.virtualenv.location, external=True)


@nox.session(python=NEWEST)
def suite(session: nox.Session) -> None:
    """README's two commands with the newest dependencies."""
    session.install(".[dev]")
    _run_readme_first(session)
    session.run(*_readme_command("pytest"))


@nox.session(python=NEWEST)
def slow(session: nox.Session) -> None:
    """A sixth of the slow tests, in turn from commit to commit: all of them take too long."""
    session.install(".[dev]")
    count = subprocess.run(["git", "rev-list", "--count", "HEAD"], capture_output=True, text=True).stdout.strip()
    session.run(*_readme_command("pytest"), "-m", "slow", "--part", f"{int(count or 0) % 6 + 1}/6")


@nox.session(python=[version for version in PYTHONS if version != NEWEST])
def other(session: nox.Session) -> None:
    """README's first command and the quick tests on another Python, with the newest dependencies."""
    session.install(".[dev]")
    _run_readme_first(session)
    _run_quick(session)


@nox.session(python=PYTHONS[0])
def lowest(session: nox.Session) -> None:
    """README's first command and the quick tests with the oldest dependencies that pyproject.toml allows."""
    session.install("--resolution", "lowest-direct", ".[dev]")
    _run_readme_first(session)
    _run_quick(session)
