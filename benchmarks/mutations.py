"""Readers tried with files spoilt at random: `python benchmarks/mutations.py [--reader NAME ...] [--count 50000]`.

Each reader runs in a process of its own, whose memory is limited. One that dies or hangs is noted with the seed it had,
and another goes on after it. Findings are listed by kind and place, with the first seed of each; the exit code is 1
where there are any. `--seed` gives the first seed; a finding of seed n comes again with `--seed n --count 1`.
"""

import argparse
import collections
import json
import re
import resource
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

# Beyond what is in use when all is imported and read once: more than the readers' own limit, which is then exceeded.
_ROOM_BYTES = 3_000_000_000
# So much of what a finding says tells where it is.
_TOLD = {"warning": 160, "message": 0}


def main() -> int:
    from tests.mutations import READERS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reader", action="append", choices=sorted(READERS))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        return work(arguments.worker, arguments.seed, arguments.count)
    bad = 0
    for reader in arguments.reader or READERS:
        began = time.perf_counter()
        found = findings(reader, arguments.seed, arguments.count)
        seconds = time.perf_counter() - began
        print(f"{reader}: {arguments.count} files, {len(found)} findings, {seconds:.0f} s", flush=True)
        for (what, place), seeds in by_place(found).items():
            print(f"  {len(seeds)} x {what} (seed {seeds[0]}): {place}", flush=True)
        bad += len(found)
    return int(bad > 0)


def by_place(found: list[dict]) -> dict[tuple[str, str], list[int]]:
    """Seeds of the findings of one kind at one place: of a traceback its last line of code and its error."""
    places: dict[tuple[str, str], list[int]] = collections.defaultdict(list)
    for finding in found:
        detail = finding["detail"].strip()
        lines = [line.strip() for line in detail.splitlines()]
        files = [line for line in lines if line.startswith("File ")]
        # Numbers differ from seed to seed.
        place = (
            f"{files[-1]}: {lines[-1][:160]}"
            if files
            else re.sub(r"\d+", "#", detail[: _TOLD.get(finding["what"], 160)])
        )
        places[finding["what"], place].append(finding["seed"])
    return dict(sorted(places.items(), key=lambda item: -len(item[1])))


def findings(reader: str, first: int, count: int) -> list[dict]:
    """Findings of `count` seeds, by workers: another one where one has died."""
    from tests.mutations import SLOWEST_S

    found, at = [], first
    while at < first + count:
        command = [sys.executable, __file__, "--worker", reader, "--seed", str(at), "--count", str(first + count - at)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=HERE.parent) as worker:
            assert worker.stdout is not None
            ready = False
            buffer = b""
            while True:
                patience = 3 * SLOWEST_S if ready else 300.0
                if not select.select([worker.stdout], [], [], patience)[0]:
                    worker.kill()
                    found.append({"seed": at, "what": "hangs", "detail": f"more than {patience:.0f} s"})
                    at += 1
                    break
                chunk = worker.stdout.read1(65536)
                if not chunk:
                    code = worker.wait()
                    if at < first + count:
                        if not ready:
                            raise SystemExit(f"{reader}: the worker did not start ({code})")
                        found.append({"seed": at, "what": "dies", "detail": f"exit code {code}"})
                        at += 1
                    break
                *lines, buffer = (buffer + chunk).split(b"\n")
                for line in lines:
                    said = json.loads(line)
                    ready = True
                    if "done" in said:
                        at = said["done"] + 1
                    elif "what" in said:
                        found.append(said)
    return found


def work(reader: str, first: int, count: int) -> int:
    """Try the seeds one after the other; a line of JSON for each finding and each seed that is done."""
    from tests.mutations import READERS, sound, tried

    with tempfile.TemporaryDirectory() as folder:
        for name, content in sound(reader).items():
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / name).write_bytes(content)
        READERS[reader].read(Path(folder))
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + _ROOM_BYTES, resource.RLIM_INFINITY))
        print(json.dumps({"ready": reader}), flush=True)
        for seed in range(first, first + count):
            for finding in tried(reader, seed, Path(folder)):
                print(json.dumps(finding._asdict()), flush=True)
            print(json.dumps({"done": seed}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
