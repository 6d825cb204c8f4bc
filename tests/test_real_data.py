"""Real measurements and the published results of their adjustment by other programs."""

import dataclasses
import re

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, covariance, read_source
from jaxphoto.adjustment import Outcome
from jaxphoto.block import Frame
from jaxphoto.camera import get_parameter
from jaxphoto.procedures.control import at_optimum, control_block
from jaxphoto.procedures.orientation.blocks import Similarity
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from jaxphoto.statistics import (
    check_discrepancies,
    correlation_matrix,
    correlations,
    normalised_residuals,
    physical_residuals,
    redundancy_numbers,
)
from tests.aicon import read_aicon
from tests.dbat_report import EOP, assert_printed, read_report
from tests.procedures.controlled import surveyed_and_without


def adjusted_block(block, rotations="omega_phi_kappa"):
    adjusted = adjust(block)
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted, covariance(adjusted, rotations)


def check_summary(adjusted, report, digits):
    assert_printed(float(adjusted.sigma0), report.sigma0, digits, "sigma0")
    assert adjusted.redundancy == report.redundancy
    assert sum(adjusted.n_unknowns.values()) == report.n_unknowns
    assert sum(adjusted.n_observations.values()) == report.n_observations


def check_exterior(adjusted, cov, report, metres=1e-5, degrees=1e-6):
    """Every position, angle and standard deviation, as printed."""
    exterior = adjusted.unknowns.exterior
    angles = np.degrees(np.asarray(exterior.omega_phi_kappa))
    values = np.hstack([np.asarray(exterior.position), angles])
    sigmas = np.asarray(cov.exterior_sigma) * [1, 1, 1, *[180 / np.pi] * 3]
    assert tuple(report.photos) == adjusted.block.images
    for i, image in enumerate(adjusted.block.images):
        for k, name in enumerate(EOP):
            printed = report.photos[image][name]
            difference = values[i, k] - printed.value
            if k >= 3:
                difference = (difference + 180) % 360 - 180
            assert abs(difference) < (metres if k < 3 else degrees), (image, name, values[i, k], printed)
            assert_printed(sigmas[i, k], printed.deviation, 3, f"sigma of {name} of {image}")


def check_high_correlations(adjusted, cov, report):
    """Correlations over 95 % within an image: exactly those that are listed, to the printed tenth of a percent."""
    rho = 100 * correlation_matrix(cov)
    listed = 0
    for i, image in enumerate(adjusted.block.images):
        for a, name in enumerate(EOP):
            ours = {EOP[b]: rho[6 * i + a, 6 * i + b] for b in range(6) if b != a}
            theirs = report.photos[image][name].correlations
            assert {other for other, value in ours.items() if abs(value) > 95} == set(theirs), (image, name)
            for other, value in theirs.items():
                assert abs(ours[other] - value) <= 0.05 + 1e-9, (image, name, other, ours[other], value)
                listed += 1
    return listed


@pytest.fixture(scope="module")
def sxb(data_dir):
    return *adjusted_block(read_source(data_dir / "sxb")), read_report(data_dir / "sxb" / "result" / "report.txt")


def test_sxb_main_report(sxb):
    adjusted, cov, report = sxb
    assert report.redundancy == 1261
    assert report.sigma0 == 1.1786
    check_summary(adjusted, report, 5)
    check_exterior(adjusted, cov, report)
    assert check_high_correlations(adjusted, cov, report) > 0


def test_sxb_from_a_frame_of_its_own_by_control_and_marks(sxb):
    """Turned, shifted and made smaller, its surveyed points given as files give them: the same adjustment again."""
    adjusted, _, report = sxb
    control, without = surveyed_and_without(at_optimum(adjusted))
    turn = np.asarray(matrix_from_omega_phi_kappa(np.array([0.3, -0.5, 1.0])))
    similarity = Similarity(np.array([3.0, 4.0, 5.0]), turn, 1e-3)
    away = dataclasses.replace(similarity.of_block(without), frame=Frame("local"))
    found = control_block(away, control, adjust=adjust)
    assert found.state.count("control") == 14 and found.state.count("check") == 2
    # No mark is left out, though they scatter by more than was said of them.
    assert found.adjusted.redundancy == report.redundancy
    np.testing.assert_allclose(float(found.adjusted.sigma0), float(adjusted.sigma0), rtol=1e-9)
    there, again = (np.asarray(a.unknowns.exterior.position) for a in (adjusted, found.adjusted))
    np.testing.assert_allclose(again, there, atol=1e-5)


def test_sxb_control_and_check_points(sxb):
    """Adjusted coordinates to the printed millimetre, their standard deviations to 3 digits, and discrepancies."""
    adjusted, cov, report = sxb
    assert len(report.control) == 14
    assert len(report.check) == 2
    points, sigmas = np.asarray(adjusted.unknowns.points), np.asarray(cov.point_sigma)
    for name, printed in {**report.control, **report.check}.items():
        p = adjusted.block.points.index(name)
        np.testing.assert_allclose(points[p], printed[:3], atol=0.5e-3 + 1e-9)
        for axis in range(3):
            assert_printed(sigmas[p, axis], printed[3 + axis], 3, f"sigma of point {name}, axis {axis}")
    rows = check_discrepancies(adjusted)
    assert len(rows.who) == 6
    for who, axis, value in zip(rows.who, rows.axis, np.asarray(rows.value), strict=True):
        # DBAT: computed minus surveyed; ours: surveyed minus computed.
        assert abs(-value - report.check_difference[adjusted.block.points[who]][axis]) <= 0.5e-3 + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stations", "file", "sigma0", "redundancy"),
    [
        (True, "sxb-prior-eo-dbatreport.txt", 1.06942, 1279),
        (False, "sxb-no-prior-eo-dbatreport.txt", 1.07447, 1267),
    ],
    ids=["with-priors", "without"],
)
def test_sxb_with_and_without_station_priors(data_dir, stations, file, sigma0, redundancy):
    folder = data_dir / "sxb" / "prior_eo"
    report = read_report(folder / file)
    assert (report.sigma0, report.redundancy) == (sigma0, redundancy)
    block = read_source(folder, "photomodeler")
    if not stations:
        block = dataclasses.replace(block, stations=block.stations.take(np.zeros(0, int)))
    adjusted, cov = adjusted_block(block)
    check_summary(adjusted, report, 6)
    check_exterior(adjusted, cov, report)
    assert check_high_correlations(adjusted, cov, report) > 0


# DBAT's name, our parameter, the factor from ours to theirs, significant digits of the printed value.
CAMCAL = [
    ("Camera Constant", "c_mm", 1.0, 4),
    ("px", "xp_mm", 1.0, 6),
    ("py", "yp_mm", -1.0, 6),
    ("K1", "k1", -1.0, 6),
    ("K2", "k2", -1.0, 6),
    ("K3", "k3", -1.0, 6),
    ("P1", "p1", -1.0, 6),
    ("P2", "p2", -1.0, 6),
    ("as", "b1", -1.0, 6),
]


@pytest.fixture(scope="module")
def camcal(data_dir):
    return (
        *adjusted_block(read_source(data_dir / "camcal")),
        read_report(data_dir / "camcal" / "result" / "report.txt"),
    )


def test_camcal_interior(camcal):
    adjusted, cov, report = camcal
    assert (report.sigma0, report.redundancy) == (1.6148, 3725)
    check_summary(adjusted, report, 5)
    assert tuple(report.camera) == tuple(name for name, *_ in CAMCAL)
    interior = adjusted.unknowns.interior["camera"]
    sigmas = dict(zip(cov.labels[6 * cov.n_images :], np.asarray(cov.shared_sigma), strict=True))
    sensor = adjusted.block.sensors["camera"]
    half = {"xp_mm": sensor.width_mm / 2 + 0.5 * sensor.pixel_mm, "yp_mm": sensor.height_mm / 2 + 0.5 * sensor.pixel_mm}
    for theirs, ours, factor, digits in CAMCAL:
        printed = report.camera[theirs]
        value = factor * float(get_parameter(interior, ours)) + half.get(ours, 0.0)
        assert_printed(value, printed.value, digits, ours, 1e-4 * printed.deviation)
        assert_printed(sigmas[f"interior[camera].{ours}"], printed.deviation, 3, f"sigma of {ours}")


def test_camcal_correlation_of_k2_and_k3(camcal):
    adjusted, cov, report = camcal
    c = correlations(adjusted, cov)["camera"]
    names, rho = list(c.parameters), 100 * np.asarray(c.interior)
    high = {(a, b) for i, a in enumerate(names) for j, b in enumerate(names) if i != j and abs(rho[i, j]) > 95}
    assert high == {("k2", "k3"), ("k3", "k2")}
    assert report.camera["K2"].correlations == {"K3": -97.9}
    assert abs(rho[names.index("k2"), names.index("k3")] + 97.9) <= 0.05


def test_camcal_exterior(camcal):
    check_exterior(*camcal)


AICON_IOP = ("Ck", "Xh", "Yh", "A1", "A2", "B1", "B2")
OUR_IOP = ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1", "b2")
# Ck = -c: its correlations change sign.
SIGN = np.array([-1.0, 1, 1, 1, 1, 1, 1])
NUMBER = r"-?\d+\.\d+(?:e[+-]\d+)?"


def numbers(line):
    return [float(v) for v in re.findall(NUMBER, line)]


@pytest.fixture(scope="module")
def aicon_report(data_dir):
    return (data_dir / "aicon" / "report.txt").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def aicon(data_dir):
    """As converted: 0.5 um for every image coordinate."""
    block = read_aicon(data_dir / "aicon")
    assert (len(block.images), len(block.points), len(block.image_points.point)) == (115, 150, 9972)
    return adjusted_block(block, "object")


@pytest.fixture(scope="module")
def aicon_weights(data_dir, aicon_report):
    """With the standard deviations that the report prints: 5 um for four image points, 0.5 um for the others."""
    block = read_aicon(data_dir / "aicon")
    which, values = aicon_image_points(block, aicon_report)
    assert (values[:, 4:6] == 0.005).sum() == 8
    assert (values[:, 4:6] == 0.0005).sum() == 2 * 9972 - 8
    sigma = np.array(block.image_points.sigma)
    sigma[which] = values[:, 4:6]
    return adjusted_block(eqx.tree_at(lambda b: b.image_points.sigma, block, sigma), "object")


def aicon_image_points(block, report):
    """Our row of each line of the report, and x, y, vx, vy, sx, sy, rx, ry, |wx|, |wy| of the lines."""
    section = report.split("*** Bildkoordinaten", 1)[1].split("Max Verbesserung", 1)[0]
    lines = re.findall(rf"^ +(\d+) +(\d+) +((?:{NUMBER} +){{10}})$", section, re.M)
    rows = block.image_points
    place = {(block.points[p], block.images[i]): k for k, (p, i) in enumerate(zip(rows.point, rows.image, strict=True))}
    assert len(lines) == len(place) == 9972
    return [place[point, image] for point, image, _ in lines], np.array([numbers(cells) for *_, cells in lines])


def aicon_images(report):
    """By image: sigma of x, y, z (mm) and of the rotations about the axes (rad), 6 x 7 correlations."""
    result = {}
    section = report.split("*** Äussere Orientierungen", 1)[1].split("*** Objektpunkte", 1)[0]
    pattern = r"^ +(\d+) +1 +(-?\d+\.\d{4}.*)\n.*rad.*\n(.*)\n +Korrelationen:\n((?:.*\n){6})"
    for head in re.finditer(pattern, section, re.M):
        rho = np.array([numbers(line) for line in head[4].splitlines()])
        result[head[1]] = numbers(head[2])[3:6], numbers(head[3])[:3], rho
    return result


def check_aicon_summary(adjusted, report):
    assert adjusted.redundancy == 18804
    assert int(re.search(r"Gesamtredundanz\s+: (\d+)", report)[1]) == 18804
    assert (sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())) == (19945, 1147)
    assert adjusted.n_constraints == 6


def aicon_interior(adjusted, cov, report):
    """Our values and sigmas, and the report's, in its order and sign."""
    sigmas = dict(zip(cov.labels[6 * cov.n_images :], np.asarray(cov.shared_sigma), strict=True))
    assert tuple(sigmas) == tuple(f"interior[1].{name}" for name in OUR_IOP)
    interior = adjusted.unknowns.interior["1"]
    values = SIGN * [float(get_parameter(interior, name)) for name in OUR_IOP]
    printed = np.array([numbers(re.search(rf"^ {name} .*$", report, re.M)[0])[:2] for name in AICON_IOP])
    return values, np.array(list(sigmas.values())), printed[:, 0], printed[:, 1]


def check_aicon_correlations(adjusted, cov, report, tolerance, but=frozenset()):
    c = correlations(adjusted, cov)["1"]
    assert c.parameters == OUR_IOP
    assert c.eop_names == ("X", "Y", "Z", "rX", "rY", "rZ")
    lines = report.split("Korrelation:\n", 1)[1].splitlines()[:7]
    for i, line in enumerate(lines):
        assert line.startswith(AICON_IOP[i])
        np.testing.assert_allclose((SIGN[i] * SIGN * c.interior[i])[: i + 1], numbers(line), atol=tolerance)
    printed = aicon_images(report)
    assert set(printed) == set(c.images)
    assert len(c.images) == 115
    theirs = np.stack([printed[image][2] for image in c.images])
    assert theirs.shape == (115, 6, 7)
    off = np.abs(np.asarray(c.exterior) * SIGN - theirs).max(axis=(1, 2)) > tolerance
    assert {image for image, too_much in zip(c.images, off, strict=True) if too_much} == but


@pytest.mark.slow
def test_aicon(aicon, aicon_report):
    adjusted, cov = aicon
    check_aicon_summary(adjusted, aicon_report)
    assert abs(float(adjusted.sigma0) * 0.0005 - 0.0004056) < 0.5e-7
    values, sigmas, their_values, their_sigmas = aicon_interior(adjusted, cov, aicon_report)
    np.testing.assert_allclose(sigmas, their_sigmas, rtol=2e-3)
    # Four image points weigh differently there (`aicon_weights`), which moves the unknowns by some tenths of a sigma.
    np.testing.assert_array_less(np.abs(values - their_values) / their_sigmas, 0.5)
    # Two images of few rays show those four points.
    check_aicon_correlations(adjusted, cov, aicon_report, 2e-3, but={"48", "54"})


@pytest.mark.slow
def test_aicon_with_its_own_weights(aicon_weights, aicon_report):
    """Interior and exterior orientation: every printed digit of values, standard deviations and correlations."""
    adjusted, cov = aicon_weights
    check_aicon_summary(adjusted, aicon_report)
    assert_printed(float(adjusted.sigma0) * 0.0005, 0.000405, 3, "s0")
    values, sigmas, their_values, their_sigmas = aicon_interior(adjusted, cov, aicon_report)
    for k, name in enumerate(AICON_IOP):
        assert_printed(values[k], their_values[k], 7, name, 1e-5 * their_sigmas[k])
        assert_printed(sigmas[k], their_sigmas[k], 7, f"sigma of {name}")
    check_aicon_correlations(adjusted, cov, aicon_report, 0.5e-3 + 1e-6)

    printed = aicon_images(aicon_report)
    order = [printed[image] for image in adjusted.block.images]
    sigma = np.asarray(cov.exterior_sigma)
    np.testing.assert_allclose(1000 * sigma[:, :3], [p[0] for p in order], atol=0.51e-4)
    # Its rotation parameters run twice as fast as the angle (2 rad a radian); its sO, sP, sK are not compared.
    np.testing.assert_allclose(2 * sigma[:, 3:], [p[1] for p in order], atol=0.51e-6)


@pytest.mark.slow
def test_aicon_object_points(aicon_weights, aicon_report):
    """Coordinates and standard deviations under inner constraints, as printed (1e-4 mm)."""
    adjusted, cov = aicon_weights
    section = aicon_report.split("*** Objektpunkte", 1)[1].split("Maximale", 1)[0]
    rows = re.findall(rf"^ +(\d+) +((?:{NUMBER} +){{6}})(\d+) ", section, re.M)
    assert len(rows) == 150
    which = [adjusted.block.points.index(name) for name, *_ in rows]
    values = np.array([numbers(cells) for _, cells, _ in rows])
    np.testing.assert_allclose(1000 * np.asarray(cov.point_sigma)[which], values[:, 3:], atol=0.51e-4)
    # The datum is inner constraints about the approximate values, which the files give to 1e-4 mm.
    np.testing.assert_allclose(1000 * np.asarray(adjusted.unknowns.points)[which], values[:, :3], atol=0.6e-4)


@pytest.mark.slow
def test_aicon_residuals_redundancy_numbers_and_tests(aicon_weights, aicon_report):
    """Of all 9,972 image points, as printed (1e-6 mm, 2 digits, 2 digits)."""
    adjusted, cov = aicon_weights
    which, values = aicon_image_points(adjusted.block, aicon_report)
    redundancy = redundancy_numbers(adjusted, cov)
    w = normalised_residuals(adjusted, redundancy)
    observed_minus_computed = np.asarray(physical_residuals(adjusted)["image_points"]).T[which]
    # The report's "Verbesserung" is computed minus observed.
    np.testing.assert_allclose(-observed_minus_computed, values[:, 2:4], atol=0.51e-6)
    np.testing.assert_allclose(np.asarray(redundancy.image).T[which], values[:, 6:8], atol=0.00501)
    np.testing.assert_allclose(np.abs(w.image).T[which], values[:, 8:10], atol=0.00501)
    total = sum(float(np.sum(r)) for r in redundancy.named.values())
    assert abs(total - 18804) < 1e-6 * 18804
