"""Which manoeuvre tells trajectory, scanner and camera apart: the same flying system flown in several ways.

    python experiments/joint_flight/manoeuvres.py [OUT] [MANOEUVRES]

simulates the flights of MANOEUVRES (manoeuvres.toml), adjusts trajectory, scanner and camera of each at once, and
prints the standard deviations of all parameters of scanner, camera and mount, and the strongest correlation between
what belongs to the scanner and what to the camera. manoeuvres.csv goes to OUT (`results`).
"""

import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.georeferencing import ScannerCalibration
from jaxphoto.io import read_recipe
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.procedures.lidar import Photographs, ScannerPriors, StripAdjustment, adjust_strips
from jaxphoto.report.strips import all_correlations, calibration_table
from jaxphoto.simulation import Recipe, Simulation, simulate
from jaxphoto.unknowns import FIXED, FREE

FOLDER = Path(__file__).resolve().parent
# As the trajectory of recipe.toml drifts, and with planes as large as a return on 5 m^2 needs.
SETTINGS = StripSettings(
    cell_m=8.0,
    knots_s=5.0,
    correlation_s=60.0,
    sigma_position_m=0.05,
    sigma_attitude_deg=0.003,
    sigma_heading_deg=0.006,
)
PRIORS = ScannerPriors(FREE, ScannerCalibration(FIXED, FREE, FIXED, FREE, FIXED, FIXED))  # type: ignore[arg-type]
UNITS = {"_mm": (1e3, "um"), "_deg": (1e3, "mdeg"), "_m": (1e3, "mm"), "_ppm": (1.0, "ppm")}
"""Factor and unit in which a sigma is printed, by the end of its parameter's name."""


def planned(strips: list[dict]) -> Recipe:
    """recipe.toml with other strips."""
    head, _, rest = (FOLDER / "recipe.toml").read_text(encoding="utf-8").partition("[[flight.strips]]")
    _, _, tail = rest.partition("[jitter]")
    own = "".join(
        "[[flight.strips]]\n" + "".join(f"{key} = {value!r}\n" for key, value in strip.items()) for strip in strips
    )
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "recipe.toml"
        recipe.write_text(f"{head}{own}[jitter]{tail}", encoding="utf-8")
        return read_recipe(recipe)


def adjusted(flight: Simulation) -> StripAdjustment:
    """Trajectory, scanner and camera at once."""
    assert flight.block.flight_time is not None
    photographs = Photographs(flight.block, np.asarray(flight.block.flight_time))
    return adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS, photographs=photographs)


def told(found: StripAdjustment) -> dict[str, float | str]:
    """Sigmas of all parameters that are no trajectory's, and the strongest correlation of scanner with camera."""
    row: dict[str, float | str] = {}
    for one in calibration_table(found).itertuples(index=False):
        name = str(one.parameter).rpartition("].")[2]
        factor, unit = next((u for end, u in UNITS.items() if name.endswith(end)), (1.0, ""))
        row[f"{name} [{unit}]" if unit else name] = factor * one.sigma
    rho = all_correlations(found)
    scanner = [label for label in rho.columns if label.startswith("scanner")]
    camera = [label for label in rho.columns if label.startswith(("interior", "mounts"))]
    between = rho.loc[scanner, camera]
    one, other = np.unravel_index(np.argmax(np.abs(between.to_numpy())), between.shape)
    row["strongest"] = f"{scanner[one]} with {camera[other]} {between.iloc[one, other]:+.2f}"
    return row


def main(out: Path, manoeuvres: Path) -> None:
    """Print and write what each manoeuvre tells."""
    rows = []
    for one in tomllib.loads(manoeuvres.read_text(encoding="utf-8"))["manoeuvre"]:
        found = adjusted(simulate(planned(one["strips"]), seed=5))
        rows.append({"manoeuvre": one["name"], "converged": found.converged, **told(found)})
        said = (
            f"  {name}: {value:.3g}" if isinstance(value, float) else f"  {value}" for name, value in rows[-1].items()
        )
        print(*said, sep="\n", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(out / "manoeuvres.csv", index=False)
    print(f"wrote {out / 'manoeuvres.csv'}")


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    main(given[0] if given else Path("results"), given[1] if len(given) > 1 else FOLDER / "manoeuvres.toml")
