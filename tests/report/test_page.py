"""Pages are self-contained, complete without a script, and print."""

import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

from jaxphoto import Tables
from jaxphoto.report import report_page, verdict_of
from jaxphoto.report.block_plot import places_of, pyramids
from jaxphoto.report.findings import as_sentence, in_symbols
from jaxphoto.report.page import Heading, Paragraph, Plot, html, page
from tests.blocks import adjusted

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
NEEDS_BROWSER = pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page with")


@pytest.fixture(scope="module")
def tables():
    return Tables(adjusted("cross"))


@pytest.fixture(scope="module")
def report(tables):
    return report_page(tables, verdict_of(tables))


def test_a_pyramid_opens_towards_the_points_of_its_image(tables):
    a = tables.adjusted
    s = a.structure
    seen = np.asarray(a.unknowns.points)[s.point]
    for image, line in enumerate(pyramids(a, places_of(a), 10**6)):
        centre, corners = line[5], line[:4]
        assert ((seen[s.image == image] - centre) @ (corners.mean(axis=0) - centre) > 0).all()


def test_a_report_opens_with_verdict_and_summary_and_is_self_contained(tables, report):
    body = report[report.index("<body>") :]
    order = [body.index(text) for text in ('class="verdict', 'class="note"', "flying height", "<nav>", "<h2")]
    assert order == sorted(order)
    assert not re.search(r'<(img|script|link)[^>]*(src|href)="(?!data:)', report)
    links = re.findall(r'<a href="#([^"]+)">', body)
    assert links == re.findall(r'<h2 id="([^"]+)">', body) and "block" in links
    assert f"{len(tables.adjusted.block.images)} camera stations" in report
    assert all(f">{name}</td>" in report for name in tables.adjusted.block.images)
    labels = re.findall(r'<figure role="img" aria-label="([^"]{10,})"><svg', report)
    assert len(labels) > 10 and len(labels) == report.count('<figure role="img"')


def test_figures_are_the_same_bytes_each_time():
    plots = [html(Plot(lambda ax: ax.plot([1, 3, 2]), "a line")) for _ in range(2)]
    assert plots[0] == plots[1] and "<text" in plots[0]


@NEEDS_BROWSER
def test_numbers_sort_as_numbers_and_rows_are_filtered(tmp_path):
    """A script at the end of the page clicks on heads and writes into the filter; the result is in the page."""
    cells = ["-1.5e-3", "", "2 mm", "10", "-20", "0.5 +- 1", *map(str, range(100, 110))]
    table = pd.DataFrame({"image": [f"a{k}" for k in range(len(cells))], "v": cells})
    press = """<script type="module">
      const [name, v] = document.querySelectorAll("th button"), shown = () => [...document.querySelectorAll("tbody tr")]
        .filter((row) => !row.hidden).map((row) => row.cells[1].textContent).join("|");
      const out = [];
      v.click(); out.push(shown());
      v.click(); out.push(shown(), v.parentElement.ariaSort);
      name.click(); out.push(shown());
      const field = document.querySelector("input.filter");
      field.value = "a1 a10"; field.dispatchEvent(new Event("input")); out.push(shown());
      document.body.dataset.shown = out.join(";");
    </script>"""
    (tmp_path / "page.html").write_text(page("t", [table]) + press)
    command = [BROWSER, "--headless", "--no-sandbox", "--dump-dom", f"--user-data-dir={tmp_path / 'user'}"]
    done = subprocess.run([*command, f"file://{tmp_path}/page.html"], capture_output=True, text=True, timeout=120)
    (shown,) = re.findall('data-shown="([^"]*)"', done.stdout)
    up, down, sorted_as, by_name, kept = shown.split(";")
    values = ["-20", "-1.5e-3", "0.5 +- 1", "2 mm", "10", *map(str, range(100, 110))]
    assert up.split("|") == [*values, ""]
    assert down.split("|") == [*values[::-1], ""] and sorted_as == "descending"
    assert by_name.split("|") == cells
    assert kept.split("|") == ["104"]


def test_tables_are_escaped_long_ones_scroll_and_numbers_are_on_the_right():
    long, short = (html(pd.DataFrame({"a": [1.0] * n})) for n in (100, 5))
    assert 'class="wide long"' in long and "long" not in short
    columns = {"name": ["<a>", "b", "c"], "n": ["-1.5 px", "", "3"], "why": ["two of them", "cut off", "blank"]}
    text = html(pd.DataFrame(columns))
    assert "&lt;a&gt;" in text and text.count('class="number') == 4 and text.count('class="text') == 8


def test_paragraphs_before_the_first_heading_stand_above_the_contents():
    parts = [Paragraph("first"), Heading("One"), Paragraph("later"), Heading("Two")]
    written = page("Study", parts, ("verdict", "green"))
    places = [written.index(text) for text in ("Verdict.", ">first<", "<nav>", ">later<")]
    assert places == sorted(places)


def test_sentences_begin_with_capitals_but_symbols_stay():
    assert [as_sentence(text) for text in ("amber: one", "c of it", "x_p of it", "k2 of it.", "all is well.")] == [
        "Amber: one.", "c of it.", "x_p of it.", "k2 of it.", "All is well.",
    ]  # fmt: skip
    assert in_symbols("hold interior[one].c_mm or strips[A].shift_X_m") == "hold c of camera one or strips[A].shift_X_m"


@NEEDS_BROWSER
@pytest.mark.parametrize("width", [1400, 800, 500])
def test_no_page_is_wider_than_its_window(report, tmp_path, width):
    """A browser window is never narrower than 500 px."""
    measure = (
        "<script>onload = () => { document.body.dataset.over = "
        "document.documentElement.scrollWidth - innerWidth }</script>"
    )
    (tmp_path / "page.html").write_text(report + measure)
    command = [BROWSER, "--headless", "--no-sandbox", "--dump-dom", f"--user-data-dir={tmp_path / 'user'}"]
    command += [f"--window-size={width},900", "--virtual-time-budget=3000", f"file://{tmp_path}/page.html"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    (over,) = re.findall('data-over="([^"]*)"', done.stdout)
    assert int(over) <= 0
