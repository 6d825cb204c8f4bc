"""Every notebook runs from top to bottom and computes what its kept outputs say."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# The kernel's sockets and loop are not ours to close.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::RuntimeWarning")
def test_runs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    kept = computed_words(notebook)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": path.parent}}
    ).execute()
    now = computed_words(notebook)
    assert [_NUMBER.sub("#", text) for text in now] == [_NUMBER.sub("#", text) for text in kept]
    for own, shown in zip(_NUMBER.findall(" ".join(now)), _NUMBER.findall(" ".join(kept)), strict=True):
        # Two of the last digit, or a tenth: programs of another optimisation round otherwise.
        digits = len(shown.partition(".")[2])
        assert abs(float(own) - float(shown)) <= max(2.01 * 10.0**-digits, 0.1 * abs(float(shown))), (own, shown)


def computed_words(notebook: nbformat.NotebookNode) -> list[str]:
    """What its cells work out to say."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [output.data["text/markdown"] for output in outputs if "text/markdown" in output.get("data", {})]
