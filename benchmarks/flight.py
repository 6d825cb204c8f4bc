"""CPU seconds of every step from photographs to a calibrated block, ours beside COLMAP's (pycolmap with its defaults).

python benchmarks/flight.py FOLDER [--photographs 15] [--pairs exhaustive | position:20 | sequence:5] [--out DIR]

CPU seconds are user and system of all threads and child processes. "Verified matches" lie on the epipolar lines of
their pair; of COLMAP they are the inliers of its two-view geometries. Both compare the same pairs where they are
exhaustive; else COLMAP's own matching of neighbours with as many of each.
"""

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from machine import machine, markdown, memory, run_here, sentence, write_results

STEPS = ("features", "matches", "orientation", "adjustment", "report")
"""COLMAP's mapping is orientation and adjustment in one."""
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, help="the first so many of the folder (default: all)")
    parser.add_argument("--pairs", default="exhaustive")
    parser.add_argument("--features", type=int, help="of a photograph, of ours (default: ours)")
    parser.add_argument("--without", action="append", default=[], choices=list(PROGRAMS))
    parser.add_argument("--only-matches", action="store_true", help="end after the matches")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--program", choices=list(PROGRAMS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.program:
        print(json.dumps(PROGRAMS[arguments.program](arguments)))
        return
    head, records = machine(), []
    options = ["--pairs", arguments.pairs] + (["--only-matches"] if arguments.only_matches else [])
    for name in ("photographs", "features"):
        if getattr(arguments, name):
            options += [f"--{name}", str(getattr(arguments, name))]
    for program in PROGRAMS:
        if program not in arguments.without:
            records += run_here("flight.py", arguments.folder, "--program", program, *options)
    title = f"{arguments.folder.name}, {records[0]['photographs']} photographs, {arguments.pairs}"
    write_results(arguments.out, "flight", records, f"{sentence(head)}\n\n### {title}\n\n" + table(records))


def table(records: list[dict]) -> str:
    """One column a program."""
    rows = [[f"{step} [CPU s]", *(f"{r['cpu'].get(step, 0):.1f}" for r in records)] for step in STEPS]
    rows.append(["all [CPU s]", *(f"{sum(r['cpu'].values()):.1f}" for r in records)])
    for name in ("wall [s]", "peak memory [MB]", "features", "pairs", "pairs kept", "verified matches"):
        rows.append([name, *(f"{r.get(name, 0):.0f}" for r in records)])
    rows.append(["verified matches a CPU s", *(f"{_rate(r, 'verified matches', STEPS[:2]):.0f}" for r in records)])
    for name in ("image points", "points", "images oriented"):
        rows.append([name, *(f"{r.get(name, 0):.0f}" for r in records)])
    rows.append(["image points a CPU s", *(f"{_rate(r, 'image points', STEPS):.0f}" for r in records)])
    rows.append(["mean residual [px]", *(f"{r.get('mean px', 0):.2f}" for r in records)])
    return "\n".join(markdown(["", *(r["program"] for r in records)], rows))


def _rate(record: dict, name: str, steps: tuple[str, ...]) -> float:
    return record.get(name, 0) / max(sum(record["cpu"].get(step, 0) for step in steps), 1e-9)


class _Clock:
    """CPU seconds by step, and within steps by what a program says that it does."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.said: dict[str, float] = {}
        self.begin, self.start, self.doing = time.perf_counter(), _cpu(), ""
        self.last = self.start

    def step(self, name: str) -> None:
        """All since the last step was `name`."""
        self.tell("")
        self.seconds[name] = _cpu() - self.start - sum(self.seconds.values())

    def tell(self, doing: str) -> None:
        """What is done from now on; numbers in it do not count."""
        now = _cpu()
        self.said[self.doing] = self.said.get(self.doing, 0.0) + now - self.last
        self.last, self.doing = now, " ".join(w for w in doing.split(":")[0].split() if not w.isdigit())

    @property
    def wall(self) -> float:
        return time.perf_counter() - self.begin


def _cpu() -> float:
    return sum(
        u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def ours(arguments: argparse.Namespace) -> dict:
    """As `jaxphoto fly` does it."""
    clock = _Clock()
    import jaxphoto  # noqa: F401
    from jaxphoto.camera import InteriorOrientation
    from jaxphoto.extras.photos.matching import match_photographs, photograph_pairs
    from jaxphoto.io.photographs import known_lens, sensor_and_interior, valid_photographs
    from jaxphoto.procedures.calibration import distortion_model
    from jaxphoto.procedures.flight import KnownOfFlight, calibrate_flight
    from jaxphoto.report.flight import FlightSource, report_of, write_flight

    read, spoilt = valid_photographs(_files(arguments))
    camera = sensor_and_interior(read)
    compared = photograph_pairs(read, arguments.pairs)

    def progress(what: str, done: int, of: int) -> None:
        if what == "features" and done == of:
            clock.step("features")

    matched = match_photographs(
        read,
        camera.sensor,
        camera.interior,
        compared,
        count=arguments.features,
        in_parts=True,
        progress=progress,
    )
    clock.step("matches")
    found = {
        "program": "jaxphoto",
        "photographs": len(read),
        "features": sum(map(len, matched.xy_mm)),
        "pairs": len(matched.counts),
        "pairs kept": len(matched.pairs),
        "verified matches": sum(len(p.features) for p in matched.pairs),
    }
    if not arguments.only_matches:
        distortion = distortion_model("brown", camera.sensor)
        names, start = [p.name for p in read], camera.interior

        def report(doing: str) -> None:
            if doing == "adjusting":
                clock.step("orientation")
            clock.tell(doing)

        interior = InteriorOrientation(start.c, start.xp, start.yp, distortion)
        known = KnownOfFlight(
            {p.name: p.gps for p in read},
            {p.name: p.attitude for p in read},
            lens=known_lens(read, camera, distortion),
        )
        flight = calibrate_flight(matched.named(names), camera.sensor, interior, known, report)
        clock.step("adjustment")
        reports = [report_of(part) for part in flight.parts]
        with tempfile.TemporaryDirectory() as folder:
            write_flight(flight, reports, spoilt, Path(folder), FlightSource())
        clock.step("report")
        oriented = [part.oriented.report for part in flight.parts]
        found |= {
            "image points": sum(r.n_image_points for r in oriented),
            "points": sum(r.n_points for r in oriented),
            "images oriented": sum(len(r.order) for r in oriented),
            "mean px": oriented[0].mean_px,
        }
    return found | _measured(clock)


def colmap(arguments: argparse.Namespace) -> dict:
    """pycolmap with its defaults, one camera for all."""
    clock = _Clock()
    import pycolmap

    pycolmap.logging.minloglevel = 2
    files = _files(arguments)
    folder, names = str(files[0].parent), [file.name for file in files]
    with tempfile.TemporaryDirectory() as work:
        database = f"{work}/database.db"
        cpu = pycolmap.Device.cpu
        pycolmap.extract_features(database, folder, names, pycolmap.CameraMode.SINGLE, device=cpu)
        clock.step("features")
        choice, _, number = arguments.pairs.partition(":")
        if choice == "exhaustive":
            pycolmap.match_exhaustive(database, device=cpu)
        elif choice == "position":
            pairing = pycolmap.SpatialPairingOptions(max_num_neighbors=int(number), ignore_z=True)
            pycolmap.match_spatial(database, pairing_options=pairing, device=cpu)
        else:
            pairing = pycolmap.SequentialPairingOptions(overlap=int(number), quadratic_overlap=False)
            pycolmap.match_sequential(database, pairing_options=pairing, device=cpu)
        clock.step("matches")
        with pycolmap.Database.open(database) as stored:
            _, geometries = stored.read_two_view_geometries()
            inliers = [len(g.inlier_matches) for g in geometries]
            found = {
                "program": f"COLMAP (pycolmap {pycolmap.__version__})",
                "photographs": len(names),
                "features": stored.num_keypoints(),
                "pairs": stored.num_matched_image_pairs(),
                "pairs kept": sum(n > 0 for n in inliers),
                "verified matches": sum(inliers),
            }
        if not arguments.only_matches:
            models = pycolmap.incremental_mapping(database, folder, work).values()
            clock.step("orientation")
            best = max(models, key=lambda m: m.num_reg_images(), default=None)
            if best is not None:
                found |= {
                    "image points": sum(m.compute_num_observations() for m in models),
                    "points": sum(m.num_points3D() for m in models),
                    "images oriented": sum(m.num_reg_images() for m in models),
                    "mean px": best.compute_mean_reprojection_error(),
                }
    return found | _measured(clock)


PROGRAMS: dict[str, Callable[[argparse.Namespace], dict]] = {"ours": ours, "colmap": colmap}


def _measured(clock: _Clock) -> dict:
    return {"cpu": clock.seconds, "said": clock.said, "wall [s]": clock.wall, "peak memory [MB]": memory("VmHWM")}


def _files(arguments: argparse.Namespace) -> list[Path]:
    files = sorted(file for file in arguments.folder.iterdir() if file.suffix.lower() in _SUFFIXES)
    return files[: arguments.photographs]


if __name__ == "__main__":
    main()
