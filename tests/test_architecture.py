"""The house: floors, room sizes, where pandas may live, and that every public name says what it is."""

import ast
import inspect
import shutil
import subprocess
import sys
from pathlib import Path

import jaxphoto

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "jaxphoto"
TABLES_AND_FILES = ("io", "report", "experiment", "cli")


def imported(path: Path) -> set[str]:
    """Top-level packages that a module imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0])
    return names


def test_each_floor_imports_only_floors_below():
    command = shutil.which("lint-imports", path=str(Path(sys.executable).parent)) or "lint-imports"
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 kept, 0 broken" in done.stdout


def test_modules_can_be_read_at_one_sitting():
    long = {p.name: n for p in PACKAGE.rglob("*.py") if (n := len(p.read_text().splitlines())) > 350}
    assert not long


def test_tables_pictures_and_progress_live_upstairs_only():
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] not in TABLES_AND_FILES:
            assert not imported(path) & {"pandas", "matplotlib", "rich", "typer", "jinja2"}, path


def test_no_import_hides_in_a_function():
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inner = [n for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for n in ast.walk(f)]
        hidden = [ast.unparse(n) for n in inner if isinstance(n, ast.Import | ast.ImportFrom)]
        # Those that are worth it: matplotlib takes a third of a second, and most uses draw nothing; scipy's graphs take
        # a tenth, and blocks of few images need none.
        worth_it = {"from matplotlib.figure import Figure", "from scipy.sparse import csr_matrix"}
        assert set(hidden) <= worth_it | {"from scipy.sparse.csgraph import reverse_cuthill_mckee"}, path


def test_importing_brings_neither_tables_nor_pictures():
    late = {"pandas", "matplotlib", "rich", "typer", "jinja2", "scipy"}
    program = "import sys, jaxphoto; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not late & set(done.stdout.split())


def test_public_names_exist_and_are_documented():
    assert len(jaxphoto.__all__) < 60
    for name in jaxphoto.__all__:
        thing = getattr(jaxphoto, name)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), name
