"""Which designs of a flight separate interior from exterior orientation: five questions, one compiled sweep.

    python experiments/correlation_study/study.py [OUT]

prints the tables of README.md and the times, and writes sweep.csv and a picture of each question to OUT (`results`).
"""

import itertools
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from jaxphoto.experiment import Experiment, Variant, simulated
from jaxphoto.report.sweep import sweep_figure, sweep_table
from jaxphoto.sensitivity.sweep import Design, sweep

FOLDER = Path(__file__).resolve().parent
Parameters = Mapping[str, Any]

BASE: Parameters = {
    "second_pair": "across",  # or along: the same strips once more
    "turned": True,  # whether the second strip of a pair is flown the other way: kappa + 180 degrees
    "rise_percent": 0.0,  # by which the second pair is higher than the first
    "overlap_percent": 60.0,
    "tilt_deg": 0.0,  # forward, of all images
    "control": 4,
    "place": "corners",
    "station_m": 0.05,
    "lever_arm_m": 0.01,
}
"""Parameters of a design, and their values where a question does not ask for others."""

NONE = 100.0
"""A standard deviation (m) of stations that says nothing."""
QUESTIONS: Mapping[str, Mapping[str, tuple]] = {
    "strips": {
        "second_pair": ("along", "across"),
        "turned": (False, True),
        "rise_percent": (0.0, 15.0, 30.0),
        "station_m": (0.02, 0.05, 0.15, 0.5, NONE),
    },
    "overlap": {"overlap_percent": (60.0, 70.0, 80.0), "second_pair": ("along", "across"), "station_m": (0.05, NONE)},
    "control": {
        "control": (1, 2, 4, 8, 12),
        "place": ("corners", "middle"),
        "station_m": (0.05, 0.5, NONE),
    },
    "oblique": {"tilt_deg": (0.0, 5.0, 10.0, 20.0, 30.0), "turned": (False, True), "station_m": (0.05, NONE)},
    "lever arm": {
        "lever_arm_m": (0.001, 0.01, 0.03, 0.1, 0.3, 1.0),
        "turned": (False, True),
        "rise_percent": (0.0, 30.0),
    },
}
"""Values of the parameters that a question asks for; every value of one is combined with all of the others."""

REACH_M = {"corners": (450.0, 400.0, 350.0), "middle": (60.0, 110.0, 160.0)}
"""How far control lies from the middle of the block along X and along Y, four points after four."""
CORNERS = ((-1, -1), (1, 1), (-1, 1), (1, -1))


def recipe_of(p: Parameters) -> Mapping[str, Any]:
    """Apply a design to the recipe."""
    across = 0.0 if p["second_pair"] == "across" else 90.0
    strips = []
    for pair, heading, height in (("E", 90.0, 1000.0), ("N", across, 1000.0 * (1 + p["rise_percent"] / 100))):
        for number, side in ((1, -0.5), (2, 0.5)):
            back = p["turned"] and number == 2
            strips.append(
                {
                    "name": f"{pair}{number}",
                    "heading_deg": heading + 180.0 * back,
                    "images": 6,
                    "height_m": height,
                    "across_spacings": -side if back else side,
                }
            )
    control = [[reach * x, reach * y] for reach in REACH_M[p["place"]] for x, y in CORNERS]
    return {
        "flight": {"forward_overlap_percent": p["overlap_percent"], "strips": strips},
        "mounts": {"default": {"boresight_deg": [0.0, p["tilt_deg"], 0.0], "lever_arm": {"sigma_m": p["lever_arm_m"]}}},
        "targets": [
            {"role": "control", "at_m": control[: p["control"]]},
            {"role": "check", "prefix": "C", "count": 25},
        ],
        "sigmas": {"station_m": p["station_m"]},
    }


def designs() -> list[Design]:
    """All designs, the first parameter of each being its question."""
    asked = [
        {"question": question} | dict(BASE) | dict(zip(values, chosen, strict=True))
        for question, values in QUESTIONS.items()
        for chosen in itertools.product(*values.values())
    ]
    variants = {str(k): Variant(recipe=recipe_of(p)) for k, p in enumerate(asked)}
    study = Experiment(title="Correlation study", variants=variants, tables={})
    made = [simulated(study, FOLDER, name) for name in variants]
    return [Design(p, s.block, s.truth) for p, s in zip(asked, made, strict=True)]


SHOWN = [
    ("sigma", "c_mm"),
    ("sigma", "xp_mm"),
    ("sigma", "yp_mm"),
    ("mean_abs_rho", "Z:c_mm"),
    ("mean_abs_rho", "phi:xp_mm"),
    ("mean_abs_rho", "omega:yp_mm"),
    ("check_sigma", "X_m"),
    ("check_sigma", "Z_m"),
    ("check_rmse", "Z_m"),
]
"""What is printed and drawn of every design."""
DRAWN = {
    "strips": ("station_m", ("second_pair", "turned")),
    "overlap": ("overlap_percent", ("second_pair", "station_m")),
    "control": ("control", ("place", "station_m")),
    "oblique": ("tilt_deg", ("turned", "station_m")),
    "lever arm": ("lever_arm_m", ("turned", "rise_percent")),
}
"""Of each question's picture: the parameter along x, and those that tell its lines apart."""


def printed(table: pd.DataFrame, question: str) -> pd.DataFrame:
    """Tabulate the designs of a question, one per row, with the columns `SHOWN`."""
    rows = table[table["question"] == question].merge(pd.DataFrame(SHOWN, columns=["quantity", "of"]))
    return rows.pivot_table(index=list(QUESTIONS[question]), columns=["quantity", "of"], values="value", sort=False)


def main(out: Path) -> None:
    """Run the study; print and write what came of it."""
    began = time.perf_counter()
    asked = designs()
    simulated_in = time.perf_counter() - began
    swept = sweep(asked)
    table = sweep_table(swept)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "sweep.csv", index=False)
    for question, (x, by) in DRAWN.items():
        print(f"\n{question}\n{printed(table, question).to_string(float_format='{:.4f}'.format)}")
        rows = table[table["question"] == question]
        level = rows[rows["rise_percent"] == BASE["rise_percent"]]
        chosen = rows if "rise_percent" in by else level
        sweep_figure(chosen, x, SHOWN, by).savefig(out / f"{question.replace(' ', '_')}.png")
    seconds = swept.seconds
    print(
        f"\n{len(swept)} designs, {swept.programs} program(s): simulated in {simulated_in:.1f} s, prepared in "
        f"{seconds['prepare']:.1f} s, compiled or loaded in {seconds['compile']:.1f} s, adjusted and judged in "
        f"{seconds['designs']:.1f} s ({len(swept) / seconds['designs']:.0f} designs per second)"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
