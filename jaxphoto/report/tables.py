"""Tables of an adjustment as DataFrames, with the columns of the result folder (docs/block_folder.md)."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from jaxphoto import statistics
from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Residuals
from jaxphoto.arrays import ArrayLike
from jaxphoto.camera import RATES, constant_names, get_parameter, parameter_names, parameter_unit
from jaxphoto.compiling import call_compiled
from jaxphoto.observations import AXES, AbstractObservations
from jaxphoto.parameters import numbers_of, unit_of
from jaxphoto.report.formatting import in_file_unit, label_unit, symbol
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.statistics.block_geometry import Coverage, coverage, intersection_angles
from jaxphoto.statistics.correlation import FORMS
from jaxphoto.statistics.sigma_map import SigmaMap, sigma_maps
from jaxphoto.tracing import refuse_traced
from jaxphoto.unknowns import Unknowns

# Median cosine of the tilt above which images are near-vertical (45 degrees).
NEAR_VERTICAL = 0.7


# Maximum deviation of phi from +-90 degrees at which omega and kappa are not separable: their sigma is that of the
# rotation about the axis, multiplied by 1 / cos(phi) > 5.7. Sigma above which an angle is undetermined.
_INSEPARABLE_DEG, _DETERMINED_DEG = 10.0, 180.0


class Tables:
    """Tables of an adjustment, computed at first access.

    `rotations` selects the rotation parameters of the correlations (see `jaxphoto.covariance`). Standard deviations are
    a posteriori (times sigma0) unless a column is documented otherwise; units are in the column names or in a column
    `unit`. `truth`: true values of a simulation (`jaxphoto.io.truth_tables`, `read_truth`), for `recovery`. `known`:
    covariance of this adjustment with omega, phi, kappa, if already computed, preferably with its `rows`.
    """

    def __init__(
        self,
        adjusted: Adjustment,
        rotations: statistics.Rotations = "omega_phi_kappa",
        truth: Mapping[str, pd.DataFrame] | None = None,
        known: statistics.Covariance | None = None,
    ):
        refuse_traced("Tables", adjusted)
        self.adjusted = adjusted
        self.rotations: statistics.Rotations = rotations
        self.truth = truth
        if known is not None and known.rotations != "omega_phi_kappa":
            raise ValueError(f"known: rotations {known.rotations!r}; use the covariance with omega, phi, kappa")
        self._known = known

    def __repr__(self) -> str:
        names = [name for name, member in vars(Tables).items() if _is_table(member)]
        return f"Tables of {self.adjusted!r};\n  {', '.join(names)}"

    def _repr_html_(self) -> str:
        """Return the interior orientation and the spread of residuals."""
        shown = (t.to_html(index=False, border=0, na_rep="") for t in (self.interior, self.residual_spread))
        return f"{self.adjusted._repr_html_()}{''.join(shown)}"

    # Statistics as arrays ----------------------------------------------------------------------------------------

    @cached_property
    def covariance(self) -> statistics.Covariance:
        """Covariance with omega, phi, kappa."""
        statistics.prepare_statistics(self.adjusted.equations, self.adjusted.seconds)
        return statistics.covariance(self.adjusted, rows=True) if self._known is None else self._known

    def _if_converged(self, sigma: ArrayLike) -> np.ndarray:
        """Return the standard deviations; NaN for an adjustment that did not converge."""
        return np.where(bool(self.adjusted.converged), np.asarray(sigma), np.nan)

    @cached_property
    def unit(self) -> str:
        """Unit of object coordinates: "m", or "units" if no observation determines the scale of the block."""
        block = self.adjusted.block
        scaled = (block.stations, block.control, block.fixed, block.distances)
        return "m" if block.more or any(len(rows.sigma) for rows in scaled) else "units"

    @cached_property
    def coverage(self) -> Coverage | None:
        """Coverage of the ground; None without scale, or unless the images are near-vertical."""
        down = np.asarray(self.adjusted.unknowns.exterior.camera_from_object)[:, 2, 2]
        if self.unit != "m" or not len(self.adjusted.structure.image) or np.median(down) <= NEAR_VERTICAL:
            return None
        return coverage(self.adjusted)

    @cached_property
    def redundancy(self) -> statistics.Redundancy:
        """Redundancy number of every observation."""
        return statistics.redundancy_numbers(self.adjusted, self.covariance)

    @cached_property
    def w(self) -> Residuals:
        """Normalised residual of every observation."""
        return statistics.normalised_residuals(self.adjusted, self.redundancy)

    @cached_property
    def checked_w(self) -> pd.Series:
        """Normalised residuals of all checked observations, by row of `residuals`."""
        checked = self.residuals["redundancy_number"] > statistics.LEAST_CHECKED
        return self.residuals["w"][checked].dropna()

    @cached_property
    def blunders(self) -> statistics.BlunderTest:
        """Test of every normalised residual against the critical value for all of them."""
        return statistics.blunder_test(self.adjusted, self.redundancy)

    @cached_property
    def culprits(self) -> tuple[statistics.Suspect, ...]:
        """Suspects that are not explained by larger blunders."""
        return statistics.multiple_outlier_test(self.adjusted, self.blunders)

    @cached_property
    def tested_trends(self) -> list[statistics.EffectTest]:
        """Tested systematic effects in the residuals, suspects excluded."""
        suspects = [(s.group, s.row) for s in self.blunders.suspects]
        return statistics.systematic_effect_tests(self.adjusted, np.asarray(self.covariance.shared_sigma), suspects)

    @cached_property
    def undetected(self) -> statistics.MdbEffects:
        """External reliability: effects of biases of one MDB."""
        return statistics.mdb_effects(self.adjusted, self.covariance, self.redundancy)

    @cached_property
    def correlations(self) -> dict[str, statistics.Correlations]:
        """Correlations by camera."""
        if self.rotations == "omega_phi_kappa":
            return statistics.correlations(self.adjusted, self.covariance)
        return statistics.correlations(self.adjusted, statistics.covariance(self.adjusted, self.rotations))

    @cached_property
    def significance(self) -> list[statistics.Significance]:
        """Ratio and t-test of every estimated interior parameter; empty if the adjustment did not converge."""
        return statistics.significance(self.adjusted, self.covariance) if bool(self.adjusted.converged) else []

    @cached_property
    def tested_drifts(self) -> list[statistics.CameraDrift]:
        """Drift test of every camera with estimated rates."""
        return statistics.camera_drifts(self.adjusted, self.covariance)

    @cached_property
    def ground_correlations(self) -> dict[str, statistics.GroundCorrelations]:
        """Correlations of each camera with height and doming of the ground."""
        return statistics.ground_correlations(self.adjusted, self.covariance)

    @cached_property
    def sigma_maps(self) -> dict[str, tuple[SigmaMap, SigmaMap]]:
        """Projection uncertainty of each estimated camera, at infinity and at the distance of its points."""
        return sigma_maps(self.adjusted)

    # Tables ------------------------------------------------------------------------------------------------------

    @cached_property
    def interior(self) -> pd.DataFrame:
        """Interior orientation: camera, parameter, value, sigma (NaN if fixed or not converged), significant, unit."""
        tests = {(s.camera, s.parameter): s for s in self.significance}
        rows = []
        for camera, interior in self.adjusted.unknowns.interior.items():
            for name in (*parameter_names(interior), *constant_names(interior)):
                test = tests.get((camera, name))
                tested = (test.sigma, test.significant) if test else (np.nan, None)
                value = float(get_parameter(interior, name))
                rows.append((camera, name, value, *tested, parameter_unit(interior, name)))
        return pd.DataFrame(rows, columns=["camera", "parameter", "value", "sigma", "significant", "unit"])

    @cached_property
    def georeferencing(self) -> pd.DataFrame:
        """Estimated parameters of scanner, mounts and strips: parameter (with unit), value, sigma."""
        s = self.adjusted.structure
        rows = []
        for k, label, sigma in zip(s.free, s.labels, self._if_converged(self.covariance.shared_sigma), strict=True):
            if k >= s.n_cameras:
                factor = 180 / np.pi if label.endswith(("_rad", "_rad_per_s")) else 1.0
                value = float(self.adjusted.values.shared[k])
                rows.append((label.replace("_rad", "_deg"), factor * value, factor * float(sigma)))
        return pd.DataFrame(rows, columns=["parameter", "value", "sigma"])

    @cached_property
    def camera_drift(self) -> pd.DataFrame:
        """Drift of the cameras.

        Columns: camera, along, span, parameter, change (over the span), sigma, p_value, detectable (MDB), unit. `span`
        is in the unit at the end of `along`; `p_value` and `detectable` refer to a change of this parameter alone.
        """
        units = {
            name.split("_")[0]: unit_of(name).rpartition("per_")[0].removesuffix("_")
            for rates in RATES
            for (name,) in rates.names.values()
        }
        rows = [
            (d.camera, d.rates.along, d.span, name, *numbers, units[name])
            for d in self.tested_drifts
            for name, *numbers in zip(d.parameters, *d.change[:4], strict=True)
        ]
        columns = ["camera", "along", "span", "parameter", "change", "sigma", "p_value", "detectable", "unit"]
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def exterior(self) -> pd.DataFrame:
        """Exterior orientation: image, X_m ... kappa_deg and their standard deviations.

        If phi of an image is near +-90 degrees (`inseparable_angles`), standard deviations of the rotations about the
        axes of the camera follow: sigma_rx_deg, sigma_ry_deg, sigma_rz_deg. Undetermined angles have no sigma.
        """
        exterior = self.adjusted.unknowns.exterior
        angles = angles_deg(np.asarray(exterior.camera_from_object))
        sigma = self._if_converged(self.covariance.exterior_sigma) * [1, 1, 1, *[180 / np.pi] * 3]
        names = ["X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"]
        values = np.hstack([np.asarray(exterior.position), angles, sigma])
        table = pd.DataFrame(values, columns=[*names, *(f"sigma_{n}" for n in names)])
        table.insert(0, "image", self.adjusted.block.images)
        if self.inseparable_angles.any():
            angle_sigmas = [f"sigma_{name}" for name in names[3:]]
            table[angle_sigmas] = table[angle_sigmas].where(table[angle_sigmas] < _DETERMINED_DEG)
            about_axes = statistics.covariance(self.adjusted, "camera").exterior_sigma
            table[[f"sigma_r{axis}_deg" for axis in "xyz"]] = np.degrees(self._if_converged(about_axes)[:, 3:])
        return table

    @property
    def inseparable_angles(self) -> Bool[np.ndarray, "images"]:
        """True for images whose omega and kappa are not separable: phi within 10 degrees of +-90."""
        sine = np.asarray(self.adjusted.unknowns.exterior.camera_from_object)[:, 2, 0]
        return np.abs(sine) > np.cos(np.radians(_INSEPARABLE_DEG))

    @cached_property
    def exterior_map(self) -> pd.DataFrame:
        """Exterior orientation in the system of the block's files; angles relative to grid east, north and up."""
        exterior, system = self.adjusted.unknowns.exterior, self.adjusted.block.frame.map
        position = np.asarray(exterior.position)
        table = self._in_map(position)
        camera_from_grid = np.asarray(exterior.camera_from_object) @ system.local_from_grid(position)
        table[["omega_deg", "phi_deg", "kappa_deg"]] = angles_deg(camera_from_grid)
        table.insert(0, "image", self.adjusted.block.images)
        return table

    @cached_property
    def object_points_map(self) -> pd.DataFrame:
        """Object points in the system of the block's files."""
        table = self._in_map(np.asarray(self.adjusted.unknowns.points))
        table.insert(0, "point", self.adjusted.block.points)
        return table

    def _in_map(self, local: Float[np.ndarray, "n 3"]) -> pd.DataFrame:
        system = self.adjusted.block.frame.map
        names = ["longitude_deg", "latitude_deg", "height_m"] if system.geographic else ["E_m", "N_m", "H_m"]
        return pd.DataFrame(system.map(local), columns=names)

    @cached_property
    def object_points(self) -> pd.DataFrame:
        """Object points: point, coordinates, sigmas, n_images, angle_deg (largest intersection angle of two rays)."""
        names = [f"{a}_m" for a in AXES]
        values = np.hstack([np.asarray(self.adjusted.unknowns.points), self._if_converged(self.covariance.point_sigma)])
        table = pd.DataFrame(values, columns=[*names, *(f"sigma_{n}" for n in names)])
        table.insert(0, "point", self.adjusted.block.points)
        table["n_images"] = np.bincount(self.adjusted.structure.point, minlength=len(table))
        table["angle_deg"] = np.degrees(intersection_angles(self.adjusted))
        return table

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """Residuals, one row per observation.

        Columns: group, image, point, axis, residual, sigma (a priori), unit, redundancy_number, w, detectable, c_moves,
        xp_moves, yp_moves, most_moves.

        `w` is the normalised residual, v / (sigma0 sigma sqrt(r)); `detectable` is the minimal detectable bias (power
        80 %). The last four columns are the external reliability: shift of c, x_p, y_p, and the largest shift of any
        unknown, by a bias of one MDB, in standard deviations. Names are categories, and columns are built one by one:
        otherwise millions of observations would need ten times the memory.
        """
        adjusted, block, s = self.adjusted, self.adjusted.block, self.adjusted.structure
        residual, sigma = statistics.physical_residuals(adjusted), statistics.a_priori_sigmas(adjusted)
        detectable = statistics.minimal_detectable_biases(adjusted, self.redundancy)
        labels = np.full(len(adjusted.values.shared), "", object)
        labels[s.free] = s.labels
        groups = {g: rows for g, rows in statistics.observation_groups(adjusted).items() if np.size(residual[g])}

        def column(of: Callable[[str, AbstractObservations], Any]) -> np.ndarray:
            # Rows are along the last axis; in the table the components of a row are consecutive.
            flat = (np.broadcast_to(of(g, rows), np.shape(residual[g])).T.ravel() for g, rows in groups.items())
            return np.concatenate(list(flat))

        def names(of: Callable[[str, AbstractObservations], Any]) -> pd.Categorical:
            return pd.Categorical(column(lambda g, rows: np.asarray(of(g, rows), object)))

        def numbers(values: Mapping[str, ArrayLike]) -> np.ndarray:
            return column(lambda g, rows: values[g])

        def in_units(values: Mapping[str, ArrayLike]) -> np.ndarray:
            return column(lambda g, rows: in_file_unit(rows.unit)[0] * np.asarray(values[g]))

        def axis(group: str, rows: AbstractObservations) -> np.ndarray:
            axes = rows.axis_names()
            return np.where(axes == "", rows.names_of("parameter", labels), axes)

        columns = {
            "group": names(lambda g, rows: g), "image": names(lambda g, rows: rows.names_of("image", block.images)),
            "point": names(lambda g, rows: rows.names_of("point", block.points)), "axis": names(axis),
            "residual": in_units(residual), "sigma": in_units(sigma),
            "unit": names(lambda g, rows: in_file_unit(rows.unit)[1]),
            "redundancy_number": numbers(self.redundancy.named), "w": numbers(self.w.named),
            "detectable": in_units(detectable),
            **{f"{p.removesuffix('_mm')}_moves": numbers(v) for p, v in self.undetected.interior.items()},
            "most_moves": numbers(self.undetected.most),
        }  # fmt: skip
        return pd.DataFrame(columns, copy=False)

    @cached_property
    def trends(self) -> pd.DataFrame:
        """Systematic effects, one row each.

        Columns: pattern, freedom (degrees of freedom), p_value, rms, unit; term, share, amount and sigma of the term
        that explains most. `rms` is the explained part of the residuals without noise, NaN if there is none.
        """
        rows = []
        for t in self.tested_trends:
            factor, unit = in_file_unit(t.pattern.unit)
            best = t.hints[0][:4] if t.hints else None
            term = (best[0].name, *best[1:]) if best else ("", np.nan, np.nan, np.nan)
            rows.append((t.pattern.what, t.freedom, t.p_value, factor * t.size if t.size > 0 else np.nan, unit, *term))
        columns = ["pattern", "freedom", "p_value", "rms", "unit", "term", "share", "amount", "sigma"]
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def residual_spread(self) -> pd.DataFrame:
        """Spread of the residuals: group, axis, n, mean, rmse, max_abs, unit (paper 000, Table 3)."""
        columns = ["group", "axis", "n", "mean", "rmse", "max_abs", "unit"]
        rows = []
        for s in statistics.residual_spread(self.adjusted):
            factor, unit = in_file_unit(s.unit)
            rows.append((s.group, s.axis, s.n, factor * s.mean, factor * s.rmse, factor * s.max_abs, unit))
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def check_points(self) -> pd.DataFrame:
        """Discrepancies at check points: point; dX_m, dY_m, dZ_m (surveyed minus computed); sigma_dX_m, ...

        The standard deviations combine survey and adjustment. Values are NaN for axes that were not surveyed.
        """
        rows, names = statistics.check_discrepancies(self.adjusted), [f"d{axis}_m" for axis in AXES]
        who, at = pd.factorize(np.asarray(rows.who)), np.asarray(self.covariance.point_sigma)[rows.who, rows.axis]
        values = np.full((2, len(who[1]), 3), np.nan)
        values[:, who[0], rows.axis] = rows.value, np.hypot(np.asarray(rows.sigma), at)
        table = pd.DataFrame(np.hstack(list(values)), columns=[*names, *(f"sigma_{name}" for name in names)])
        table.insert(0, "point", [self.adjusted.block.points[p] for p in who[1]])
        return table

    @cached_property
    def correlation(self) -> pd.DataFrame:
        """Correlations of interior parameters and exterior orientations: parameter_a, parameter_b, rho.

        The table contains all pairs of interior parameters of a camera, and all pairs of an exterior element of an
        image with its interior parameters and its other exterior elements.
        """
        rows = []
        for camera, c in self.correlations.items():
            labels = [f"interior[{camera}].{p}" for p in c.parameters]
            rows += [(a, b, c.interior[i, j]) for i, a in enumerate(labels) for j, b in enumerate(labels) if i != j]
            for image, rho, within in zip(c.images, c.exterior, c.within_image, strict=True):
                eop = [f"exterior[{image}].{name}" for name in c.eop_names]
                rows += [(a, b, rho[i, j]) for i, a in enumerate(eop) for j, b in enumerate(labels)]
                rows += [(a, b, within[i, j]) for i, a in enumerate(eop) for j, b in enumerate(eop) if i != j]
        return pd.DataFrame(rows, columns=["parameter_a", "parameter_b", "rho"])

    @cached_property
    def correlation_summary(self) -> pd.DataFrame:
        """Correlations over the images of each camera (paper 000, Table 4).

        Columns: camera, exterior, interior, mean_abs_rho, max_abs_rho.
        """
        rows = [
            (camera, name, parameter, c.mean_abs[i, j], c.max_abs[i, j])
            for camera, c in self.correlations.items()
            if c.images and c.parameters
            for i, name in enumerate(c.eop_names)
            for j, parameter in enumerate(c.parameters)
        ]
        return pd.DataFrame(rows, columns=["camera", "exterior", "interior", "mean_abs_rho", "max_abs_rho"])

    @cached_property
    def correlation_ground(self) -> pd.DataFrame:
        """Correlations of each camera with height and doming of the ground; empty unless the images look down.

        Columns: camera, ground (height, flying_height, dome), sigma_m, parameter, rho. The parameter `all` has the
        multiple correlation with all parameters of the camera.
        """
        rows = [
            (camera, form, g.sigma_m[k], parameter, rho)
            for camera, g in self.ground_correlations.items()
            for k, form in enumerate(FORMS)
            for parameter, rho in zip((*g.parameters, "all"), (*g.rho[k], g.together[k]), strict=True)
        ]
        return pd.DataFrame(rows, columns=["camera", "ground", "sigma_m", "parameter", "rho"])

    @cached_property
    def sigma_map(self) -> pd.DataFrame:
        """Projection uncertainty, one row per cell.

        Columns: camera, distance_m (inf: direction), x_mm, y_mm, sigma_x_px, sigma_y_px, worst_px.
        """
        names = ["distance_m", "x_mm", "y_mm", "sigma_x_px", "sigma_y_px", "worst_px"]
        frames = [pd.DataFrame({"camera": [], **dict.fromkeys(names, np.zeros(0))})]
        for one in (one for both in self.sigma_maps.values() for one in both):
            in_mm = np.column_stack([np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2)), one.worst])
            sigma = in_mm / self.adjusted.block.sensors[one.camera].pixel_mm
            rows = np.column_stack([np.full(len(sigma), one.distance_m), one.points, sigma])
            frames.append(pd.DataFrame(rows, columns=names).assign(camera=one.camera))
        return pd.concat(frames[1:] or frames, ignore_index=True)[["camera", *names]]

    @cached_property
    def convergence(self) -> pd.DataFrame:
        """Iteration history: step, sigma0, length, damping, bent, taken; the last row is the final state."""
        return convergence_table(self.adjusted)

    @cached_property
    def recovery(self) -> pd.DataFrame:
        """Recovery of a simulation: parameter, estimate, truth, error, sigma, ratio, unit."""
        return recovery_table(self, self.truth or {})


def _is_table(member: object) -> bool:
    return isinstance(member, cached_property) and member.func.__annotations__["return"] is pd.DataFrame


def angles_deg(camera_from_object: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "images 3"]:
    """Angles omega, phi, kappa (degrees)."""
    return np.degrees(np.asarray(call_compiled(_angles, camera_from_object)))


@eqx.filter_jit
def _angles(camera_from_object):
    return jax.vmap(omega_phi_kappa_from_matrix)(camera_from_object)


def convergence_table(adjusted: Adjustment) -> pd.DataFrame:
    """Tabulate the iteration history; empty if unknown.

    Columns: step, sigma0 (before the step), length, damping, bent, taken (yes, no). `length` is the largest change of
    an unknown in its standard deviations. `bent` is the fraction of the step that was tried along its curve (geodesic
    acceleration), NaN for a straight step. The last row is the final state.
    """
    history, redundancy = adjusted.history, max(adjusted.redundancy, 1)
    if history is None:
        return pd.DataFrame(columns=["step", "sigma0", "length", "damping", "bent", "taken"])
    n = len(history.length)
    # A very long history contains only the first steps; the final state is always known.
    end = n == int(adjusted.steps)
    sums = np.append(history.sum_of_squares, float(adjusted.sum_of_squares)) if end else history.sum_of_squares
    columns = {
        "step": [*map(str, range(1, n + 1)), *(["end"] if end else [])], "sigma0": np.sqrt(sums / redundancy),
        "length": history.length, "damping": history.damping,
        "bent": np.where(history.bent > 0, history.bent, np.nan), "taken": np.where(history.accepted > 0, "yes", "no"),
    }  # fmt: skip
    return pd.DataFrame({name: pd.Series(values) for name, values in columns.items()}).fillna({"taken": ""})


def estimates_table(tables: Tables, start: Unknowns | None = None) -> pd.DataFrame:
    """Tabulate the estimated parameters of cameras, scanner, mounts and strips; angles in degrees.

    Columns: parameter (path), initial (of `start`, by default of the block), value, sigma (a posteriori; NaN if not
    converged), unit.
    """
    initial = initial_values(start or tables.adjusted.block.start.unknowns)
    camera = tables.interior[tables.interior["sigma"].notna()]
    paths = "interior[" + camera["camera"].astype(str) + "]." + camera["parameter"].astype(str)
    table = pd.concat([camera.assign(parameter=paths), tables.georeferencing], ignore_index=True)
    units = [label_unit(path, tables.adjusted.unknowns.interior) for path in table["parameter"]]
    numbers = {"initial": table["parameter"].map(initial), "value": table["value"], "sigma": table["sigma"]}
    # Convert: without parameters of mounts and strips, the columns are objects.
    table = table.assign(**{name: v.astype(float) for name, v in numbers.items()}, unit=np.array(units, object))
    return table[["parameter", "initial", "value", "sigma", "unit"]]


def about_sigma(adjusted: Adjustment) -> str:
    """Describe the standard deviations of the estimates in a sentence."""
    return (
        f"Standard deviations are a posteriori (times sigma naught {float(adjusted.sigma0):.4f}, redundancy "
        f"{adjusted.redundancy})."
    )


def initial_values(start: Unknowns) -> dict[str, float]:
    """Return the values of all shared parameters by path; angles in degrees."""
    values = {
        f"interior[{name}].{p}": float(get_parameter(one, p))
        for name, one in start.interior.items()
        for p in parameter_names(one)
    }
    for owners in start.tables.values():
        for owner, one in owners.items():
            for path, value in zip(one.labels(owner), numbers_of(one), strict=True):
                factor = 180 / np.pi if path.endswith(("_rad", "_rad_per_s")) else 1.0
                values[path.replace("_rad", "_deg")] = factor * float(value)
    return values


def check_spread(check: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the discrepancies at check points: axis, n, mean, rmse, max_abs, point (of the largest), unit."""
    values = check.set_index("point")[[f"d{axis}_m" for axis in AXES]].set_axis(AXES, axis=1)
    spread = {"mean": values.mean(), "rmse": np.sqrt((values**2).mean()), "max_abs": values.abs().max()}
    largest = [v.abs().idxmax() if v.notna().any() else "" for _, v in values.items()]
    table = pd.DataFrame({"n": values.count(), **spread, "point": largest})
    return table.reset_index(names="axis").assign(unit="m")


def side_by_side(table: pd.DataFrame, rows: list[str], column: str, value: str) -> pd.DataFrame:
    """Pivot a table of correlations; the column camera is dropped if there is only one."""
    named = table.assign(**{column: table[column].map(symbol)})
    wide = named.pivot_table(value, rows, column, aggfunc="first", sort=False).reset_index()
    return wide if len(wide["camera"].unique()) > 1 else wide.drop(columns="camera")


def recovery_table(tables: Tables, truth: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Tabulate estimates and true values: parameter, estimate, truth, error, sigma, ratio (error / sigma), unit.

    `truth` contains the tables of `jaxphoto.io.truth_tables(simulation)`, with columns as in the result tables.
    Quantities missing on one side are skipped. If the model is correct, the ratio is standard normal, except for the
    datum.
    """
    empty = {name: pd.Series([], dtype=float) for name in ("estimate", "truth", "sigma")}
    frames = [pd.DataFrame({"parameter": pd.Series([], dtype=str), **empty})]
    for name in (name for name in ("interior", "georeferencing", "exterior", "object_points") if name in truth):
        estimated, true = getattr(tables, name), truth[name]
        if "value" in true:
            keys = [c for c in ("camera", "parameter") if c in true]
            both = estimated.merge(true, on=keys, suffixes=("", "_true"))
            label = "interior[" + both["camera"].astype(str) + "]." if "camera" in both else ""
            columns = {"estimate": both["value"], "truth": both["value_true"], "sigma": both["sigma"]}
            frames.append(pd.DataFrame({"parameter": label + both["parameter"], **columns}))
            continue
        key, prefix = ("image", "exterior") if name == "exterior" else ("point", "points")
        estimated, true = (t.assign(**{key: t[key].astype(str)}).set_index(key) for t in (estimated, true))
        both, names = estimated.index.intersection(true.index, sort=False), list(true)
        labels = [f"{prefix}[{one}].{column}" for one in both for column in names]
        sides = {"estimate": estimated[names], "truth": true, "sigma": estimated[[f"sigma_{c}" for c in names]]}
        columns = {side: table.loc[both].to_numpy(float).ravel() for side, table in sides.items()}
        frames.append(pd.DataFrame({"parameter": labels, **columns}))
    rows = pd.concat([f for f in frames if len(f)] or frames, ignore_index=True)
    rows = rows[rows["sigma"] > 0].reset_index(drop=True)
    error = rows["estimate"] - rows["truth"]
    error = error.where(~rows["parameter"].str.endswith("_deg"), (error + 180) % 360 - 180)
    cameras = tables.adjusted.unknowns.interior
    units = [label_unit(label, cameras) for label in rows["parameter"]]
    rows = rows.assign(error=error, ratio=error / rows["sigma"], unit=np.array(units, object))
    return rows[["parameter", "estimate", "truth", "error", "sigma", "ratio", "unit"]]


def recovery_spread(recovery: pd.DataFrame) -> pd.DataFrame:
    """Summarise a `recovery_table`: group, n, rms_ratio, beyond_2_sigma (about 1 and 5 % if the model is correct).

    Groups are each camera, mount and strip, and each coordinate and angle of all images and of all points.
    """
    label = recovery["parameter"]
    many = label.str.extract(r"^(exterior|points)\[.*\]\.(.+)$")
    group = (many[0] + " " + many[1]).fillna(label.str.replace(r"\]\..*$", "]", regex=True))
    grouped = recovery["ratio"].groupby(group, sort=False)
    columns = {
        "n": grouped.size(),
        "rms_ratio": np.sqrt(grouped.apply(lambda r: float(np.mean(np.square(r))))),
        "beyond_2_sigma": grouped.apply(lambda r: f"{100 * np.mean(np.abs(r) > 2):.1f} %"),
    }
    return pd.DataFrame(columns).reset_index(names="group")
