"""The block that turns, and the page around it: complete without a script, and whole without a network."""

import base64
import gzip
import json
import re
import shutil
import subprocess

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import Tables
from jaxphoto.report import block_in_space, page_head, report_page, verdict_of
from jaxphoto.report.block_in_space import _far
from jaxphoto.report.block_places import places_of, pyramids
from jaxphoto.report.document import BlockInSpace, Document, Heading, Paragraph, Rows
from jaxphoto.report.document_html import html_of, html_page
from jaxphoto.report.document_pdf import _BLANK, _FIGURE, _INNER, _READABLE, _widths, pdf_of
from jaxphoto.report.error_ellipsoids import ellipsoid_mesh
from jaxphoto.report.findings import as_sentence, in_symbols
from jaxphoto.report.interactive import measurements
from jaxphoto.report.study_page import study_page
from tests.blocks import adjusted, simulated

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def tables():
    return Tables(adjusted("cross"))


@pytest.fixture(scope="module")
def page(tables):
    return report_page(tables, verdict_of(tables))


def unpacked(page: str, name: str) -> str:
    (content,) = re.findall(rf'id="{name}">([^<]*)</script>', page)
    return gzip.decompress(base64.b64decode(content)).decode()


def numbers(packed: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"])


def traces(figure) -> dict:
    return {trace.name.split(",")[0]: trace for trace in figure.data}


def test_the_figure_has_what_the_block_has(tables):
    a = tables.adjusted
    found = traces(block_in_space(a, tables.covariance))
    stations = np.stack([found["camera stations"][axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(stations, np.asarray(a.unknowns.exterior.position), rtol=1e-6, atol=1e-3)
    assert tuple(found["camera stations"].text) == a.block.images
    shown = [*found["object points"].text, *found["control points"].text, *found["check points"].text]
    assert sorted(shown) == sorted(a.block.points)
    assert {"images", "observed minus adjusted positions", "error ellipsoids"} <= set(found)
    start = traces(block_in_space(simulated("cross").block))
    assert "camera stations" in start and "error ellipsoids" not in start


@pytest.mark.parametrize("name", ["fixed_interior", "inner", "everything"])
def test_blocks_of_any_kind_have_a_figure(name):
    a = adjusted(name)
    found = traces(block_in_space(a, Tables(a).covariance))
    assert ("observed minus adjusted positions" in found) == bool(len(a.block.stations.who))


def test_what_diverged_is_drawn_as_far_as_it_has_numbers(tables):
    points = np.asarray(tables.adjusted.unknowns.points).copy()
    points[:3] = [np.nan, np.inf, 1e200]
    lost = eqx.tree_at(lambda a: (a.unknowns.points, a.residuals.image), tables.adjusted,
                       (points, np.asarray(tables.adjusted.residuals.image) * np.nan))  # fmt: skip
    assert len(block_in_space(lost, tables.covariance).to_json()) > 1000
    json.dumps(measurements(lost), allow_nan=False)


def test_coordinates_far_from_zero_are_shown_less_a_round_number(tables, monkeypatch):
    of = lambda a: (a.unknowns.points, a.unknowns.exterior.position)  # noqa: E731
    shift = np.array([512_000.0, 5_403_000.0, 0.0])
    far = eqx.tree_at(of, tables.adjusted, [np.asarray(v) + shift for v in of(tables.adjusted)])
    figure = block_in_space(far)
    less = float(re.fullmatch(r"X - (\d+) \[m\]", figure.layout.scene.xaxis.title.text)[1])
    assert figure.layout.scene.zaxis.title.text == "Z [m]"
    x = traces(figure)["camera stations"].x
    np.testing.assert_allclose(x, np.asarray(far.unknowns.exterior.position)[:, 0] - less, atol=1e-3)


def test_a_pyramid_opens_towards_what_the_image_sees(tables):
    a = tables.adjusted
    s = a.structure
    seen = np.asarray(a.unknowns.points)[s.point]
    for image, line in enumerate(pyramids(a, places_of(a), 10**6)):
        centre, corners = line[5], line[:4]
        assert ((seen[s.image == image] - centre) @ (corners.mean(axis=0) - centre) > 0).all()


def test_ellipsoids_have_the_size_and_directions_of_their_covariance():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 3, 3))
    covariance, centre = root @ root.transpose(0, 2, 1), rng.normal(size=(5, 3))
    corners, triangles = ellipsoid_mesh(centre, covariance)
    d = corners.reshape(5, -1, 3) - centre[:, None]
    np.testing.assert_allclose(np.einsum("nci,nij,ncj->nc", d, np.linalg.inv(covariance), d), 1.0)
    # A closed surface: every edge belongs to two triangles, in opposite senses.
    edges = [tuple(edge) for t in triangles for edge in (t[:2], t[1:], t[[2, 0]])]
    assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
    flat, _ = ellipsoid_mesh(np.zeros((1, 3)), np.diag([4.0, 1.0, 0.0])[None])
    assert np.abs(flat[:, 2]).max() == 0 and np.abs(flat[:, 0]).max() <= 2


def test_the_page_holds_every_residual(tables, page):
    m, a = json.loads(unpacked(page, "measurements")), tables.adjusted
    first, point = numbers(m["first"]), numbers(m["point"])
    v = numbers(m["v"]).reshape(-1, 2) * m["v_step_mm"]
    assert first[-1] == len(point) == len(a.structure.image)
    image = m["images"].index(a.block.images[3])
    mine = a.structure.image == image
    own = slice(first[image], first[image + 1])
    np.testing.assert_array_equal(point[own], a.structure.point[mine])
    residual = (np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy)).T
    pixel_mm = next(iter(a.block.sensors.values())).pixel_mm
    np.testing.assert_allclose(v[own], residual[mine], atol=max(0.0026 * pixel_mm, np.abs(residual).max() / 60_000))


def test_the_eye_goes_back_from_what_is_high_or_long_and_no_ellipsoid_hides_the_block(tables):
    def eye(size):
        at = np.diag(np.asarray(size, float))
        return _far([dict(zip("xyz", at, strict=True))])

    assert eye([3000, 3000, 1000]) == 1 and eye([5, 2, 12]) > 1.3 and eye([20_000, 500, 300]) > 3
    assert eye(np.zeros(3)) >= 1 and _far([]) == 1
    points = np.array(tables.covariance.points)
    points[:2] *= 1e6
    wild = eqx.tree_at(lambda c: c.points, tables.covariance, points)
    names = [trace.name for trace in block_in_space(tables.adjusted, wild).data]
    assert any("without end or too large to show" in name for name in names)


def test_of_very_many_image_points_a_part_is_held(tables, monkeypatch):
    n = len(tables.adjusted.structure.image)
    monkeypatch.setattr("jaxphoto.report.interactive._MOST", n // 3)
    held = measurements(tables.adjusted)
    assert n // 5 <= len(numbers(held["point"])) <= n // 3
    assert numbers(held["first"])[-1] == len(numbers(held["point"]))


def test_a_page_is_whole_without_a_network_and_complete_without_a_script(tables, page):
    assert "Plotly" in unpacked(page, "plotly") and page.count('type="module"') == 1
    assert not re.search(r'(src|href)="(?!data:|#)|@import|url\(', page)
    links = re.findall(r'<a href="#([^"]+)">', page)
    assert links == re.findall(r'<h2 id="([^"]+)">', page) and "block" in links
    (alt,) = re.findall(r'<figure class="block live-figure"><img alt="([^"]+)" src="data:image/png', page)
    assert f"{len(tables.adjusted.block.images)} camera stations" in alt
    assert all(f">{name}</td>" in page for name in tables.adjusted.block.images)
    assert len(page) < 4_000_000


def test_a_long_cell_on_paper_goes_on_in_the_next_line():
    cells = ("options", "a long one, " * 40)
    wide = _widths([["", word] for word in cells])
    size = _INNER * 72 / (_FIGURE * sum(wide))
    assert size >= _READABLE and wide[0] == len("options") + _BLANK
    # Numbers are not cut, whatever the size of type.
    assert _widths([["", "1234567890"]] * 30) == [10 + _BLANK] * 30
    # Those that are alike stay so.
    assert np.ptp(_widths([["0.01 (0.02)"]] * 9)) <= 1


def test_on_paper_the_plan_stands_for_the_block(tables):
    document = Document("A block", "foot", (BlockInSpace(tables),))
    assert pdf_of(document).startswith(b"%PDF")
    assert re.search(r"@media print.*\.plot.*display: none", page_head("x"), re.DOTALL)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium to open the page with")
def test_numbers_sort_as_numbers_and_rows_are_filtered(tmp_path):
    """A script at the end of the page presses heads and writes into the filter; what came of it is in the page."""
    cells = ["-1.5e-3", "", "2 mm", "10", "-20", "0.5 +- 1", *map(str, range(100, 110))]
    document = Document("t", "", (Rows(("photograph", "v"), tuple((f"a{k}", c) for k, c in enumerate(cells))),))
    press = """<script type="module">
      const [name, v] = document.querySelectorAll("th button"), told = () => [...document.querySelectorAll("tbody tr")]
        .filter((row) => !row.hidden).map((row) => row.cells[1].textContent).join("|");
      const out = [];
      v.click(); out.push(told());
      v.click(); out.push(told(), v.parentElement.ariaSort);
      name.click(); out.push(told());
      const field = document.querySelector(".filter input");
      field.value = "a1 a10"; field.dispatchEvent(new Event("input")); out.push(told());
      document.body.dataset.told = out.join(";");
    </script>"""
    (tmp_path / "page.html").write_text(html_page(document) + press)
    command = [BROWSER, "--headless", "--no-sandbox", "--dump-dom", f"--user-data-dir={tmp_path / 'user'}"]
    done = subprocess.run([*command, f"file://{tmp_path}/page.html"], capture_output=True, text=True, timeout=120)
    (told,) = re.findall('data-told="([^"]*)"', done.stdout)
    up, down, sorted_as, by_name, kept = told.split(";")
    values = ["-20", "-1.5e-3", "0.5 +- 1", "2 mm", "10", *map(str, range(100, 110))]
    assert up.split("|") == [*values, ""]
    assert down.split("|") == [*values[::-1], ""] and sorted_as == "descending"
    assert by_name.split("|") == cells
    assert kept.split("|") == ["104"]


def test_long_tables_scroll_in_a_box_of_their_own():
    long, short = (html_of(Rows(("a",), (("1",),) * n)) for n in (100, 5))
    assert 'class="wide long" tabindex="0"' in long and "long" not in short


def test_nothing_of_a_page_is_sent_anywhere(page):
    assert "showSendToCloud: false" in page and 'plotlyServerURL: ""' in page


def test_sentences_of_a_study_come_before_its_contents_and_hashes_may_break():
    parts = [Paragraph("first"), Heading("One"), Paragraph("later"), Heading("Two"), Rows(("SHA-256",), ((64 * "a",),))]
    written = study_page("Study", ["said"], parts)
    places = [written.index(text) for text in ("Said.", ">first<", "<nav>", ">later<", '<td class="text hash">')]
    assert places == sorted(places)


def test_sentences_begin_with_capitals_but_symbols_stay():
    assert [as_sentence(text) for text in ("amber: one", "c of it", "x_p of it", "k2 of it.")] == [
        "Amber: one.", "c of it.", "x_p of it.", "k2 of it.",
    ]  # fmt: skip
    assert in_symbols("hold interior[one].c_mm or strips[A].shift_X_m") == "hold c of camera one or strips[A].shift_X_m"


@pytest.mark.skipif(BROWSER is None, reason="needs chromium to print")
@pytest.mark.slow
def test_in_print_no_figure_is_taller_than_a_sheet(tmp_path):
    """A figure of 3 m height, and a heading that would stand at the foot of the first sheet."""
    tall = '<svg xmlns="http://www.w3.org/2000/svg" width="900" height="9000"><rect width="900" height="9000"/></svg>'
    source = base64.b64encode(tall.encode()).decode()
    body = f'<h2>One</h2><img alt="tall" src="data:image/svg+xml;base64,{source}">'
    (tmp_path / "page.html").write_text(f"{page_head('Tall')}<body>{body}</body></html>", encoding="utf-8")
    out = tmp_path / "page.pdf"
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--print-to-pdf={out}", tmp_path / "page.html"]
    subprocess.run([*map(str, command)], check=True, capture_output=True, timeout=120)
    assert len(re.findall(rb"/Type\s*/Page\b", out.read_bytes())) == 1
