"""What a cloud gave a block, as tables and pictures: heights as control, simultaneous adjustment, what moved."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import InputError
from jaxphoto.lidar import HeightFlag
from jaxphoto.observations import AXES
from jaxphoto.procedures.lidar import LidarControl, Round, Simultaneous
from jaxphoto.procedures.lidar.vertical_control import flag_counts
from jaxphoto.report.document import Heading, Paragraph, Rows, finding_paragraphs, rows_of, without_empty
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.made import Made, made_section
from jaxphoto.report.plots import axes_or_new, new_figure
from jaxphoto.report.results import summary_of, write_results, write_summary
from jaxphoto.report.study_page import PageLink, StudyPart, WholePicture, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import angle_differences, correlation_matrix
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_UNITS = {"_mm": "mm", "_m": "m", "_m_per_s": "m/s", "_s": "s"}
# Digits of a coordinate in metres that somebody reads.
_MM = 3
# Rows of a table that has no end.
_STRONGEST = 30
_ORDER = ("compile", "solve", "covariance")


def rounds_table(rounds: Sequence[Round]) -> pd.DataFrame:
    """round, observed, left_out, moved_m, largest_change (in standard deviations), rmse_m."""
    return pd.DataFrame(rounds, columns=["round", *Round._fields[1:]])


def heights_table(control: LidarControl) -> pd.DataFrame:
    """point, X_m, Y_m, Z_m of the adjusted point, height_m of the cloud, sigma_m, flags, used."""
    points = np.asarray(control.adjusted.unknowns.points)[control.points]
    names = np.array(control.block.points, object)[control.points]
    coordinates = {f"{axis}_m": points[:, k] for k, axis in enumerate(AXES)}
    flags = [" ".join(f.name.lower() for f in HeightFlag if f and f & int(flag) and f.name) for flag in control.flag]
    return pd.DataFrame(
        {"point": names, **coordinates, "height_m": control.height, "sigma_m": control.sigma, "flags": flags}
        | {"used": control.used}
    )


def surfaces_table(result: Simultaneous) -> pd.DataFrame:
    """point, strip, X_m, Y_m, Z_m, and by how much it lies above the surface before and after, in m."""
    block = result.adjusted.block
    points = np.asarray(result.adjusted.unknowns.points)[result.points]
    coordinates = {f"{axis}_m": points[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(
        {"point": np.array(block.points, object)[result.points]}
        | {"strip": np.array(tuple(result.scanner.shifts), object)[result.strip], **coordinates}
        | {"above_before_m": result.apart_before, "above_m": result.apart}
    )


def moved_table(result: Simultaneous) -> pd.DataFrame:
    """what, before, after, moved, sigma, unit: every parameter of cameras, scanner, mounts and strips that was free.

    Then the root mean square moves of camera stations, rotations, object points and laser points, and the distance of
    points from the surface. Sigmas are a posteriori.
    """
    after, before = result.adjusted, result.before
    sigma = np.asarray(Tables(after).covariance.shared_sigma)
    # What the block alone did not know, the scanner, was zero.
    then, now = _parameters(before), _parameters(after)
    rows: list[tuple] = []
    for label, s in zip(after.structure.labels, sigma, strict=True):
        (factor, unit), old, value = _unit(label), then.get(label, 0.0), now[label]
        name = label.replace("_rad", "_deg")
        rows.append((name, factor * old, factor * value, factor * (value - old), factor * float(s), unit))

    def rms(what: str, values: np.ndarray, unit: str) -> None:
        rows.append((what, np.nan, np.nan, float(np.sqrt(np.nanmean(np.asarray(values) ** 2))), np.nan, unit))

    exterior, points = (
        np.asarray(getter(after)) - np.asarray(getter(before))
        for getter in (lambda a: a.unknowns.exterior.position, lambda a: a.unknowns.points)
    )
    turned = np.rad2deg(angle_differences(after, before)[1])
    for k, axis in enumerate(AXES):
        rms(f"camera stations, {axis}", exterior[:, k], "m")
    for k, name in enumerate(("omega", "phi", "kappa")):
        rms(f"images, {name}", turned[:, k], "deg")
    for k, axis in enumerate(AXES):
        rms(f"object points, {axis}", points[:, k], "m")
    for k, axis in enumerate(AXES):
        rms(f"laser points, {axis}", result.moved_cloud[k : k + 1], "m")
    both = [float(np.sqrt(np.nanmean(v**2))) for v in (result.apart_before, result.apart)]
    rows.append(("points above the surface, RMSE", *both, both[1] - both[0], np.nan, "m"))
    return pd.DataFrame(rows, columns=["what", "before", "after", "moved", "sigma", "unit"])


def scanner_correlations(adjusted: Adjustment) -> pd.DataFrame:
    """parameter_a, parameter_b, rho: boresight and shifts of the scanner with each other and with the cameras."""
    known = Tables(adjusted).covariance
    first = 6 * known.n_images
    rho, labels = correlation_matrix(known)[first:, first:], known.labels[first:]
    pairs = [
        (a, b) for a, label in enumerate(labels) if label.startswith("scanner") for b in range(len(labels)) if a != b
    ]
    return pd.DataFrame(
        [(labels[a], labels[b], rho[a, b]) for a, b in pairs], columns=["parameter_a", "parameter_b", "rho"]
    )


def above_figure(result: Simultaneous) -> Figure:
    """Both pictures of `plot_above`, in the same colours."""
    figure = new_figure(10.0, 4.6)
    for axes, before in zip(figure.subplots(1, 2, sharex=True, sharey=True), (True, False), strict=True):
        plot_above(result, axes, before=before)
    return figure


def plot_above(result: Simultaneous, ax: Axes | None = None, *, before: bool = False) -> Axes:
    """By how much points lie above the cloud's surface (m), over the ground, after the adjustment or `before` it.

    Colours reach 95 % of what it is before.
    """
    ax = axes_or_new(ax)
    values = result.apart_before if before else result.apart
    rmse = f"{'before' if before else 'after'}: RMSE {float(np.sqrt(np.nanmean(values**2))):.3f} m"
    points = np.asarray(result.adjusted.unknowns.points)[result.points]
    _heights_over_ground(ax, points, values, _limit(result.apart_before), "point above the surface [m]", rmse)
    return ax


def heights_figure(control: LidarControl) -> Figure:
    """Both pictures of `plot_lidar_heights`."""
    figure = new_figure(10.0, 4.6)
    for axes, residuals in zip(figure.subplots(1, 2, sharex=True, sharey=True), (False, True), strict=True):
        if not residuals or control.used.any():
            plot_lidar_heights(control, axes, residuals=residuals)
    return figure


def plot_lidar_heights(control: LidarControl, ax: Axes | None = None, *, residuals: bool = False) -> Axes:
    """Where heights of a cloud are control, left out and refused; or the `residuals` of control (m).

    Residuals are heights of the cloud less those that were adjusted. Raises InputError for them where none is control.
    """
    points, used = np.asarray(control.adjusted.unknowns.points)[control.points], control.used
    if residuals and not used.any():
        raise InputError("no height of the cloud is control: there are no residuals to be drawn")
    ax = axes_or_new(ax)
    if residuals:
        off = (control.height - points[:, 2])[used]
        rmse = f"cloud minus adjusted: RMSE {np.sqrt((off**2).mean()):.3f} m"
        _heights_over_ground(ax, points[used], off, _limit(off), "cloud minus adjusted height [m]", rmse)
        return ax
    refused = ~np.isfinite(control.height)
    for chosen, label, colour, marker in (
        (refused, "refused", "0.6", "+"),
        (used, "control", "tab:blue", "o"),
        (~used & ~refused, "left out", "#D55E00", "x"),
    ):
        ax.plot(*points[chosen, :2].T, marker, ms=5, color=colour, ls="none", label=f"{label} ({chosen.sum()})")
    ax.legend(loc="best", fontsize=8)
    ax.set_title("heights of the cloud", loc="left", fontsize=10)
    _ground(ax)
    return ax


def _limit(off: np.ndarray) -> float:
    """How far colours reach (m)."""
    return float(np.nanpercentile(np.abs(off), 95)) or 1.0


def _heights_over_ground(
    axes: Axes, points: np.ndarray, values: np.ndarray, limit: float, label: str, title: str
) -> None:
    shown = axes.scatter(
        points[:, 0], points[:, 1], c=values, cmap="RdBu_r", vmin=-limit, vmax=limit, s=18, edgecolor="0.6"
    )
    axes.figure.colorbar(shown, ax=axes, label=label, shrink=0.8)
    axes.set_title(title, loc="left", fontsize=10)
    _ground(axes)


def _ground(axes: Axes) -> None:
    axes.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=6)


@contextmanager
def write_simultaneous(result: Simultaneous, directory: Path, seconds: dict[str, float], made: Made) -> Iterator[Path]:
    """Tables of rounds, moves, surfaces and correlations, picture, report, summary.json, the adjustment's own folder.

    Yields the folder while it is not yet in its place, for what else belongs there. Raises InputError where `directory`
    holds something that is not an earlier result.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        tables = Tables(result.adjusted)
        verdict, times = verdict_of(tables), result.adjusted.seconds
        write_results(tables, verdict, work / "adjustment", {name: times[name] for name in _ORDER}, made=made)
        rounds, moved = rounds_table(result.rounds), moved_table(result)
        rounds.to_csv(work / "rounds.csv", index=False)
        moved.to_csv(work / "moved.csv", index=False)
        surfaces_table(result).to_csv(work / "surfaces.csv", index=False)
        correlations = scanner_correlations(result.adjusted)
        correlations.to_csv(work / "scanner_correlation.csv", index=False)
        picture = WholePicture.of(above_figure(result), "points above the surface of the cloud, before and after")
        (work / "above.png").write_bytes(picture.png)
        free = moved["sigma"].notna()
        parts = (
            *finding_paragraphs(verdict),
            *(Paragraph(as_sentence(sentence)) for sentence in rounds_words(result.rounds, result.still)),
            PageLink("all results of the images", "adjustment/report.html"),
            Heading("What moved"),
            rows_of(moved[free]),
            Paragraph("By these, root mean square:"),
            rows_of(moved[~free].drop(columns="sigma")),
            picture,
            Heading("Rounds"),
            rows_of(rounds.replace(np.inf, np.nan)),
            Heading("Correlations of the scanner"),
            Paragraph("The strongest; all stand in scanner_correlation.csv."),
            rows_of(_strongest(correlations)),
            *made_section(made),
        )
        title = f"{tables.adjusted.block.title or 'Block'} and cloud, adjusted together"
        page = study_page(title, (verdict.headline,), parts, verdict.colour)
        (work / "report.html").write_text(page, encoding="utf-8")
        summary = summary_of(tables, verdict, seconds | {"write": time.perf_counter() - began})
        write_summary(summary | {"rounds": len(result.rounds), "came_to_rest": result.still}, work)
        yield work


def _strongest(correlations: pd.DataFrame) -> pd.DataFrame:
    """Of two of the scanner once."""
    names = ["parameter_a", "parameter_b"]
    again = pd.DataFrame(np.sort(correlations[names].to_numpy(str), axis=1), correlations.index).duplicated()
    kept = correlations[~again]
    strongest = kept.loc[kept["rho"].abs().sort_values(ascending=False).index[:_STRONGEST]]
    return strongest.assign(**{name: strongest[name].str.replace("_rad", "_deg") for name in names})


def rounds_words(rounds: Sequence[Round], still: bool) -> tuple[str, str]:
    """What the rounds came to, in two sentences."""
    last = rounds[-1]
    end = "nothing changes any more" if still else "it still changes: ask for more rounds"
    return (
        f"{len(rounds)} rounds, {end} (largest change {last.largest_change:.2g} standard deviations); "
        f"{last.observed} observations of the cloud, {last.left_out} left out",
        f"points lie on the cloud's surface with an RMSE of {last.rmse_m:.3f} m",
    )


def print_rounds(rounds: Sequence[Round], still: bool, console: Console) -> None:
    """The same on a screen."""
    for sentence in rounds_words(rounds, still):
        console.print(sentence, highlight=False, soft_wrap=True)


def heights_page(control: LidarControl, picture: WholePicture, made: Made) -> str:
    """The page of heights of a cloud as control: rounds, flags, picture, and the heights that differ most."""
    flags = flag_counts(control.flag)
    refused = Rows(("heights that are", "number"), tuple((name.lower(), str(n)) for name, n in flags.items()))
    parts: list[StudyPart] = [
        Heading("Over the ground"),
        picture,
        Heading("Rounds"),
        rows_of(rounds_table(control.rounds).replace(np.inf, np.nan)),
    ]
    parts += [refused] if flags else []
    heights = heights_table(control)
    heights.insert(5, "difference_m", heights["height_m"] - heights["Z_m"])
    largest = heights["difference_m"].abs().sort_values(ascending=False, na_position="last").index[:_STRONGEST]
    metres = heights.loc[largest].select_dtypes(float)
    written = {str(name): metres[name].map(f"{{:z.{_MM}f}}".format).where(metres[name].notna(), "") for name in metres}
    parts += [
        Heading("Heights that differ most"),
        rows_of(without_empty(heights.loc[largest].assign(**written))),
    ]
    parts += [Paragraph("All stand in lidar_heights.csv."), *made_section(made)]
    said = [*rounds_words(control.rounds, control.still)]
    said.append(f"{int(control.used.sum())} of {len(control.points)} tie points have a control height")
    return study_page(f"{control.block.title or 'Block'}: heights of a cloud as control", said, parts)


def print_moved(result: Simultaneous, console: Console) -> None:
    """What moved and by how much, a line each."""
    table = moved_table(result)
    numbers = table[["before", "after", "moved", "sigma"]].to_numpy(float)
    for what, unit, (before, after, moved, sigma) in zip(table["what"], table["unit"], numbers, strict=True):
        known = f" from {before:.6g} to {after:.6g}" if np.isfinite(before) else ""
        spread = f" (sigma {sigma:.2g})" if np.isfinite(sigma) else ""
        console.print(
            f"  {what}:{known} by {moved:.4g} {unit}{spread}".rstrip(), highlight=False, markup=False, soft_wrap=True
        )


def _parameters(adjusted: Adjustment) -> dict[str, float]:
    """All parameters that images share, free or not, by their paths."""
    return dict(zip(adjusted.parameters, np.asarray(adjusted.values.shared).tolist(), strict=True))


def _unit(label: str) -> tuple[float, str]:
    """From jaxphoto's unit to that shown, and its name."""
    if label.endswith("_rad"):
        return 180 / np.pi, "deg"
    return 1.0, next((unit for end, unit in _UNITS.items() if label.endswith(end)), "")
