"""Commands that adjust a block and assess the result."""

import math
import os
import time
from pathlib import Path
from threading import Thread
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output

PANEL = "Adjustment and assessment"
_EXAMPLE = "jaxphoto example cross_block && "
_ADJUSTED = f"{_EXAMPLE}jaxphoto adjust cross_block --out results && "
_BIASES = Literal[
    "station", "attitude", "trajectory", "trajectory-attitude", "control", "image-points", "lever-arm", "boresight",
    "interior", "noise"
]  # fmt: skip
# Biases whose standard deviation is in degrees; option of the standard deviation by unit.
_DEGREES = ("attitude", "trajectory-attitude", "boresight")
_SIGMA_OPTIONS = {"m": "--sigma-m", "deg": "--sigma-deg", "mm": "--sigma-mm", "own": "--sigma"}


@command(
    "adjust",
    PANEL,
    f"{_EXAMPLE}jaxphoto adjust cross_block --out results",
    "Earlier calibrations in block.toml may be OpenCV's and ROS' YAML, COLMAP's cameras.txt, Agisoft's XML, "
    "mrcal's .cameramodel, a SMAC report, interior.csv and block.toml.",
)
def adjust(
    output: Output,
    block: opt.Block,
    out: opt.Out,
    rotations: Annotated[
        Literal["omega_phi_kappa", "object", "camera"], Option(help="Rotation parameters of the correlations.")
    ] = "omega_phi_kappa",
    snoop: Annotated[
        bool, Option("--snoop", help="Reject outliers by data snooping; write them and the remaining block.")
    ] = False,
    robust: Annotated[
        Literal["huber", "tukey", "geman_mcclure", "student_t"] | None,
        Option(help="Reject outliers, starting from a robust adjustment with this loss."),
    ] = None,
    max_steps: opt.MaxSteps = 100,
    weights: Annotated[
        str | None,
        Option(
            help="Estimate variance components by group, or comma-separated by xy-z, axis, camera, image; or use the "
            "standard deviations as stated. Default: of the parts whose residuals contradict them."
        ),
    ] = None,
    no_report: Annotated[bool, Option("--no-report", help="Write tables only, without report.html.")] = False,
) -> None:
    """Adjust a block and write tables, statistics and a report.

    Exit code 1: results written, but the verdict is red.
    """
    import jaxphoto
    from jaxphoto import report
    from jaxphoto.io import read_block, read_truth, write_block
    from jaxphoto.losses import LOSSES
    from jaxphoto.procedures.adjust import adjust_for_tables
    from jaxphoto.procedures.snooping import inflated_components
    from jaxphoto.procedures.weights import estimate_weights
    from jaxphoto.statistics import SPLITS, prepare_hat_matrix
    from jaxphoto.writing import check_folder, whole_folder
    from jaxphoto_command.certificate import Provenance

    splits = tuple(dict.fromkeys(opt.names(weights)))
    if unknown := [name for name in splits if name not in (*SPLITS, "group") and weights != "stated"]:
        raise typer.BadParameter(f"--weights {unknown[0]}: choose from stated, group, {', '.join(SPLITS)}.")
    splits = tuple(name for name in splits if name != "group")
    check_folder(out, block)
    if not no_report:
        Thread(target=report.prepare_pictures, daemon=True).start()
    start = time.perf_counter()
    with output.progress("reading the block") as progress:
        read = read_block(block)
        provenance = Provenance.of_block(block)
        record = output.command_record(block)
        seconds = {"read": time.perf_counter() - start}
        progress.update("computing initial values")
        snooped = components = None
        masked: list[Any] = []
        if snoop or robust:
            loss = LOSSES[robust]() if robust else None
            snooped = jaxphoto.snoop(read, loss=loss, max_steps=max_steps, report=progress.update)
        adjusted = snooped.adjusted if snooped else adjust_for_tables(read, max_steps, progress.update)
        progress.update("computing statistics")
        if bool(adjusted.converged):
            prepare_hat_matrix(adjusted)
        truth = read_truth(block)
        tables = jaxphoto.Tables(adjusted, rotations, truth)  # type: ignore[arg-type]
        if weights is None and bool(adjusted.converged):
            components = estimate_weights(
                adjusted, redundancy=tables.redundancy, max_steps=max_steps, report=progress.update
            )
        elif weights != "stated" and bool(adjusted.converged):
            progress.update("estimating variance components")
            components = jaxphoto.variance_components(adjusted, splits, max_steps=max_steps)
            masked += inflated_components(adjusted, components, splits, max_steps=max_steps)
        stated = tables
        if components:
            adjusted = components.adjusted
            tables = jaxphoto.Tables(adjusted, rotations, truth)  # type: ignore[arg-type]
        findings = report.snooped_findings(snooped, read) if snooped else []
        findings += report.component_findings(components, masked, (stated, tables)) if components else []
        verdict = report.verdict_of(tables, findings)
        progress.update(f"writing {out}")
        times = adjusted.seconds | seconds
        times = {name: times[name] for name in ("read", "start", "compile", "solve", "covariance") if name in times}
        with whole_folder(out) as work:
            source = "block" if snooped else os.path.relpath(block.resolve(), out.resolve())
            entries = {"block": source, **output.options()}
            report.write_results(
                tables, verdict, work, times, entries, record, with_page=not no_report, components=components
            )
            provenance.write(read.images, work)
            if snooped:
                report.left_out_table(snooped, read).to_csv(work / "left_out.csv", index=False)
                write_block(adjusted.block, work / "block")
    report.print_adjustment(tables, verdict, output.screen)
    if components:
        report.print_components(components, output.screen)
    output.wrote(out, f"results in {out}{'' if no_report else ' (open report.html)'}")
    if verdict.severity == "error":
        raise typer.Exit(1)


@command(
    "boresight",
    PANEL,
    "jaxphoto example boresight && jaxphoto simulate boresight.toml --out flight && "
    "jaxphoto boresight flight --out boresight",
)
def boresight(
    output: Output,
    block: opt.Block,
    out: opt.Out,
    go_on: Annotated[bool, Option("--go-on", help="Continue after a step fails its test.")] = False,
    max_steps: opt.MaxSteps = 100,
) -> None:
    """Estimate the boresight misalignment in four steps.

    Exit code 1: results written, but a step failed.
    """
    from jaxphoto.io import read_block
    from jaxphoto.procedures.boresight import boresight as estimate
    from jaxphoto.report import print_boresight, write_boresight
    from jaxphoto.writing import check_folder

    check_folder(out, block)
    start = time.perf_counter()
    with output.progress("reading the block") as progress:
        read, record = read_block(block), output.command_record(block)
        seconds = {"read": time.perf_counter() - start}
        steps = estimate(read, go_on=go_on, max_steps=max_steps, report=progress.update)
        progress.update(f"writing {out}")
        write_boresight(steps, out, seconds, record)
    print_boresight(steps, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if not all(step.go_on for step in steps):
        raise typer.Exit(1)


@command("certificate", PANEL, f"{_ADJUSTED}jaxphoto certificate results --out camera.pdf")
def certificate(
    output: Output,
    results: Annotated[Path, Argument(help="Result folder of adjust or fly.")],
    out: Annotated[Path, Option(help="Certificate to write (.html or .pdf).")],
    photographs: Annotated[
        list[Path] | None, Option(help="Photographs or their folders, if not in the results.")
    ] = None,
    camera: opt.Camera = None,
) -> None:
    """Write a calibration certificate: parameters, precision, inputs."""
    from jaxphoto.io.result_tables import read_summary, reservation
    from jaxphoto.writing import check_room
    from jaxphoto_command.certificate import certificate_document, write_certificate

    if out.suffix.lower() not in (".html", ".pdf"):
        raise typer.BadParameter(f"--out {out}: give a file that ends in .html or .pdf.")
    check_room(out)
    with output.progress(f"writing {out}"):
        write_certificate(certificate_document(results, camera, photographs or []), out)
    if text := reservation(read_summary(results)):
        output.warn(text)
    output.wrote(out, f"certificate in {out}")


@command(
    "monte-carlo",
    PANEL,
    f"{_EXAMPLE}jaxphoto monte-carlo cross_block --bias station --per strip --sigma-m 0.15 --draws 1000 --out draws",
)
def monte_carlo(
    output: Output,
    block: opt.Block,
    out: Annotated[Path, Option(help="Output folder; an interrupted run in it is resumed.")],
    kind: Annotated[_BIASES, Option("--bias", help="Observations or parameters with errors.")],
    per: Annotated[str | None, Option(help="Draw one error per block, strip, image, point ...")] = None,
    sigma_m: Annotated[
        str | None, Option(help="Standard deviation (m): one number, or three, comma-separated.")
    ] = None,
    sigma_deg: Annotated[str | None, Option(help="Standard deviation (degrees) of attitude, boresight.")] = None,
    sigma_mm: Annotated[str | None, Option(help="Standard deviation (mm) of image points.")] = None,
    sigma: Annotated[str | None, Option(help="Standard deviation of the interior parameter.")] = None,
    parameter: Annotated[str, Option(help="Interior parameter (c, k1 ...) of --bias interior.")] = "",
    on: Annotated[list[str] | None, Option(help="Only this strip, image, point ... (repeatable).")] = None,
    draws: Annotated[int, Option(help="Number of draws, at most with --precision-percent.")] = 1000,
    precision_percent: Annotated[
        float | None,
        Option(min=0.0, help="Stop when the standard deviations of the estimates are known this precisely."),
    ] = None,
    seed: opt.Seed = 0,
    keep: Annotated[
        list[str] | None, Option("--with", help="Also store exterior, or points with check points (repeatable).")
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
) -> None:
    """Re-adjust a block with random errors; write draws, their statistics and a report."""
    import numpy as np

    from jaxphoto.experiment import MonteCarlo
    from jaxphoto.io import read_block
    from jaxphoto.io.draws_folder import check_place
    from jaxphoto.procedures.adjust import adjust
    from jaxphoto.report.draws import print_draws, write_draws_page
    from jaxphoto.sensitivity import Readjustment, bias, check_draws, noise
    from jaxphoto.workers import connected

    check_draws(draws)
    if invalid := set(keep or ()) - {"exterior", "points"}:
        raise typer.BadParameter(f"--with {invalid.pop()}: choose from exterior, points.")
    if seed >= 2**63:
        raise typer.BadParameter(f"--seed {seed}: give a number below 2^63.")
    if kind == "noise" and (per is not None or on or parameter):
        raise typer.BadParameter("--bias noise applies to all observations: omit --per, --on and --parameter.")
    check_place(out)
    sigmas = _sigmas(kind, {"m": sigma_m, "deg": sigma_deg, "mm": sigma_mm, "own": sigma})
    with output.progress("reading the block") as progress:
        read, record = read_block(block), output.command_record(block)
        drawn = noise(read) if kind == "noise" else bias(read, kind, sigmas, per, of=on or [], parameter=parameter)
        progress.update("adjusting the nominal block")
        adjusted = adjust(read)
        progress.update("preparing the draws")
        drawn_sigmas = np.broadcast_to(drawn.sigma, (draws, len(drawn.sigma)))
        kept = {name: name in (keep or ()) for name in ("exterior", "points")}
        run = Readjustment(adjusted, drawn.applied, drawn_sigmas, **kept)
        warn_of_contradictions(adjusted, output)
        precision = None if precision_percent is None else precision_percent / 100
        study = MonteCarlo(read, run, drawn, draws, seed, out, precision)
        with connected(workers, scheduler) as client:
            study.draw(lambda done: progress.steps("draws", done, draws, study.state), client)
        progress.update(f"writing {out}")
        summary, table = study.write()
        write_draws_page(summary, table, read.sensors, out, record)
    print_draws(summary, table, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")


def _sigmas(kind: str, values: dict[str, str | None]) -> list[float]:
    """Return the standard deviation in the units of the adjustment."""
    units = [unit for unit, text in values.items() if text is not None]
    if kind == "noise":
        if units:
            raise typer.BadParameter(f"--bias noise uses the observations' sigmas: omit {_SIGMA_OPTIONS[units[0]]}.")
        return []
    unit = "deg" if kind in _DEGREES else {"image-points": "mm", "interior": "own"}.get(kind, "m")
    option = _SIGMA_OPTIONS[unit]
    if units != [unit]:
        raise typer.BadParameter(f"--bias {kind}: give {option} and no other sigma.")
    try:
        numbers = [float(part) for part in str(values[unit]).split(",")]
    except ValueError:
        raise typer.BadParameter(f"{option} {values[unit]}: give one number, or three, comma-separated.") from None
    return [math.radians(v) for v in numbers] if unit == "deg" else numbers


@command("sensitivity", PANEL, f"{_EXAMPLE}jaxphoto sensitivity cross_block --out sensitivity")
def sensitivity(
    output: Output,
    block: opt.Block,
    out: opt.Out,
    per: Annotated[Literal["block", "strip", "image"], Option(help="Unit with a common station bias.")] = "strip",
    bias_m: Annotated[float, Option(help="Size of the station bias.")] = 0.10,
    delta0: Annotated[float, Option(help="Non-centrality parameter of the test of normalised residuals.")] = 4.13,
    max_steps: opt.MaxSteps = 100,
) -> None:
    """Compute exact effects of station errors on interior orientation and check points, and external reliability."""
    from jaxphoto.io import read_block
    from jaxphoto.procedures.adjust import adjust_for_tables
    from jaxphoto.report.sensitivity import SensitivityTables, print_sensitivity, write_sensitivity
    from jaxphoto.writing import check_folder

    if bias_m == 0 or not math.isfinite(bias_m):
        raise typer.BadParameter(f"--bias-m {bias_m:g}: give a finite bias in metres, not 0.")
    check_folder(out, block)
    start = time.perf_counter()
    with output.progress("reading the block") as progress:
        read, record = read_block(block), output.command_record(block)
        seconds = {"read": time.perf_counter() - start}
        progress.update("computing initial values")
        adjusted = adjust_for_tables(read, max_steps, progress.update)
        progress.update("differentiating")
        results = SensitivityTables(adjusted, per, bias_m, delta0)
        progress.update(f"writing {out}")
        write_sensitivity(results, out, seconds, record)
    warn_of_contradictions(adjusted, output)
    print_sensitivity(results, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")


@command("halves", PANEL, f"{_EXAMPLE}jaxphoto halves cross_block --by image --cuts 64 --out halves")
def halves(
    output: Output,
    block: opt.Block,
    out: opt.Out,
    by: Annotated[
        str, Option(help="Unit of the split: image, strip, or a partition of block.toml like day.")
    ] = "image",
    cuts: Annotated[int, Option(min=1, help="Number of random splits.")] = 64,
    seed: opt.Seed = 0,
    method: opt.Alignment = "rot",
    grid: opt.Grid = "15x11",
    extent: opt.Extent = None,
    camera: opt.Camera = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
) -> None:
    """Assess the standard deviations of a calibration by random halves of its block.

    Both halves of each split are adjusted; their differences are compared with their covariances.
    """
    from jaxphoto.extras.formats import write_camera_file
    from jaxphoto.io import read_block
    from jaxphoto.procedures.compare import camera_of
    from jaxphoto.procedures.compare import halves as compare_halves
    from jaxphoto.report.stability import print_halves, write_halves
    from jaxphoto.workers import connected
    from jaxphoto.writing import check_folder

    check_folder(out, block)
    with output.progress("reading the block") as progress:
        read, record = read_block(block), output.command_record(block)
        cells = opt.grid_points(read.sensors[camera_of(read, camera)], grid, extent)
        with connected(workers, scheduler) as client:
            result = compare_halves(
                read, cells, by=by, camera=camera, n_cuts=cuts, seed=seed, method=method, report=progress.update,
                client=client,
            )  # fmt: skip
        progress.update(f"writing {out}")
        name = result.camera

        def write_camera(folder: Path) -> object:
            interior = result.adjusted.unknowns.interior[name]
            path, sensor = folder / "camera.toml", read.sensors[name]
            return write_camera_file(path, sensor, interior, name=name, covariance=result.widened)

        write_halves(result, out, write_camera, record)
    warn_of_contradictions(result.adjusted, output)
    print_halves(result, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")


def warn_of_contradictions(adjusted: Any, output: Output) -> None:
    """Warn of the worst contradiction among the observations of an input block."""
    from jaxphoto.report import Tables, Verdict
    from jaxphoto.report.residual_findings import contradictions

    if bool(adjusted.converged):
        verdict = Verdict.of(contradictions(Tables(adjusted)))
        texts = [finding.text for finding in verdict.findings if finding.severity != "note"]
    else:
        texts = [adjusted.outcome.value]
    if texts:
        output.warn(f"input block: {texts[0]} (details: jaxphoto adjust)")
