"""Every shell block of the pages runs to the end."""

from pathlib import Path

import pytest

from tests.commands import run_script
from tests.docs.shell_blocks import (
    ELSEWHERE,
    INSTEAD,
    NOT_RUN,
    PAGES,
    PYTHON_NOT_RUN,
    ROOT,
    USERS_OWN,
    languages,
    script,
)

RUN = {page.relative_to(ROOT).as_posix(): page for page in PAGES if script(page)}
# A program that most other tests compile, and little to compute.
QUICK = ("docs/index.md",)
KINDS = {
    "photographs": [f"docs/{name}.md" for name in ("control", "photographs", "target_calibration")],
    "clouds": [f"docs/{name}.md" for name in ("boresight", "lidar_heights", "strip_adjustment")],
}
HERE = set(RUN) - set(ELSEWHERE) - {"README.md"}
OTHERS = sorted(HERE - {name for names in KINDS.values() for name in names} - set(QUICK))


@pytest.mark.parametrize("page", QUICK)
def test_blocks_run(page: str, tmp_path: Path) -> None:
    run_script(script(RUN[page]), tmp_path)


# Functions of their own, so that CI's parts of the slow tests are of one length.
@pytest.mark.slow
@pytest.mark.parametrize("page", OTHERS)
def test_blocks_with_blocks_run(page: str, tmp_path: Path) -> None:
    run_script(script(RUN[page]), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("page", KINDS["photographs"])
def test_blocks_with_photographs_run(page: str, tmp_path: Path) -> None:
    run_script(script(RUN[page]), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("page", KINDS["clouds"])
def test_blocks_with_clouds_run(page: str, tmp_path: Path) -> None:
    run_script(script(RUN[page]), tmp_path)


@pytest.mark.slow
def test_blocks_of_the_readme_run(tmp_path: Path) -> None:
    run_script(script(RUN["README.md"]), tmp_path)


def test_no_block_is_called_what_no_test_runs() -> None:
    for page in PAGES:
        known = {"", "sh", "bash", "python", "toml", "yaml", "text"}
        allowed = known | ({"py"} if page.relative_to(ROOT).as_posix() in PYTHON_NOT_RUN else set())
        assert languages(page) <= allowed, page.name


def test_what_is_declared_of_a_page_is_of_one_that_there_is() -> None:
    names = {page.relative_to(ROOT).as_posix() for page in PAGES}
    assert set(USERS_OWN) | set(INSTEAD) | set(NOT_RUN) | set(ELSEWHERE) | set(PYTHON_NOT_RUN) <= names
    for name, test in ELSEWHERE.items():
        assert Path(name).stem in (ROOT / "tests" / "docs" / test).read_text(encoding="utf-8")
