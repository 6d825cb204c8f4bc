"""The result folder of an adjustment: tables, summary.json and the report."""

import itertools
import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment, Outcome
from jaxphoto.block import Block
from jaxphoto.camera import RATES, InteriorOrientation, Sensor, get_parameter, model_keys, parameter_names, sensor_keys
from jaxphoto.compiling.freed_memory import return_freed_memory
from jaxphoto.errors import InputError, camera_words, counted
from jaxphoto.observations import AXES
from jaxphoto.report import plots
from jaxphoto.report.block_plot import block_words, plot_block
from jaxphoto.report.findings import Verdict, as_sentence, p_words
from jaxphoto.report.formatting import (
    check_table_format,
    of_sigma,
    plus_minus,
    readable,
    symbol,
    with_sigma,
    without_empty,
    without_powers,
    write_table,
)
from jaxphoto.report.page import (
    CommandRecord,
    Folded,
    Heading,
    Matrix,
    Paragraph,
    Part,
    Plot,
    page,
    provenance,
    verdict_parts,
    versions,
)
from jaxphoto.report.residual_findings import component_tables
from jaxphoto.report.tables import (
    Tables,
    check_spread,
    recovery_spread,
    side_by_side,
)
from jaxphoto.statistics import LEVEL, VarianceComponents, global_test
from jaxphoto.statistics.block_geometry import format_coverage
from jaxphoto.unknowns import Weighted
from jaxphoto.writing import whole_folder

_TABLES = (
    "interior", "exterior", "object_points", "residuals", "trends", "check_points",
    "correlation", "correlation_summary", "correlation_ground", "sigma_map", "convergence",
)  # fmt: skip
# Additional tables if the files of the block are in an EPSG system.
_MAP_TABLES = ("exterior_map", "object_points_map")
# Maximum numbers: plotted cameras, rows of the largest residuals, rows of the iteration history, findings at the top.
_PLOTTED, _LARGEST, _STEPS, _TOP = 6, 12, 40, 3
# Height of a plan (inches).
_PLAN = 3.0
_RELIABILITY = {
    "c_moves": "effect on c [sigma]", "xp_moves": "on x_p [sigma]", "yp_moves": "on y_p [sigma]",
    "most_moves": "largest effect [sigma]", "redundancy_number": "r", "detectable": "MDB",
}  # fmt: skip
_EFFECTS = {"pattern": "systematic effect", "freedom": "degrees of freedom", "share": "fraction", "amount": "estimate"}
# Classes in the table of object points: minimum number of rays of each class.
_RAYS = (2, 3, 4, 6, 11, 21)
_SMALL_DEG = 2.0
# Square metres; numbers of covering images in the summary.
_HECTARE, _COVERED_BY = 1e4, (1, 2, 5)


# Files -----------------------------------------------------------------------------------------------------------


def write_results(
    tables: Tables,
    verdict: Verdict,
    directory: Path,
    seconds: dict[str, float],
    entries: Mapping[str, Any] = MappingProxyType({}),
    record: CommandRecord | None = None,
    *,
    with_page: bool = True,
    components: VarianceComponents | None = None,
) -> None:
    """Write the files of docs/block_folder.md into `directory`. Complete results replace earlier ones.

    summary.json contains `seconds` (read, compile, solve, covariance) and `entries` (options and inputs). `record` is
    the provenance in the report. `with_page`: write the report, which takes a third of the time. `components`: variance
    components, for their tables. Raises the errors of `whole_folder`.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        for name in table_names(tables):
            getattr(tables, name).to_csv(work / f"{name}.csv", index=False)
            # Return memory to the system: a table of millions of rows leaves hundreds of MB.
            return_freed_memory()
        for name, table in (component_tables(components) if components else {}).items():
            table.to_csv(work / f"{name}.csv", index=False)
        if with_page:
            (work / "report.html").write_text(report_page(tables, verdict, record, seconds), encoding="utf-8")
        summary = summary_of(tables, verdict, seconds | {"write": time.perf_counter() - began})
        write_summary(summary | dict(entries), work)


def table_names(tables: Tables) -> tuple[str, ...]:
    """Return the names of the tables in the result folder of an adjustment."""
    in_map = tables.adjusted.block.frame.kind == "epsg"
    drifting = any(rates.kind in tables.adjusted.unknowns.more for rates in RATES)
    return (
        *_TABLES,
        *(("camera_drift",) if drifting else ()),
        *(_MAP_TABLES if in_map else ()),
        *(("recovery",) if tables.truth else ()),
    )


def write_tables(tables: Tables, directory: str | Path, kind: str = "csv", names: Sequence[str] = ()) -> None:
    """Write all tables of an adjustment, or the tables `names`, as csv, parquet, markdown or latex into a folder.

    Raises InputError for an unknown format or table, and the errors of `whole_folder`.
    """
    check_table_format(kind)
    known = table_names(tables)
    if missing := [name for name in names if name not in known]:
        raise InputError(f"unknown table {missing[0]}; use one of {', '.join(known)}")
    with whole_folder(Path(directory)) as work:
        for name in names or known:
            write_table(getattr(tables, name), name, work, kind)


def write_summary(summary: dict, directory: Path) -> None:
    """Write summary.json."""
    (directory / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def summary_of(tables: Tables, verdict: Verdict, seconds: dict[str, float]) -> dict:
    """Return the content of summary.json."""
    adjusted = tables.adjusted
    observations, unknowns = adjusted.n_observations, adjusted.n_unknowns
    test = _global_test(tables)
    return {
        "title": adjusted.block.title,
        **verdict.summary,
        "converged": bool(adjusted.converged),
        "outcome": adjusted.outcome.value,
        "n_images": len(adjusted.block.images),
        "sigma0": float(adjusted.sigma0),
        **({"global_test": test} if test else {}),
        **({"prior_warnings": prior_warnings} if (prior_warnings := adjusted.block.prior_warnings) else {}),
        "redundancy": adjusted.redundancy,
        "n_observations": {"total": sum(observations.values()), **observations},
        "n_constraints": adjusted.n_constraints,
        "n_unknowns": {"total": sum(unknowns.values()), **unknowns},
        "iterations": int(adjusted.steps),
        "cameras": {
            name: sensor_keys(adjusted.block.sensors[name]) | model_keys(interior)
            for name, interior in adjusted.unknowns.interior.items()
        },
        "georeferencing": {p: {"value": v, "sigma": s} for p, v, s in tables.georeferencing.itertuples(index=False)},
        "check_points": {
            axis: {"n": int(n), "mean_m": mean, "rmse_m": rmse, "max_abs_m": most}
            for axis, n, mean, rmse, most, *_ in check_spread(tables.check_points).itertuples(index=False)
            if n
        },
        "seconds": rounded(seconds),
        "versions": versions(),
    }


def write_study(
    work: Path,
    title: str,
    verdict: tuple[str, str],
    parts: Iterable[Part],
    summary: Mapping[str, Any],
    record: CommandRecord,
    tables: Mapping[str, pd.DataFrame] = MappingProxyType({}),
) -> None:
    """Write tables (CSV), report.html and summary.json of a study into the folder `work`."""
    for name, table in tables.items():
        table.to_csv(work / f"{name}.csv", index=False)
    text = page(title, [*parts, *provenance(record)], verdict)
    (work / "report.html").write_text(text, encoding="utf-8")
    write_summary({**summary, "versions": versions()}, work)


def rounded(seconds: Mapping[str, float]) -> dict[str, float]:
    """Round times to microseconds."""
    return {name: round(value, 6) for name, value in seconds.items()}


def _global_test(tables: Tables) -> dict[str, Any]:
    """Return the test of sigma naught; empty without convergence or redundancy."""
    if not bool(tables.adjusted.converged) or tables.adjusted.redundancy <= 0:
        return {}
    test = global_test(tables.adjusted, tables.redundancy)
    return {"expected_sigma0": test.expected**0.5, "p_value": test.p_value, "passed": test.p_value >= LEVEL}


# Report ----------------------------------------------------------------------------------------------------------


def report_page(
    tables: Tables,
    verdict: Verdict,
    record: CommandRecord | None = None,
    seconds: Mapping[str, float] = MappingProxyType({}),
) -> str:
    """Return the report as HTML: verdict, at most three findings, summary with times (`seconds`), then all sections."""
    block = tables.adjusted.block
    summary = summary_table(tables)
    if weights := [f.subject for f in verdict.findings if f.code == "weights"]:
        summary["standard deviations"] = f"a posteriori; those of observations estimated, times stated: {weights[0]}"
    if seconds:
        each = ", ".join(f"{name} {value:.2g} s" for name, value in seconds.items())
        summary["computing time"] = f"{sum(seconds.values()):.2g} s ({each})"
    parts: list[Part] = [*verdict_parts(verdict)[:_TOP], summary]
    if len(verdict.findings) > _TOP:
        table = verdict.table.iloc[_TOP:]
        fact = [text.removesuffix(f". {hint}") for text, hint in zip(table["text"], table["hint"], strict=True)]
        units = [f.numbers.get("unit", "") for f in verdict.findings[_TOP:]]
        columns = ["severity", "code", "value", "limit", "unit", "finding", "hint"]
        # One by one: a column has counts, probabilities and standard deviations.
        numbers = {
            name: ["" if pd.isna(v) else without_powers(f"{v:.4g}") for v in table[name]] for name in ("value", "limit")
        }
        parts += [
            Heading("Further findings"),
            without_empty(table.assign(finding=fact, unit=units, **numbers)[columns]),
        ]
    parts += adjustment_sections(tables)
    if record:
        parts += provenance(record)
        if block.converted_from:
            parts.append(Paragraph(f"The block was converted from {block.converted_from}."))
    return page(report_title(block), parts, (verdict.headline, verdict.colour))


def summary_table(tables: Tables) -> dict[str, str]:
    """Summarise images, points, flying height, camera, sigma naught, residuals, control and check points."""
    a, block = tables.adjusted, tables.adjusted.block
    rays = len(a.structure.image) / max(len(np.unique(a.structure.point)), 1)
    rows = {
        "images": str(len(block.images)),
        "object points": f"{len(block.points)}, {len(a.structure.image)} image points, {rays:.1f} rays per point",
    }
    rows |= coverage_words(tables)
    for name, interior in list(a.unknowns.interior.items())[:_PLOTTED]:
        sensor = block.sensors[name]
        rows[camera_words(name)] = (
            f"{sensor.width_px} x {sensor.height_px} px of {1e3 * sensor.pixel_mm:.4g} µm, c = {float(interior.c):.5g} "
            f"mm, {interior.projection.name}, {interior.distortion.name}"
        )
    test, sigma0, sigma, pixel = _global_test(tables), float(a.sigma0), np.asarray(a.values.sigma_xy), _pixels(a)
    rows["sigma naught"] = f"{sigma0:.6g}" + (f" = {sigma0 * np.median(sigma / pixel):.2g} px" if sigma.size else "")
    rows["sigma naught"] += f", expected {test['expected_sigma0']:.3g}, {p_words(test['p_value'], 2)}" if test else ""
    if sigma.size:
        v = np.asarray(a.residuals.image) * sigma
        mm, px = (float(np.sqrt(np.mean(values**2))) for values in (v, v / pixel))
        largest = float(np.hypot(*(v / pixel)).max())
        rows["image residuals"] = f"RMS {px:.2g} px = {1e3 * mm:.3g} µm per axis, largest {largest:.2g} px"
    counts = [f"{n} {group.replace('_', ' ')}" for group, n in a.n_observations.items() if n]
    counts += [f"{a.n_constraints} constraints of the datum"] if a.n_constraints else []
    rows["observations"] = f"{', '.join(counts)}; {sum(a.n_unknowns.values())} unknowns, redundancy {a.redundancy}"
    control = len(np.union1d(block.control.who, block.fixed.who))
    rows["control points"] = str(control) if control else "none"
    spread = check_spread(tables.check_points)
    rmse = ", ".join(f"{axis} {of_sigma(r)}" for axis, r, n in spread[["axis", "rmse", "n"]].to_numpy() if n)
    rows["check points"] = f"{len(tables.check_points)}, RMSE {rmse} m" if rmse else "none"
    rows["standard deviations"] = "a posteriori (a priori times sigma naught)"
    rows["iteration"] = as_sentence(f"{a.outcome.value} ({counted(int(a.steps), 'iteration')})")
    return rows


def coverage_words(tables: Tables) -> dict[str, str]:
    """Return coordinate system, and for near-vertical images flying height, ground sample distance and area."""
    frame, cover = tables.adjusted.block.frame, tables.coverage
    system = {"epsg": f"EPSG:{frame.code}, adjusted in a local frame"}.get(frame.kind, f"{frame.kind} frame, in metres")
    rows = {"coordinate system": system if tables.unit == "m" else "arbitrary frame and scale"}
    if cover is not None:
        low, middle, high = np.nanpercentile(cover.height_m, [0, 50, 100])
        gsd = 100 * np.nanpercentile(cover.gsd_m, [0, 50, 100])
        rows["flying height"] = f"{middle:.4g} m (median; {low:.4g} to {high:.4g} m)"
        rows["ground sample distance"] = f"{gsd[1]:.3g} cm (median; {gsd[0]:.3g} to {gsd[2]:.3g} cm)"
        areas = [f"{cover.area_m2(n) / _HECTARE:.3g} ha by {counted(n, 'image')} or more" for n in _COVERED_BY]
        rows["area covered"] = ", ".join(areas)
    return rows


def adjustment_sections(tables: Tables, start: InteriorOrientation | None = None) -> Iterator[Part]:
    """Yield all sections of an adjustment. `start`: initial camera.

    Without scale, columns in metres have the unit `Tables.unit`.
    """
    for part in _sections(tables, start):
        if isinstance(part, pd.DataFrame) and tables.unit != "m":
            yield part.rename(columns=lambda name: re.sub(r"_m$", f" [{tables.unit}]", str(name))).replace(
                {"unit": {"m": tables.unit}}
            )
        else:
            yield part


def _sections(tables: Tables, start: InteriorOrientation | None) -> Iterator[Part]:
    a, cameras = tables.adjusted, plotted_cameras(tables)
    mapped = [camera for camera in tables.sigma_maps if camera in cameras]
    yield from _interior(tables, cameras, start)
    if mapped:
        yield Heading("Distortion and projection uncertainty over the image format")
        yield Paragraph(
            "Distortion: measured minus ideal image coordinates along the radius, for the adjusted c. Projection "
            "uncertainty: standard deviation of a projected point by interior and exterior orientation in the worst "
            "direction (sigma_map.csv). At infinity the error in c propagates fully; at the object distance it is "
            "partly compensated by the camera position."
        )
        for camera in mapped:
            curve, words = plots.distortion_of(tables, camera), camera_words(camera)
            row = [Plot(partial(plots.draw_distortion, curve=curve), f"distortion of {words} by distance")]
            sensor = a.block.sensors[camera]
            for one in tables.sigma_maps[camera]:
                px = one.worst[np.isfinite(one.worst)] / sensor.pixel_mm
                spread = f"median {np.median(px):.2g} px, worst {px.max():.2g} px" if len(px) else "unknown"
                words = f"{camera_words(camera)}: sigma {plots.distance_words(one.distance_m)}, {spread}"
                row.append(Plot(partial(plots.draw_sigma_map, sensor=sensor, one=one), words))
            yield row
    if tables.truth:
        yield Heading("Recovery of the true values")
        yield Paragraph(
            "Estimate minus truth in standard deviations (recovery.csv): an RMS of about 1, and 5 % beyond 2, if the "
            "model of the adjustment is that of the simulation."
        )
        yield recovery_spread(tables.recovery)
        yield tables.recovery[tables.recovery["parameter"].str.startswith("interior[")]
    if len(tables.georeferencing):
        yield from (Heading("Mounts and strips"), tables.georeferencing)
    yield Heading("Block")
    layout = [Plot(partial(plot_block, a), block_words(a.block), _PLAN)]
    if tables.coverage is not None:
        layout.append(Plot(partial(plots.plot_overlap, tables), "overlap: images per cell of the ground", _PLAN))
    yield [*layout, Plot(partial(plots.plot_error_ellipses, tables), "error ellipses of object points", _PLAN)]
    yield from _residuals(tables, cameras)
    yield from points_section(tables)
    yield from _check_points(tables)
    yield Heading("Exterior orientation")
    yield Folded(f"{counted(len(tables.exterior), 'image')} (exterior.csv)", [tables.exterior])
    if len(tables.convergence):
        yield Heading("Convergence")
        yield Paragraph(convergence_words(a))
        steps = tables.convergence.tail(_STEPS).rename(columns={"length": "step in sigmas"})
        yield Folded("sigma naught by iteration (convergence.csv)", [steps])


def plotted_cameras(tables: Tables) -> list[str]:
    """Return the cameras to plot; of many, those with the most image points."""
    of_image = pd.Series(tables.adjusted.block.image_camera)
    most = of_image.iloc[tables.adjusted.structure.image].value_counts().index[:_PLOTTED]
    cameras = list(tables.adjusted.unknowns.interior)
    return [camera for camera in cameras if len(cameras) <= _PLOTTED or camera in most]


def interior_table(tables: Tables, start: InteriorOrientation | None = None) -> pd.DataFrame:
    """Tabulate interior parameters: initial value, estimate, sigmas before and after, significance."""
    table = tables.interior
    rows = []
    for p in table[table["sigma"].notna() | (table["value"] != 0)].to_dict("records"):
        name, pixel, sigma = p["parameter"], tables.adjusted.block.sensors[p["camera"]].pixel_mm, p["sigma"]
        first = start or tables.adjusted.block.start.unknowns.interior[p["camera"]]
        priors = tables.adjusted.priors.interior[p["camera"]]
        prior = get_parameter(priors, name) if name in parameter_names(priors) else None
        in_px = plus_minus(p["value"] / pixel, sigma / pixel) if sigma > 0 and name.endswith("_mm") else ""
        rows.append({
            "camera": p["camera"], "parameter": name,
            "initial": f"{float(get_parameter(first, name)):.6g}" if name in parameter_names(first) else "",
            "prior sigma": of_sigma(float(prior.sigma)) if isinstance(prior, Weighted) else "",
            "value": with_sigma(p["value"], sigma), "sigma": of_sigma(sigma) if sigma > 0 else "fixed",
            "unit": p["unit"], "in pixels": in_px,
            "significant": "" if name == "c_mm" else {True: "yes", False: "no"}.get(p["significant"], ""),
        })  # fmt: skip
    shown = without_empty(pd.DataFrame(rows))
    return shown if len(tables.adjusted.unknowns.interior) > 1 else shown.drop(columns="camera")


def _interior(tables: Tables, cameras: Sequence[str], start: InteriorOrientation | None) -> Iterator[Part]:
    yield Heading("Interior orientation")
    yield interior_table(tables, start)
    yield Paragraph("x to the right and y up from the centre of the format. Standard deviations are a posteriori.")
    yield from assumed_pixels(tables.adjusted.block.sensors)
    for camera in cameras:
        reached, words = format_coverage(tables.adjusted, camera), camera_words(camera)
        yield Paragraph(
            f"Image points of {words} cover {100 * reached.whole:.0f} % of the format, those of an image "
            f"{100 * np.median(reached.images):.0f} % (median; minimum {100 * reached.images.min():.0f} %): beyond, "
            "the distortion is extrapolated."
            if len(reached.images)
            else f"{words} has no image points."
        )
    if (n := len(tables.adjusted.unknowns.interior)) > len(cameras):
        some = ", ".join(cameras)
        yield Paragraph(f"Plots show {len(cameras)} of {n} cameras, those with the most image points: {some}.")
    yield from _correlations(tables, cameras)


def _correlations(tables: Tables, cameras: Sequence[str]) -> Iterator[Part]:
    shown = []
    for camera, c in tables.correlations.items():
        if camera in cameras and c.parameters:
            names = [symbol(name) for name in c.parameters]
            of_camera = f" of {camera_words(camera)}" if len(tables.correlations) > 1 else ""
            table = pd.DataFrame(c.interior, columns=names).assign(parameter=names)[["parameter", *names]]
            shown.append(Matrix(table, f"Interior orientation{of_camera}"))
    if len(summary := tables.correlation_summary):
        wide = side_by_side(summary, ["camera", "exterior"], "interior", "max_abs_rho")
        shown.append(Matrix(wide, "Exterior and interior orientation: largest |correlation| of all images"))
    ground = tables.correlation_ground
    if len(ground := ground[ground["sigma_m"] > 0]):
        named = ground.assign(ground=ground["ground"].str.replace("_", " "), sigma_m=ground["sigma_m"].map(of_sigma))
        wide = side_by_side(named, ["camera", "ground", "sigma_m"], "parameter", "rho")
        shown.append(Matrix(wide, "Interior orientation and the ground as a whole"))
    if shown:
        yield Heading("Correlations")
        yield Paragraph(f"Rotations: {tables.rotations.replace('_', ', ')}. Means: correlation_summary.csv.")
        yield shown


def _residuals(tables: Tables, cameras: Sequence[str]) -> Iterator[Part]:
    yield Heading("Residuals")
    yield tables.residual_spread
    for camera in cameras:
        panels = {"image residuals": plots.plot_residuals, "mean residuals by cell": plots.plot_mean_residuals}
        if camera in tables.sigma_maps:
            panels["residuals by distance from the principal point"] = plots.plot_residuals_by_radius
        words = camera_words(camera)
        yield [Plot(partial(plot, tables, camera), f"{name}, {words}") for name, plot in panels.items()]
    row = []
    if len(tables.checked_w):
        yield Paragraph(
            "Normalised residuals w: residual over its standard deviation. Without blunders and with true weights "
            "they are standard normal."
        )
        row += [Plot(partial(plots.plot_w, tables), "histogram of normalised residuals"),
                Plot(partial(plots.plot_w_quantiles, tables), "Q-Q plot of normalised residuals")]  # fmt: skip
    if len(tables.adjusted.block.stations.who):
        row.append(Plot(partial(plots.plot_station_residuals, tables), "residuals of stations in order of time"))
    yield row
    if len(tables.trends):
        yield Paragraph(
            "Systematic residuals, by image format, time and strip. Fraction: part of the sum of squares of the effect "
            "that is due to the named term."
        )
        yield without_empty(readable(tables.trends)).rename(columns=_EFFECTS)
    largest = tables.residuals.loc[tables.checked_w.abs().nlargest(_LARGEST).index]
    yield Paragraph(
        "Largest normalised residuals. r is the redundancy number. Internal reliability: MDB, the minimal detectable "
        "bias (power 80 %), in the unit of the row. External reliability: the effect of an undetected bias of one "
        "MDB on c, x_p, y_p and the most affected estimate, in its standard deviation (both a priori)."
    )
    yield readable(largest).rename(columns=_RELIABILITY)


def points_section(tables: Tables) -> Iterator[Part]:
    """Yield rays, intersection angles and standard deviations of the measured object points."""
    table = tables.object_points
    table = table[table["n_images"] > 0]
    if table.empty:
        return
    edges = pd.IntervalIndex.from_breaks([*_RAYS, math.inf], closed="left")
    names = [f"{low} to {high - 1}" if high > low + 1 else str(low) for low, high in itertools.pairwise(_RAYS)]
    rays = pd.cut(table["n_images"], edges).cat.rename_categories([*names, f"{_RAYS[-1]} or more"])
    rows = []
    for name, of in [*table.groupby(rays.rename("rays"), observed=True), ("all", table)]:
        row = {"rays": name, "points": len(of), "fraction": f"{100 * len(of) / len(table):.1f} %"}
        row["median angle [deg]"] = f"{of['angle_deg'].median():.1f}"
        row |= {f"median sigma {axis} [{tables.unit}]": of_sigma(of[f"sigma_{axis}_m"].median()) for axis in AXES}
        rows.append(row)
    small = int((table["angle_deg"] < _SMALL_DEG).sum())
    yield Heading("Object points")
    yield pd.DataFrame(rows)
    yield Paragraph(
        f"{table['n_images'].mean():.2f} rays per point on average. The angle is the largest between two rays; {small} "
        f"points have less than {_SMALL_DEG:g} degrees."
    )


def _check_points(tables: Tables) -> Iterator[Part]:
    control = tables.residuals[tables.residuals["group"] == "control_points"]
    if len(control):
        yield Heading("Control points")
        yield Paragraph(
            "Surveyed minus adjusted coordinates, the standard deviations of the adjusted coordinates, and the RMS of "
            "the image residuals per axis."
        )
        wide = control.astype({"axis": str, "point": str}).pivot_table("residual", "point", "axis", sort=False)
        wide = wide.rename(columns="d{}_m".format).assign(total_m=np.sqrt((wide**2).sum(axis=1)))
        sigma = tables.object_points.set_index("point")[[f"sigma_{axis}_m" for axis in AXES]]
        yield _with_image_residuals(wide.join(sigma.set_axis(sigma.index.astype(str))).reset_index(), tables)
    if len(tables.check_points):
        yield Heading("Check points: surveyed minus computed")
        yield check_spread(tables.check_points)
        yield [
            Plot(partial(plots.plot_check_points, tables, upright=up),
                 f"discrepancies at check points in {'height' if up else 'plan'}", _PLAN)
            for up in (False, True)
        ]  # fmt: skip
        yield _with_image_residuals(tables.check_points, tables)


def _with_image_residuals(points: pd.DataFrame, tables: Tables) -> pd.DataFrame:
    """Add the number of images and the RMS of the image residuals per axis (px) of each point."""
    a = tables.adjusted
    px = np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy) / _pixels(a)
    n = np.bincount(a.structure.point, minlength=len(a.block.points))
    square = np.bincount(a.structure.point, (px**2).sum(axis=0), len(n))
    number = points["point"].astype(str).map({str(point): k for k, point in enumerate(a.block.points)})
    rms = np.sqrt(square / np.where(n > 0, 2 * n, np.nan))
    return points.assign(images=n[number], rms_px=rms[number])


def _pixels(adjusted: Adjustment) -> np.ndarray:
    """Return the pixel size (mm) of each image point."""
    sensors = adjusted.block.sensors
    return np.array([sensors[camera].pixel_mm for camera in adjusted.block.image_camera])[adjusted.structure.image]


def convergence_words(adjusted: Adjustment) -> str:
    """Describe the number of steps and the reason for termination."""
    history, n = adjusted.history, int(adjusted.steps)
    if history is None or not n:
        return ""
    refused = int((history.accepted == 0).sum())
    words = counted(n, "step") + (f", {refused} of them rejected and repeated with more damping" if refused else "")
    last = history.length[-1] if len(history.length) == n else np.nan
    if adjusted.outcome is Outcome.CONVERGED:
        return f"{words}. Converged: the last moved no unknown by more than {last:.1e} of its standard deviation."
    if adjusted.outcome is Outcome.STEPS:
        return f"{words}, the maximum (--max-steps); the last would still move unknowns by up to {last:.2g} sigma."
    return f"{words}. {adjusted.outcome.value.partition(': ')[2]}."


def report_title(block: Block) -> str:
    """Return the title of a block and the program it was converted from."""
    name = block.title or "jaxphoto adjustment"
    return f"{name}, converted from {block.converted_from}" if block.converted_from else name


def assumed_pixel_words(sensors: Mapping[str, Sensor]) -> str:
    """Return a sentence on cameras with assumed pixel size; "" if there are none."""
    cameras = [name for name, sensor in sensors.items() if sensor.pixel_assumed]
    if not cameras:
        return ""
    which = "of every camera" if len(cameras) == len(sensors) else f"of {', '.join(cameras)}"
    return (
        f"The pixel size {which} is unknown: {sensors[cameras[0]].pixel_mm:g} mm is assumed. All camera "
        "parameters in mm or its powers scale with it; values in pixels and on the ground do not."
    )


def assumed_pixels(sensors: Mapping[str, Sensor]) -> list[Part]:
    """Return a paragraph on cameras with assumed pixel size, if there are any."""
    return [Paragraph(words)] if (words := assumed_pixel_words(sensors)) else []
