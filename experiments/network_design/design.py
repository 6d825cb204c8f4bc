"""Given one control point and 31 images: where does it go, and which four strips tell y_p from the tilts?

    python experiments/network_design/design.py --out results

The camera, the weights and the usual layout are those of paper 000 (experiments/000/recipe.toml). Found layouts are
measured and adjusted by `jaxphoto.adjust`, which knows nothing of how they were found.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxphoto
from jaxphoto.block import Block
from jaxphoto.sensitivity.network.covariance import design_covariance, largest_correlation, point_rmse, sigma_of
from jaxphoto.sensitivity.network.layout import StripDesign, StripPlan, block_from_layout, design_from_plan
from jaxphoto.sensitivity.network.search import (
    best_designs,
    evaluate_designs,
    grid_designs,
    optimise_design,
    random_designs,
    stack_designs,
)
from jaxphoto.simulation import remeasure
from jaxphoto.statistics import correlations
from jaxphoto.unknowns import Unknowns

RECIPE = jaxphoto.read_recipe(Path(__file__).parents[1] / "000" / "recipe.toml")
FREE = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
TILTS, PRINCIPAL_POINT = ("omega", "phi"), ("xp_mm", "yp_mm")
RADIUS_M, POINTS, CHECKED_M = 1700.0, 200, 1000.0
CENTRE = np.zeros((1, 2))
GRID, STARTS, STEPS = 11, 6, 40
BOTH_TILTS = eqx.Partial(largest_correlation, exterior=TILTS, interior=PRINCIPAL_POINT)
OMEGA_ONLY = eqx.Partial(largest_correlation, exterior=("omega",), interior=("yp_mm",))


def plan(seed: int) -> StripPlan:
    """Plan the mission of paper 000 over a disc, with jitter and ground points drawn by `seed`."""
    rng, jitter = np.random.default_rng(seed), RECIPE.jitter
    places = rng.uniform(-RADIUS_M, RADIUS_M, (4 * POINTS, 2))
    ground = RECIPE.terrain.place(places[np.hypot(*places.T) < RADIUS_M][:POINTS], rng)
    images = tuple(strip.images for strip in RECIPE.plan.strips)
    turns = np.deg2rad([jitter.angle_deg, jitter.angle_deg, jitter.crab_deg])
    return StripPlan(
        interior=RECIPE.cameras["kodak"].truth,
        points=ground,
        turn=rng.standard_normal((sum(images), 3)) * turns,
        shift=rng.standard_normal((sum(images), 3)) * jitter.position_m,
        base=RECIPE.plan.strips[0].base_m,
        reach=150.0,
        image_sigma=RECIPE.stated.image_mm,
        control_sigma=RECIPE.stated.control_m[0],
        station_sigma=RECIPE.stated.station_m[0],
        images=images,
        sensor=RECIPE.sensors["kodak"],
        free=FREE,
    )


def bounds(usual: StripDesign, **changes) -> tuple[StripDesign, StripDesign]:
    """Low and high designs: as usual but for the variables in `changes`, each between its two numbers."""
    ends = []
    for end in (0, 1):
        values = {name: np.full(np.shape(getattr(usual, name)), pair[end]) for name, pair in changes.items()}
        names = list(values)
        ends.append(eqx.tree_at(lambda d, n=names: [getattr(d, x) for x in n], usual, list(values.values())))
    return ends[0], ends[1]


def control_point(of: StripPlan, usual: StripDesign) -> pd.DataFrame:
    """Where the control point goes, for three criteria: the search begins at the best places of a grid."""
    low, high = bounds(usual, control=(-1200.0, 1200.0))
    near = np.hypot(*np.asarray(of.points)[:, :2].T) < CHECKED_M
    # Where a point is seen does not depend on the control point: check points are those that four images see.
    seen = np.asarray(design_covariance(of(usual)).rays)[: len(near)] > 4
    criteria = {
        "sigma_c_mm": eqx.Partial(sigma_of, name="c_mm"),
        "sigma_yp_mm": eqx.Partial(sigma_of, name="yp_mm"),
        "point_rmse_m": eqx.Partial(point_rmse, points=tuple(np.flatnonzero(near & seen).tolist())),
    }
    corner = eqx.tree_at(lambda d: d.control, usual, np.array([[1200.0, 1200.0]]))
    rows = []
    for name, criterion in criteria.items():
        ends = evaluate_designs(criterion, of, stack_designs(usual, corner))
        begin = best_designs(criterion, of, grid_designs(low, high, GRID), 2)
        found = optimise_design(criterion, of, low, high, begin)
        rows.append((name, *ends, found.start_values[0], found.value, *found.best.control[0]))
        print(*rows[-1], flush=True)
    return pd.DataFrame(rows, columns=["criterion", "centre", "corner", "grid", "gradient", "X_m", "Y_m"])


def four_strips(of: StripPlan, usual: StripDesign) -> dict[str, StripDesign]:
    """Layouts by how they were found."""
    turn = {"heading": (0.0, 2 * np.pi)}
    more = turn | {"height": (800.0, 1200.0), "across": (-300.0, 300.0), "control": (-1000.0, 1000.0)}
    designs = {"usual": usual}
    low, high = bounds(usual, heading=(0.0, 7 / 4 * np.pi))
    grid = grid_designs(low, high, 8)
    values = evaluate_designs(BOTH_TILTS, of, grid)
    designs["grid of headings"] = jax.tree.map(lambda v: v[np.nanargmin(values)], grid)
    for name, changes, criterion in (
        ("headings", turn, BOTH_TILTS),
        ("all variables", more, BOTH_TILTS),
        ("omega only", turn, OMEGA_ONLY),
    ):
        low, high = bounds(usual, **changes)
        known = [designs["grid of headings"]] if changes is turn and criterion is BOTH_TILTS else []
        begin = stack_designs(usual, *known, *each(random_designs(low, high, STARTS, 1)))
        smooth = eqx.Partial(criterion.func, **criterion.keywords, power=16.0)
        found = optimise_design(criterion, of, low, high, begin, smooth, STEPS)
        print(name, found.start_values.round(3), found.values.round(3), found.steps, flush=True)
        designs[name] = found.best
    return designs


def each(designs: StripDesign) -> list[StripDesign]:
    """Designs along a leading axis, one by one."""
    return [jax.tree.map(lambda v, k=k: v[k], designs) for k in range(len(designs.heading))]


def judged(of: StripPlan, designs: dict[str, StripDesign], draws: int) -> pd.DataFrame:
    """Evaluate each layout: search, adjustments with and without noise, repeated flights.

    `other_flights` is the mean over ten more draws of jitter and ground points, of which the search knew nothing.
    """
    measured = {name: block_from_layout(of(design)) for name, design in designs.items()}
    sizes = jaxphoto.common_sizes([m.block for m in measured.values()])
    others = [plan(seed) for seed in range(1, 11)]
    rows = []
    for name, (block, truth, _) in measured.items():
        one = stack_designs(designs[name])
        planned = [float(evaluate_designs(c, of, one)[0]) for c in (BOTH_TILTS, OMEGA_ONLY)]
        elsewhere = np.nanmean([evaluate_designs(BOTH_TILTS, other, one)[0] for other in others])
        adjusted = jaxphoto.adjust(block, truth, sizes=sizes)
        covariance = jaxphoto.covariance(adjusted)
        rho = abs(correlations(adjusted, covariance)["camera"].exterior[:, 3:5, 1:3])
        # Without noise sigma naught is zero: sigmas are a priori.
        sigma = np.sqrt(np.diagonal(covariance.matrix)[-len(FREE) :])[2]
        again = noisy(block, truth)
        errors = []
        for k in range(draws):
            found = jaxphoto.adjust(again(k), truth, sizes=sizes).unknowns.interior["camera"]
            errors.append(float(found.yp) - float(truth.interior["camera"].yp))
        scatter = np.sqrt(np.mean(np.square(errors))) if draws else np.nan
        rows.append((name, *planned, rho.max(), rho[:, 0, 1].max(), elsewhere, sigma, scatter))
        print(*rows[-1], flush=True)
    columns = ["layout", "planned_tilts", "planned_omega_yp", "adjusted_tilts", "adjusted_omega_yp", "other_flights"]
    return pd.DataFrame(rows, columns=[*columns, "sigma_yp_mm", "scatter_yp_mm"])


def noisy(block: Block, truth: Unknowns) -> Callable[[int], Block]:
    """Return the block with new noise drawn by a seed."""
    numbers = lambda b: (b.image_points.xy, b.stations.value, b.control.value)  # noqa: E731
    draw = jax.jit(lambda key: numbers(remeasure(block, truth, key)))
    return lambda seed: eqx.tree_at(numbers, block, jax.tree.map(np.asarray, draw(jax.random.key(seed))))


def table_of(designs: dict[str, StripDesign]) -> pd.DataFrame:
    """One row a strip."""
    rows = [
        (name, strip, np.rad2deg(d.heading[k]) % 360, d.height[k], d.across[k], *d.control[0])
        for name, d in designs.items()
        for k, strip in enumerate("ABCD")
    ]
    columns = ["layout", "strip", "heading_deg", "height_m", "across_m", "control_X_m", "control_Y_m"]
    return pd.DataFrame(rows, columns=columns)


def designs_of(table: pd.DataFrame, usual: StripDesign) -> dict[str, StripDesign]:
    """Read what `table_of` wrote."""
    where = lambda d: (d.heading, d.height, d.across, d.control)  # noqa: E731
    return {
        str(name): eqx.tree_at(
            where,
            usual,
            (
                np.deg2rad(rows["heading_deg"].to_numpy()),
                rows["height_m"].to_numpy(),
                rows["across_m"].to_numpy(),
                rows[["control_X_m", "control_Y_m"]].to_numpy()[:1],
            ),
        )
        for name, rows in table.groupby("layout", sort=False)
    }


def picture(of: StripPlan, designs: dict[str, StripDesign], values: pd.Series, path: Path) -> None:
    """Compare the layouts."""
    figure, panels = plt.subplots(1, len(designs), figsize=(3.4 * len(designs), 3.8), layout="constrained", sharey=True)
    ends = np.cumsum((0, *of.images))
    for axes, (name, design) in zip(panels, designs.items(), strict=True):
        x, y, _ = np.asarray(of(design).exterior.position).T
        axes.plot(*np.asarray(of.points)[:, :2].T, ".", color="0.8", ms=3)
        for strip, a, b in zip("ABCD", ends[:-1], ends[1:], strict=True):
            axes.plot(x[a:b], y[a:b], "-o", ms=3, label=strip)
        axes.plot(*design.control[0], "k^", label="control")
        axes.set_title(f"{name}: {values[name]:.2f}", loc="left", fontsize=9)
        axes.set(xlabel="X [m]", aspect="equal")
    panels[0].set(ylabel="Y [m]")
    panels[-1].legend(fontsize=7)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Search, or take the layouts of an earlier search; judge them; write tables and a picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--layouts", type=Path, help="layouts.csv of an earlier search, to be judged only")
    parser.add_argument("--draws", type=int, default=100, help="noisy adjustments of each layout")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    of, usual = plan(0), design_from_plan(RECIPE.plan, CENTRE)
    if given.layouts:
        designs = designs_of(pd.read_csv(given.layouts), usual)
    else:
        control_point(of, usual).to_csv(given.out / "control_point.csv", index=False)
        designs = four_strips(of, usual)
        table_of(designs).to_csv(given.out / "layouts.csv", index=False)
    verdict = judged(of, designs, given.draws)
    verdict.to_csv(given.out / "verdict.csv", index=False)
    print(verdict.round(4).to_string(index=False))
    picture(of, designs, verdict.set_index("layout")["adjusted_tilts"], given.out / "layouts.png")


if __name__ == "__main__":
    main()
