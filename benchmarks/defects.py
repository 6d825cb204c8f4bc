"""What is said of blocks that cannot tell something, whether it names the right thing, and whether its cures work.

python benchmarks/defects.py [--seed 1] [--only WORDS]
"""

import argparse
import re
import time
import warnings
from pathlib import Path
from typing import NamedTuple

from defect_cases import CASES, Case, Make
from machine import machine, markdown, sentence, write_results

import jaxphoto
from jaxphoto import JaxphotoError, Tables
from jaxphoto.report import verdict_of


class Said(NamedTuple):
    """What became of a block: how it ended, and what was said of it."""

    outcome: str
    text: str
    seconds: float

    @property
    def solved(self) -> bool:
        """Whether it was adjusted, and nothing said against it."""
        return self.outcome == "green"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="cases whose names contain this")
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    records: list[dict] = [{"kind": "head", **machine()}]
    for case in CASES:
        if arguments.only in case.name:
            records.append(tried(case, arguments.seed))
            print(told(records[-1]), flush=True)
    titles = ["defect", "ends", "named rightly", "cures that are said", "of these work"]
    command = f"python benchmarks/defects.py --seed {arguments.seed}"
    lines = ["### What a block cannot tell", "", sentence(records[0]), "", f"`{command}`", ""]
    write_results(
        arguments.out, "defects", records, "\n".join([*lines, *markdown(titles, [row(r) for r in records[1:]])])
    )


def tried(case: Case, seed: int) -> dict:
    """A case, and each of its cures that what is said of it names."""
    said = told_of(case.broken, seed)
    cures = []
    for words, applied in case.cures:
        if re.search(words, said.text):
            cured = told_of(applied, seed)
            cures.append({"words": words, "works": cured.solved, **cured._asdict()})
        else:
            cures.append({"words": words, "works": None})
    named = said.outcome != "green" and all(re.search(words, said.text) for words in case.named)
    return {"kind": "case", "name": case.name, **said._asdict(), "named": named, "cures": cures}


def told_of(make: Make, seed: int) -> Said:
    """What is said of the block that `make` gives: an error's sentence, or alarms and warnings of the verdict."""
    began = time.perf_counter()
    try:
        verdict = verdict_of(Tables(jaxphoto.adjust(make(seed))))
    except JaxphotoError as error:
        return Said(type(error).__name__, str(error), time.perf_counter() - began)
    text = "\n".join(f.text for f in verdict.findings if f.severity != "note")
    return Said(verdict.colour, text, time.perf_counter() - began)


def told(record: dict) -> str:
    """A record for the screen."""
    lines = [f"{'ok ' if record['named'] else 'NOT'} {record['name']}: {record['outcome']} ({record['seconds']:.0f} s)"]
    lines += [f"      {line}" for line in record["text"].splitlines()]
    for cure in record["cures"]:
        lines.append(f"    cure {cure['words']!r}: " + ("not said" if cure["works"] is None else cure["outcome"]))
        if cure["works"] is False:
            lines += [f"      {line}" for line in cure["text"].splitlines()]
    return "\n".join(lines)


def row(record: dict) -> list[str]:
    """A record for the table."""
    said = [cure for cure in record["cures"] if cure["works"] is not None]
    works = f"{sum(cure['works'] for cure in said)} of {len(said)}"
    names = ", ".join(cure["words"].split("|")[0] for cure in said)
    return [record["name"], record["outcome"], "yes" if record["named"] else "no", names, works]


if __name__ == "__main__":
    main()
