"""Real measurements and the published results of their adjustment by other programs."""

import re

import numpy as np
import pytest

from jaxphoto import adjust, covariance, read_source
from jaxphoto.adjustment import Outcome
from jaxphoto.camera import get_parameter
from jaxphoto.statistics import (
    check_discrepancies,
    correlation_matrix,
    correlations,
    normalised_residuals,
    redundancy_numbers,
)
from tests.dbat_report import EOP, assert_printed, read_report


def adjusted_block(block):
    adjusted = adjust(block)
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted, covariance(adjusted)


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
            tolerance = metres if k < 3 else degrees
            assert abs(values[i, k] - printed.value) < tolerance, (image, name, values[i, k], printed)
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
    adjusted, cov = adjusted_block(read_source(folder, "photomodeler", stations=stations))
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
        assert_printed(value, printed.value, digits, ours)
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


@pytest.fixture(scope="module")
def aicon(data_dir):
    adjusted, _ = adjusted_block(read_source(data_dir / "aicon"))
    report = (data_dir / "aicon" / "report.txt").read_text(encoding="utf-8")
    return adjusted, covariance(adjusted, "object"), report


AICON_IOP = ("Ck", "Xh", "Yh", "A1", "A2", "B1", "B2")
OUR_IOP = ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1", "b2")
# Ck = -c: its correlations change sign.
SIGN = np.array([-1.0, 1, 1, 1, 1, 1, 1])
NUMBER = r"-?\d+\.\d+(?:e[+-]\d+)?"


def numbers(line):
    return [float(v) for v in re.findall(NUMBER, line)]


def test_aicon_summary_and_interior(aicon):
    adjusted, cov, report = aicon
    assert adjusted.redundancy == 18804
    assert int(re.search(r"Gesamtredundanz\s+: (\d+)", report)[1]) == 18804
    assert (sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())) == (19945, 1147)
    assert adjusted.n_constraints == 6
    s0 = float(adjusted.sigma0) * 0.0005
    assert abs(s0 - 0.0004056) < 0.5e-7
    sigmas = dict(zip(cov.labels[6 * cov.n_images :], np.asarray(cov.shared_sigma), strict=True))
    assert len(sigmas) == 7
    interior = adjusted.unknowns.interior["1"]
    for theirs, ours, sign in zip(AICON_IOP, OUR_IOP, SIGN, strict=True):
        value, sigma = numbers(re.search(rf"^{theirs} .*$", report, re.M)[0])[:2]
        # The report's values carry 7 digits, and stop iterating well within a hundredth of their sigmas.
        assert abs(sign * float(get_parameter(interior, ours)) - value) < 0.01 * sigma, ours
        assert abs(sigmas[f"interior[1].{ours}"] / sigma - 1) < 2e-3, ours


def test_aicon_interior_correlations(aicon):
    adjusted, cov, report = aicon
    ours = SIGN[:, None] * np.asarray(correlations(adjusted, cov)["1"].interior) * SIGN
    lines = report.split("Korrelation:\n", 1)[1].splitlines()[:7]
    for i, line in enumerate(lines):
        assert line.startswith(AICON_IOP[i])
        np.testing.assert_allclose(ours[i, : i + 1], numbers(line), atol=2e-3)


def aicon_images(report):
    """By image: sigma of x, y, z (mm), sigmas of the small rotations (rad), 6 x 7 correlations."""
    result = {}
    section = report.split("*** Äussere Orientierungen", 1)[1].split("*** Objektpunkte", 1)[0]
    for head in re.finditer(r"^ +(\d+) +1 +(-?\d+\.\d{4}.*)\n(.*rad.*)\n(.*)\n +Korrelationen:\n((?:.*\n){6})", section, re.M):
        rho = np.array([numbers(line) for line in head[5].splitlines()])
        result[head[1]] = numbers(head[2])[3:6], numbers(head[3])[3:6], numbers(head[4])[:3], rho
    return result


def test_aicon_exterior_interior_correlations_of_every_image(aicon):
    adjusted, cov, report = aicon
    printed = aicon_images(report)
    c = correlations(adjusted, cov)["1"]
    assert c.parameters == OUR_IOP
    assert c.eop_names == ("X", "Y", "Z", "rX", "rY", "rZ")
    assert set(printed) == set(c.images)
    assert len(c.images) == 115
    theirs = np.stack([printed[image][3] for image in c.images])
    assert theirs.shape == (115, 6, 7)
    np.testing.assert_allclose(np.asarray(c.exterior) * SIGN, theirs, atol=2e-3)


def test_aicon_exterior_sigmas(aicon):
    """Positions to 1e-4 mm, rotations to 1e-6 rad (one or two digits), as printed; sigma0 differs in its 4th digit."""
    adjusted, cov, report = aicon
    printed = aicon_images(report)
    order = [printed[image] for image in adjusted.block.images]
    sigma = np.asarray(cov.exterior_sigma)
    angles = np.asarray(covariance(adjusted).exterior_sigma)[:, 3:]
    np.testing.assert_allclose(1000 * sigma[:, :3], [p[0] for p in order], atol=0.6e-4)
    np.testing.assert_allclose(sigma[:, 3:], [p[2] for p in order], atol=0.6e-6)
    np.testing.assert_allclose(angles, [p[1] for p in order], atol=0.6e-6)


def test_aicon_object_points(aicon):
    """Standard deviations under inner constraints to 1e-4 mm."""
    adjusted, cov, report = aicon
    section = report.split("*** Objektpunkte", 1)[1].split("Maximale", 1)[0]
    rows = re.findall(rf"^ +(\d+) +((?:{NUMBER} +){{6}})(\d+) ", section, re.M)
    assert len(rows) == 150
    place = {name: k for k, name in enumerate(adjusted.block.points)}
    which = [place[name] for name, _, _ in rows]
    values = np.array([numbers(cells) for _, cells, _ in rows])
    np.testing.assert_allclose(1000 * np.asarray(cov.point_sigma)[which], values[:, 3:], atol=0.6e-4)
    np.testing.assert_allclose(1000 * np.asarray(adjusted.unknowns.points)[which], values[:, :3], atol=2e-4)


def test_aicon_redundancy_numbers_and_tests(aicon):
    """Every image point's residuals, redundancy numbers and |w|, as the report prints them."""
    adjusted, _, report = aicon
    redundancy = redundancy_numbers(adjusted, covariance(adjusted))
    w = normalised_residuals(adjusted, redundancy)
    section = report.split("*** Bildkoordinaten", 1)[1].split("Max Verbesserung", 1)[0]
    rows = re.findall(rf"^ +(\d+) +(\d+) +((?:{NUMBER} +){{10}}(?:\*+)?)", section, re.M)
    s = adjusted.structure
    place = {
        (adjusted.block.points[p], adjusted.block.images[i]): k
        for k, (p, i) in enumerate(zip(s.point, s.image, strict=True))
    }
    assert len(rows) == len(place) == 9972
    which = [place[point, image] for point, image, _ in rows]
    values = np.array([numbers(cells) for _, _, cells in rows])
    v = np.asarray(adjusted.residuals.image).T[which] * 0.0005
    np.testing.assert_allclose(v, values[:, 2:4] * np.sign(np.sum(v * values[:, 2:4])), atol=1.5e-6)
    np.testing.assert_allclose(np.asarray(redundancy.image).T[which], values[:, 6:8], atol=0.0051)
    np.testing.assert_allclose(np.abs(w.image).T[which], values[:, 8:10], atol=0.0151)
    total = sum(float(np.sum(r)) for r in redundancy)
    assert abs(total - 18804) < 1e-5
