"""The tables of an adjustment as pandas frames: the columns of the result folder (docs/block_folder.md)."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Residuals
from jaxphoto.arrays import Numbers
from jaxphoto.observations import AXES
from jaxphoto.report.camera_drift_table import camera_drift_table
from jaxphoto.report.check_points import check_point_table
from jaxphoto.report.convergence_table import convergence_table
from jaxphoto.report.correlation_tables import correlation_ground_table, correlation_summary_table
from jaxphoto.report.interior_table import interior_table
from jaxphoto.report.map_tables import angles_deg, exterior_map_table, map_coordinates
from jaxphoto.report.positional_accuracy import accuracy_table
from jaxphoto.report.recovery import recovery_table
from jaxphoto.report.residual_table import in_file_unit, residual_table
from jaxphoto.report.sigma_map_table import sigma_map_table
from jaxphoto.statistics import (
    BlunderTest,
    CameraDrift,
    Correlations,
    Covariance,
    EffectTest,
    GroundCorrelations,
    MdbEffects,
    PositionalAccuracy,
    Redundancy,
    Rotations,
    Significance,
    Suspect,
    blunder_test,
    camera_drifts,
    check_discrepancies,
    correlations,
    covariance,
    ground_correlations,
    mdb_effects,
    multiple_outlier_test,
    normalised_residuals,
    positional_accuracy,
    prepare_statistics,
    redundancy_numbers,
    residual_spread,
    significance,
    systematic_effect_tests,
)
from jaxphoto.statistics.block_geometry import intersection_angles
from jaxphoto.statistics.sigma_map import SigmaMap, sigma_maps
from jaxphoto.tracing import refuse_traced


class Tables:
    """An adjustment as tables, each computed when first asked for.

    `rotations` says which rotations the correlations mean (see `jaxphoto.covariance`). Sigmas are a posteriori (times
    sigma0) unless a column says otherwise; units stand in the column names or in a column `unit`. `truth` is that of a
    simulation (`jaxphoto.io.truth_tables`, `read_truth`), for `recovery`. `known` is the covariance of
    this adjustment with omega, phi, kappa, where that was computed already, best with its `rows`.
    """

    def __init__(
        self,
        adjusted: Adjustment,
        rotations: Rotations = "omega_phi_kappa",
        truth: Mapping[str, pd.DataFrame] | None = None,
        known: Covariance | None = None,
    ):
        refuse_traced("Tables", adjusted)
        self.adjusted = adjusted
        self.rotations: Rotations = rotations
        self.truth = truth
        if known is not None and known.rotations != "omega_phi_kappa":
            raise ValueError(f"known is the covariance with omega, phi, kappa, not with {known.rotations!r}")
        self._known = known

    def __repr__(self) -> str:
        names = [name for name, own in vars(Tables).items() if _is_table(own)]
        return f"Tables of {self.adjusted!r};\n  {', '.join(names)}"

    def _repr_html_(self) -> str:
        """The interior orientation and the spread of residuals; the others are named."""
        shown = "".join(
            table.to_html(index=False, border=0, na_rep="") for table in (self.interior, self.residual_spread)
        )
        return f"{self.adjusted._repr_html_()}{shown}"

    @cached_property
    def covariance(self) -> Covariance:
        """Covariance with omega, phi, kappa."""
        # Most tables need redundancy numbers, too.
        prepare_statistics(self.adjusted.equations, self.adjusted.seconds)
        return covariance(self.adjusted, rows=True) if self._known is None else self._known

    def _told(self, sigma: Numbers) -> np.ndarray:
        """Standard deviations, but none of what did not converge: they would be of some other place."""
        return np.where(bool(self.adjusted.converged), np.asarray(sigma), np.nan)

    @cached_property
    def redundancy(self) -> Redundancy:
        """Redundancy number of every observation."""
        return redundancy_numbers(self.adjusted, self.covariance)

    @cached_property
    def w(self) -> Residuals:
        """Normalised residual of every observation."""
        return normalised_residuals(self.adjusted, self.redundancy)

    @cached_property
    def blunders(self) -> BlunderTest:
        """Every normalised residual against the critical value of all together."""
        return blunder_test(self.adjusted, self.redundancy)

    @cached_property
    def culprits(self) -> tuple[Suspect, ...]:
        """The suspects among them that the worse ones do not explain."""
        return multiple_outlier_test(self.adjusted, self.blunders)

    @cached_property
    def tested_trends(self) -> list[EffectTest]:
        """Patterns that the residuals may follow, tested; what contradicts the others has no part in them."""
        suspects = [(s.group, s.row) for s in self.blunders.suspects]
        return systematic_effect_tests(self.adjusted, np.asarray(self.covariance.shared_sigma), suspects)

    @cached_property
    def trends(self) -> pd.DataFrame:
        """One row a pattern: pattern, freedom, p_value, rms, unit; term, share, amount and sigma of what explains most.

        `rms` is of what the pattern explains of the residuals, without its noise, and NaN where that is nothing; units
        of terms are the camera's.
        """
        columns = ["pattern", "freedom", "p_value", "rms", "unit", "term", "share", "amount", "sigma"]
        rows = []
        for t in self.tested_trends:
            factor, unit = in_file_unit(t.pattern.unit)
            best = t.hints[0][:4] if t.hints else None
            told = (best[0].name, *best[1:]) if best else ("", np.nan, np.nan, np.nan)
            rms = factor * t.size if t.size > 0 else np.nan
            rows.append((t.pattern.what, t.freedom, t.p_value, rms, unit, *told))
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def undetected(self) -> MdbEffects:
        """What an error that no test finds does to the result."""
        return mdb_effects(self.adjusted, self.covariance, self.redundancy)

    @cached_property
    def correlations(self) -> dict[str, Correlations]:
        """Correlations by camera, as arrays."""
        chosen = self.covariance if self.rotations == "omega_phi_kappa" else covariance(self.adjusted, self.rotations)
        return correlations(self.adjusted, chosen)

    @cached_property
    def significance(self) -> list[Significance]:
        """Ratio and t-test of every estimated interior parameter; none where the adjustment did not converge."""
        if not bool(self.adjusted.converged):
            return []
        return significance(self.adjusted, self.covariance)

    @cached_property
    def interior(self) -> pd.DataFrame:
        """camera, parameter, value, sigma, significant, unit; fixed parameters have no sigma, nor has any
        that did not converge."""
        return interior_table(self.adjusted, self.significance)

    @cached_property
    def georeferencing(self) -> pd.DataFrame:
        """parameter, value, sigma of what was estimated of scanner, mounts and strips; units stand in the names."""
        s = self.adjusted.structure
        rows = []
        for k, label, sigma in zip(s.free, s.labels, self._told(self.covariance.shared_sigma), strict=True):
            if k >= s.n_cameras:
                factor = 180 / np.pi if label.endswith(("_rad", "_rad_per_s")) else 1.0
                value = float(self.adjusted.values.shared[k])
                rows.append((label.replace("_rad", "_deg"), factor * value, factor * float(sigma)))
        return pd.DataFrame(rows, columns=["parameter", "value", "sigma"])

    @cached_property
    def tested_drifts(self) -> list[CameraDrift]:
        """Of every camera with estimated rates, whether it changed during the flight."""
        return camera_drifts(self.adjusted, self.covariance)

    @cached_property
    def camera_drift(self) -> pd.DataFrame:
        """camera, along, span, parameter, change, sigma, p_value, detectable, unit: from end to end.

        `p_value` and `detectable` (found with a probability of 80 %) are of a change of this parameter alone.
        """
        return camera_drift_table(self.tested_drifts)

    @cached_property
    def exterior(self) -> pd.DataFrame:
        """image, X_m ... kappa_deg and their sigmas."""
        exterior = self.adjusted.unknowns.exterior
        angles = angles_deg(np.asarray(exterior.camera_from_object))
        sigma = self._told(self.covariance.exterior_sigma) * [1, 1, 1, *[180 / np.pi] * 3]
        names = ["X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg"]
        values = np.hstack([np.asarray(exterior.position), angles, sigma])
        table = pd.DataFrame(values, columns=[*names, *(f"sigma_{n}" for n in names)])
        table.insert(0, "image", self.adjusted.block.images)
        return table

    @cached_property
    def exterior_map(self) -> pd.DataFrame:
        """image, position in the system of the block's files, and omega, phi, kappa against grid east, north and up."""
        return exterior_map_table(self.adjusted)

    @cached_property
    def object_points_map(self) -> pd.DataFrame:
        """point and its coordinates in the system of the block's files."""
        table = map_coordinates(self.adjusted, np.asarray(self.adjusted.unknowns.points))
        table.insert(0, "point", self.adjusted.block.points)
        return table

    @cached_property
    def object_points(self) -> pd.DataFrame:
        """point, coordinates, sigmas, in how many images it was measured, the largest angle between two of its rays."""
        names = [f"{a}_m" for a in AXES]
        values = np.hstack([np.asarray(self.adjusted.unknowns.points), self._told(self.covariance.point_sigma)])
        table = pd.DataFrame(values, columns=[*names, *(f"sigma_{n}" for n in names)])
        table.insert(0, "point", self.adjusted.block.points)
        table["n_images"] = np.bincount(self.adjusted.structure.point, minlength=len(table))
        table["angle_deg"] = np.degrees(intersection_angles(self.adjusted))
        return table

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """One row an observation: group, image, point, axis, residual, sigma, unit, redundancy_number, w, detectable,
        c_moves, xp_moves, yp_moves, most_moves.

        `sigma` is a priori; `w` is the residual over its own standard deviation, sigma0 sigma sqrt(redundancy_number);
        `detectable` is the least error in it alone that the test of w finds with a probability of 80 %, and the last
        four by how many standard deviations that error moves c, x_p, y_p, and anything at most.
        """
        return residual_table(self.adjusted, self.redundancy, self.w, self.undetected)

    @cached_property
    def check_points(self) -> pd.DataFrame:
        """point, dX_m, dY_m, dZ_m: surveyed minus computed; sigma_dX_m, ...; empty where an axis was not surveyed."""
        return check_point_table(self.adjusted, self.covariance)

    @cached_property
    def tested_accuracy(self) -> PositionalAccuracy:
        """Positional accuracy by the check points."""
        return positional_accuracy(check_discrepancies(self.adjusted))

    @cached_property
    def positional_accuracy(self) -> pd.DataFrame:
        """component, check_points, fit_m, survey_m, rmse_m, class_cm, claimed (ASPRS Edition 2)."""
        return accuracy_table(self.tested_accuracy)

    @cached_property
    def correlation(self) -> pd.DataFrame:
        """parameter_a, parameter_b, rho: every IOP with every other; each image's EOP with its IOP and itself."""
        rows = []
        for camera, c in self.correlations.items():
            labels = [f"interior[{camera}].{p}" for p in c.parameters]
            rows += [(a, b, c.interior[i, j]) for i, a in enumerate(labels) for j, b in enumerate(labels) if i != j]
            for image, rho, own in zip(c.images, c.exterior, c.within_image, strict=True):
                eop = [f"exterior[{image}].{name}" for name in c.eop_names]
                rows += [(a, b, rho[i, j]) for i, a in enumerate(eop) for j, b in enumerate(labels)]
                rows += [(a, b, own[i, j]) for i, a in enumerate(eop) for j, b in enumerate(eop) if i != j]
        return pd.DataFrame(rows, columns=["parameter_a", "parameter_b", "rho"])

    @cached_property
    def correlation_summary(self) -> pd.DataFrame:
        """camera, exterior, interior, mean_abs_rho, max_abs_rho over the camera's images (paper 000, Table 4)."""
        return correlation_summary_table(self.correlations)

    @cached_property
    def ground_correlations(self) -> dict[str, GroundCorrelations]:
        """By camera, how it goes with height and dome of the ground, as arrays."""
        return ground_correlations(self.adjusted, self.covariance)

    @cached_property
    def correlation_ground(self) -> pd.DataFrame:
        """camera, ground (height, flying_height, dome), sigma_m, parameter, rho; of the parameter `all` the multiple
        correlation with all of the camera. Empty where photographs do not look down."""
        return correlation_ground_table(self.ground_correlations)

    @cached_property
    def sigma_maps(self) -> dict[str, tuple[SigmaMap, SigmaMap]]:
        """By camera that was estimated, at infinity and at the distance of its points, as arrays."""
        return sigma_maps(self.adjusted)

    @cached_property
    def sigma_map(self) -> pd.DataFrame:
        """camera, distance_m (inf: a direction), x_mm, y_mm, sigma_x_px, sigma_y_px, worst_px; a row a cell."""
        maps = (one for both in self.sigma_maps.values() for one in both)
        return sigma_map_table(maps, self.adjusted.block.sensors)

    @cached_property
    def convergence(self) -> pd.DataFrame:
        """step, sigma0, length, damping, taken: a row a step, the last of how it ended."""
        return convergence_table(self.adjusted)

    @cached_property
    def recovery(self) -> pd.DataFrame:
        """parameter, estimate, truth, error, sigma, ratio: of a simulation, what was found beside what is true."""
        return recovery_table(self, self.truth or {})

    @cached_property
    def residual_spread(self) -> pd.DataFrame:
        """group, axis, n, mean, rmse, max_abs, unit (paper 000, Table 3)."""
        columns = ["group", "axis", "n", "mean", "rmse", "max_abs", "unit"]
        return pd.DataFrame([[getattr(s, c) for c in columns] for s in residual_spread(self.adjusted)], columns=columns)


def _is_table(member: object) -> bool:
    return isinstance(member, cached_property) and member.func.__annotations__["return"] is pd.DataFrame
