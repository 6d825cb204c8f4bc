"""Long commands killed at random moments, on full and read-only disks, and twice at once: is anything lost?

python benchmarks/faults.py [--command NAME ...] [--kills 200] [--disks 10] [--pairs 10]

Every command runs on a small case of its own, made by the commands themselves. After each fault, what stands in the
place of its results is either what stood there before or all of the new ones, with the bytes of an undisturbed run; its
input has not changed; and nothing else is left once the next run has looked at the place. Runs are forked from a
process that has imported everything, so that moments fall into the work and not into the start of Python. No figures of
time; exit code 1 where anything was found.
"""

import argparse
import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

# Of a run that goes on where it was stopped: pieces of a killed run are its own, and another call takes them up.
_GOES_ON = {"monte-carlo"}
# Files whose bytes tell when they were made: seconds of the run.
_TIMED = {"summary.json", "report.html", ".jaxphoto.json", "run.json", "orientation.json"}
_FOLDER = "out"
# No run takes so long (s).
_ENDLESS = 600.0


class Case(NamedTuple):
    """A command on inputs below `inputs`; `out` is the last thing that it is given."""

    arguments: tuple[str, ...]
    out: str = _FOLDER


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--command", action="append", help="only these (default: all)")
    parser.add_argument("--kills", type=int, default=200, help="moments, of each command")
    parser.add_argument("--disks", type=int, default=10, help="disks that are too small, where they can be mounted")
    parser.add_argument("--pairs", type=int, default=10, help="times that a command runs twice at once")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    # Forked processes need not import it again.
    import jaxphoto_command  # noqa: F401

    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        cases = _cases(inputs)
        for name, case in cases.items():
            if arguments.command and name not in arguments.command:
                continue
            tried = Tried(name, case, inputs, Path(folder) / name, np.random.default_rng(arguments.seed))
            found = [
                *tried.killed(arguments.kills),
                *tried.small_disks(arguments.disks),
                *tried.twice_at_once(arguments.pairs),
            ]
            print(f"{name}: {tried.seconds:.1f} s a run, {tried.counts}, {len(found)} findings", flush=True)
            for text in found[:20]:
                print(f"  {text}", flush=True)
            bad += len(found)
    return int(bad > 0)


class Tried:
    """One command: an undisturbed run of it, and faults against that."""

    def __init__(self, name: str, case: Case, inputs: Path, place: Path, rng: np.random.Generator):
        self.name, self.case, self.inputs, self.place, self.rng = name, case, inputs, place, rng
        place.mkdir()
        self.given = _digests(inputs)
        self.counts: dict[str, int] = {}
        # The first run compiles.
        for _ in range(2):
            began = time.perf_counter()
            code = _ended(self.start(place))
            self.seconds = time.perf_counter() - began
            if code not in (0, 1):
                raise SystemExit(
                    f"{name}: an undisturbed run ends with exit code {code}: {' '.join(self.words(place))}"
                )
            self.whole = _digests(place / case.out)
            _remove(place / case.out)

    def words(self, place: Path) -> list[str]:
        """The command line of a run that writes below `place`."""
        return [self.name, *self.case.arguments, "--out", str(place / self.case.out)]

    def start(self, place: Path) -> int:
        """The process number of a run that writes below `place`."""
        return _forked(self.words(place))

    def killed(self, number: int) -> Iterator[str]:
        """Kill runs at random moments, every second of them over earlier results."""
        delays = self.rng.uniform(0.0, self.seconds, number)
        for k, delay in enumerate(delays.tolist()):
            earlier = k % 2 == 1
            if not earlier:
                _remove(self.place / self.case.out)
            elif not (self.place / self.case.out).exists():
                _ended(self.start(self.place))
            run = self.start(self.place)
            time.sleep(delay)
            os.kill(run, signal.SIGKILL)
            code = _ended(run)
            self.count("killed" if code == -signal.SIGKILL else "over before the kill")
            yield from self.judged(self.place, f"killed after {delay:.3f} s", must_be=earlier)
        if number:
            # What was killed goes on, or begins again, and ends as if nothing had been.
            code = _ended(self.start(self.place))
            if code not in (0, 1):
                yield f"the run after the kills ends with exit code {code}"
            yield from self.judged(self.place, "after the kills", must_be=True, finished=True)
            _remove(self.place / self.case.out)

    def small_disks(self, number: int) -> Iterator[str]:
        """Run on disks that are too small, and on one that is read-only."""
        size = sum(path.stat().st_size for path in self.written(self.place)) or sum(n for _, n in self.whole.values())
        for k in range(number + 1 if number else 0):
            read_only = k == number
            room = int(size * self.rng.uniform(0.02, 0.9))
            with _disk(1 << 26 if read_only else max(room, 8192), read_only) as disk:
                if disk is None:
                    self.count("disks that could not be mounted")
                    return
                code = _ended(self.start(disk))
                self.count("read-only disks" if read_only else "full disks")
                here = f"on a {'read-only disk' if read_only else f'disk of {room} bytes'}"
                left = _names(disk)
                if code == 0:
                    yield from self.judged(disk, here, must_be=True)
                elif code != 2 or (left and self.name not in _GOES_ON):
                    yield f"{here}: exit code {code}, {sorted(left)} there"

    def twice_at_once(self, number: int) -> Iterator[str]:
        """Run twice at once into one place."""
        for _ in range(number):
            _remove(self.place / self.case.out)
            delay = self.rng.uniform(0, self.seconds / 2)
            one = self.start(self.place)
            time.sleep(delay)
            codes = [_ended(run) for run in (one, self.start(self.place))]
            self.count("pairs")
            if not set(codes) <= {0, 1, 2} or codes == [2, 2]:
                yield f"two at once, {delay:.2f} s apart: exit codes {codes}"
            yield from self.judged(self.place, f"two at once, {delay:.2f} s apart", must_be=True, finished=True)

    def judged(self, place: Path, when: str, *, must_be: bool, finished: bool = False) -> Iterator[str]:
        """What is wrong below `place` after a fault; results `must_be` there, of a run that has `finished`."""
        from jaxphoto.writing import is_place

        out = place / self.case.out
        others = {name for name in _names(place) if not is_place(name)} - {self.case.out}
        if others:
            yield f"{when}: {sorted(others)} left"
        if not out.exists():
            if must_be and self.name not in _GOES_ON:
                yield f"{when}: the results are gone"
        elif self.name not in _GOES_ON or finished:
            there = _digests(out)
            if set(there) != set(self.whole):
                yield f"{when}: {sorted(set(there) ^ set(self.whole))[:5]} too much or missing"
            differing = [
                name
                for name in set(there) & set(self.whole)
                if Path(name).name not in _TIMED and there[name] != self.whole[name]
            ]
            if differing:
                yield f"{when}: other bytes in {sorted(differing)[:5]}"
        if _digests(self.inputs) != self.given:
            yield f"{when}: an input has changed"

    def written(self, place: Path) -> list[Path]:
        """The files of the results."""
        return [path for path in (place / self.case.out).rglob("*") if path.is_file()]

    def count(self, what: str) -> None:
        """One more of that."""
        self.counts[what] = self.counts.get(what, 0) + 1


def _forked(words: list[str]) -> int:
    """A process that runs `jaxphoto` with these words, silently."""
    run = os.fork()
    if run:
        return run
    code = 70
    try:
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        sys.argv = ["jaxphoto", *words]
        from jaxphoto_command import main as command

        command()
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    finally:
        os._exit(code)


def _ended(run: int) -> int:
    """The exit code of a process, minus the number of the signal that ended it."""
    limit = time.monotonic() + _ENDLESS
    while time.monotonic() < limit:
        done, status = os.waitpid(run, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(run, signal.SIGKILL)
    os.waitpid(run, 0)
    return 99


@contextlib.contextmanager
def _disk(size: int, read_only: bool) -> Iterator[Path | None]:
    """A disk of so many bytes; None where this user may not mount one."""
    with tempfile.TemporaryDirectory() as folder:
        options = f"size={size}{',ro' if read_only else ''}"
        mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]
        if subprocess.run(mount, check=False, capture_output=True).returncode:
            yield None
            return
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "-l", folder], check=True, capture_output=True)


def _digests(path: Path) -> dict[str, tuple[str, int]]:
    """SHA-256 and size of every file below `path`, or of the file itself."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {str(p.relative_to(path)): (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_size) for p in files}


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# Cases -------------------------------------------------------------------------------------------------------


def _cases(inputs: Path) -> dict[str, Case]:
    """The commands that take long, the quickest first; their inputs are made here."""
    from jaxphoto.io import recipe_from, write_simulation
    from jaxphoto.simulation import simulate
    from tests.simulation.small import changed

    block, flight = inputs / "block", inputs / "flight"
    noise = {"image_mm": 0.004, "control_m": 0.03, "station_m": 0.1, "attitude_deg": 0.01}
    values = changed({"noise": noise})
    flown = changed(
        {
            "noise": noise,
            "lidar.density_per_m2": 0.003,
            "sigmas.lidar_m": [0.3, 0.3, 0.1],
            "mounts.default.boresight": "free",
            "terrain": {"kind": "random", "count": 12, "rms_m": 40.0, "length_m": 700.0},
        }
    )
    # Written by processes of their own: this one must stay without a JAX of its own to be forked.
    for recipe, path in ((values, block), (flown, flight)):
        _apart(lambda r=recipe, p=path: write_simulation(simulate(recipe_from(r), 1), p))
    _apart(lambda: _pictures(inputs))
    recipe = HERE.parent / "examples" / "recipe.toml"
    cloud = str(flight / "cloud.laz")
    board = sorted(str(path) for path in (inputs / "board").iterdir())
    ground = sorted(str(path) for path in (inputs / "ground").iterdir())
    camera = ("--pixel-mm", "0.006", "--c-mm", "3.6")
    made = {
        "simulate": Case((str(recipe),)),
        "adjust": Case((str(block),)),
        "lidar-control": Case((str(flight), cloud)),
        "sensitivity": Case((str(block),)),
        "monte-carlo": Case((str(block), "--bias", "station", "--sigma-m", "0.1", "--draws", "200")),
        "boresight": Case((str(flight), "--go-on")),
        "models": Case((str(block), "--models", "brown,brown:k1", "--folds", "0")),
        "halves": Case((str(block), "--cuts", "4")),
        "calibrate": Case((*board, "--board", "chessboard:8x5:square_mm=22", "--pixel-mm", "0.006")),
        "simultaneous": Case((str(flight), cloud, "--boresight", "fixed")),
        "orient": Case((*ground, "--features", "400", *camera)),
        "fly": Case((*ground, "--features", "400", *camera)),
    }  # fmt: skip
    return made


def _pictures(inputs: Path) -> None:
    """Photographs of a board, and of textured ground."""
    from jaxphoto.extras.photos.targets import read_board, rendered
    from tests.photos import ground, test_targets

    pattern = read_board("chessboard:8x5:square_mm=22")
    (inputs / "board").mkdir()
    for k in range(5):
        view = test_targets.view(pattern.board, k)
        picture = rendered(pattern, test_targets.SENSOR, test_targets.LENS, view, noise=3.0, rays=13, seed=k)
        cv2.imwrite(str(inputs / "board" / f"p{k}.png"), picture)
    (inputs / "ground").mkdir()
    rng = np.random.default_rng(4)
    texture = ground.texture(rng, 2400).astype(np.float32)
    for k in range(8):
        at = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, 60.0 + 8 * (k % 3)])
        angles = (*rng.uniform(-14, 14, 2), 90.0 * (k % 4))
        ground.photograph(inputs / "ground" / f"g{k}.png", texture, at, angles, rng)


def _apart(work: Callable[[], object]) -> None:
    """Do it in a process of its own."""
    run = os.fork()
    if not run:
        code = 1
        try:
            work()
            code = 0
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(code)
    if os.waitstatus_to_exitcode(os.waitpid(run, 0)[1]):
        raise SystemExit("the inputs could not be made")


if __name__ == "__main__":
    sys.exit(main())
