"""The house: floors, room sizes, where pandas may live, and that every public name says what it is."""

import ast
import inspect
import shutil
import subprocess
import sys
from pathlib import Path

import jaxphoto
from jaxphoto.camera import DISTORTIONS, PROJECTIONS
from tests.marks import QUICK

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "jaxphoto"
TABLES_AND_FILES = ("io", "extras", "report", "experiment")


def imported(path: Path) -> set[str]:
    """Top-level packages that a module imports when it runs, anywhere in it."""
    names, tree = set(), ast.parse(path.read_text(encoding="utf-8"))
    only_types = [part for part in tree.body if isinstance(part, ast.If) and ast.unparse(part.test) == "TYPE_CHECKING"]
    tree.body = [part for part in tree.body if part not in only_types]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0])
    return names


def test_each_floor_imports_only_floors_below():
    command = shutil.which("lint-imports", path=str(Path(sys.executable).parent)) or "lint-imports"
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 kept, 0 broken" in done.stdout


def test_tables_pictures_and_progress_live_upstairs_only():
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] not in TABLES_AND_FILES:
            assert not imported(path) & {"pandas", "matplotlib", "plotly", "rich", "typer", "jinja2"}, path


def test_importing_brings_neither_tables_nor_pictures():
    late = {"pandas", "matplotlib", "plotly", "rich", "typer", "jinja2", "scipy"}
    program = "import sys, jaxphoto; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not late & set(done.stdout.split())


def test_parts_of_scipy_are_loaded_where_they_are_used():
    """Each takes a tenth of a second and more."""
    program = "import sys, jaxphoto.io, jaxphoto.procedures, jaxphoto.sensitivity; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    parts = {f"scipy.{name}" for name in ("interpolate", "linalg", "ndimage", "optimize", "sparse", "spatial", "stats")}
    assert not parts & set(done.stdout.split())


def test_public_names_exist_and_are_documented():
    assert len(set(jaxphoto.__all__)) == len(jaxphoto.__all__)
    for name in jaxphoto.__all__:
        thing = getattr(jaxphoto, name)
        # What others made is imported from them, and a module is no public name beside what is in it.
        assert not inspect.ismodule(thing), name
        assert not callable(thing) or thing.__module__.split(".")[0] == "jaxphoto", name
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), name


def test_the_quick_tests_are_of_every_room_and_there():
    rooms = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()}
    assert set(QUICK) == rooms - {"__init__"} | {"jaxphoto_command"}
    for test in (test for tests in QUICK.values() for test in tests):
        path, _, name = test.partition("::")
        assert f"def {name.split('[')[0] or 'test_'}" in (ROOT / "tests" / path).read_text(encoding="utf-8"), test


def test_what_is_declared_is_public():
    models = {*DISTORTIONS.values(), *PROJECTIONS.values()}
    assert {model.__name__ for model in models} <= set(jaxphoto.__all__)
    assert all(getattr(jaxphoto, model.__name__) is model for model in models)
    for folder, known in (("distortion", DISTORTIONS), ("projection", PROJECTIONS)):
        files = {path.stem for path in (PACKAGE / "camera" / folder).glob("*.py")} - {"__init__", "base"}
        assert {model.__module__.split(".")[-1] for model in known.values()} == files
