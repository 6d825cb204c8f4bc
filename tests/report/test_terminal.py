"""Names of files are literal text on the terminal and in plots."""

import dataclasses
import io

import pytest
from rich.console import Console

from jaxphoto import Tables
from jaxphoto.report import Finding, Verdict, plot_residuals, print_adjustment
from jaxphoto.report.plots import label, new_figure
from tests.blocks import adjusted

NAMES = ("[/red]", "[bold]x", ":smile:", "$\\frac{1$", "a$b$c", "\\$", "\x1b[31mred", "x_$^{")


def _camera(found):
    (one,) = found.unknowns.interior.values()
    return one


@pytest.mark.parametrize("name", NAMES)
def test_a_report_on_any_console_has_the_names(name):
    tables = Tables(adjusted("cross"))
    tables.significance = [dataclasses.replace(s, camera=name) for s in tables.significance]
    block = dataclasses.replace(tables.adjusted.block, title=name)
    unknowns = dataclasses.replace(tables.adjusted.unknowns, interior={name: _camera(tables.adjusted)})
    tables.adjusted = dataclasses.replace(tables.adjusted, block=block, unknowns=unknowns)
    console = Console(width=200, file=io.StringIO())
    print_adjustment(tables, Verdict((Finding("message", "warning", f"image {name} is far off"),)), console)
    said = console.file.getvalue()
    plain = name.replace("\x1b", "\\x1b")
    assert said.count(plain) == 2 + len(tables.significance)


@pytest.mark.parametrize("name", NAMES)
def test_names_in_pictures_are_no_formulas(name):
    figure = new_figure(2.0, 2.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label=label(name) or "none")
    axes.set_title(label(name))
    axes.set_xticks([0.5], [label(name)])
    axes.legend()
    figure.savefig(io.BytesIO(), format="png")
    shown, formula = axes.title._preprocess_math(axes.title.get_text())
    assert not formula and shown == name.replace("\x1b", "\\x1b")


def test_the_camera_of_residuals_is_no_formula():
    tables = Tables(adjusted("cross"))
    block, name = tables.adjusted.block, "$\\frac{1$"
    block = dataclasses.replace(
        block, sensors={name: next(iter(block.sensors.values()))}, image_camera=(name,) * len(block.images)
    )
    tables.adjusted = dataclasses.replace(tables.adjusted, block=block)
    plot_residuals(tables, name, new_figure(4, 3).subplots()).figure.savefig(io.BytesIO(), format="svg")
