"""Is the Gaussian right? A nearly flat block without stations, and the same with them: the posterior of both.

    python experiments/posterior/flat_block.py [FOLDER] [DRAWS]

Writes FOLDER/without_stations.csv and .png, FOLDER/with_stations.csv and .png (default: runs/posterior, 1000 draws).
"""

import sys
import tomllib
from pathlib import Path

from jaxphoto import adjust, simulate
from jaxphoto.io import recipe_from
from jaxphoto.report.draws import posterior_table
from jaxphoto.sensitivity.posterior import posterior

RECIPE = Path(__file__).with_name("recipe.toml")
STATION_SIGMA_M = 0.1
PARAMETERS = ("interior[kodak].c_mm", *(f"exterior[A_02].{name}" for name in ("X", "Z", "omega", "phi")))


def main(folder: Path, draws: int) -> None:
    """Sample both blocks and write what was found."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, sigma in (("without_stations", None), ("with_stations", STATION_SIGMA_M)):
        recipe = tomllib.loads(RECIPE.read_text(encoding="utf-8"))
        if sigma is not None:
            recipe["sigmas"]["station_m"] = recipe["noise"]["station_m"] = sigma
        found = posterior(adjust(simulate(recipe_from(recipe), seed=1).block), PARAMETERS, draws=draws)
        table = posterior_table(found)
        table.to_csv(folder / f"{name}.csv", index=False)
        print(f"{name}: {found.divergences.sum()} divergences, {found.gradients} gradients")
        print(table.round(4).to_string(index=False))


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else Path("runs/posterior"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 1000,
    )
