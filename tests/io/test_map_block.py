"""Blocks in an EPSG system: read into a local frame and written back."""

import dataclasses

import jax
import numpy as np
import pandas as pd
import pytest

import jaxphoto
from jaxphoto.block import Frame
from jaxphoto.errors import BlockError, InputError, RowError
from jaxphoto.georeferencing import Corrections
from jaxphoto.io import read_block, write_block
from jaxphoto.observations import CameraPositions, PointRows, correlated
from jaxphoto.report import Tables, Verdict, write_results
from jaxphoto.rotation import matrix_from_omega_phi_kappa, matrix_from_roll_pitch_yaw
from tests.blocks import adjusted, simulated

EPSG = 'kind = "epsg"\ncode = 32722\nvertical = "ellipsoidal"'
FRAME = ("block.toml", 'kind = "local"', EPSG)
E, N = 580_000.0, 7_220_000.0
SHIFTED = ("images.csv", "control_points.csv", "stations.csv", "object_points.csv")


def to_utm(folder, frame=EPSG, names=("X_m", "Y_m", "Z_m"), of=lambda x, y, z: (x + E, y + N, z)):
    """The small block moved to Parana, its numbers taken for eastings and northings or what `of` makes of them."""
    toml = folder / "block.toml"
    toml.write_text(toml.read_text().replace('kind = "local"', frame))
    for file in SHIFTED:
        table = pd.read_csv(folder / file, dtype={"image": str, "point": str})
        new = of(*(table[c] for c in ("X_m", "Y_m", "Z_m")))
        table = table.assign(**dict(zip(("X_m", "Y_m", "Z_m"), new, strict=True)))
        table.rename(columns=dict(zip(("X_m", "Y_m", "Z_m"), names, strict=True))).to_csv(folder / file, index=False)
    return folder


def frame_of(block):
    return block.frame.map


def test_coordinates_come_into_the_local_frame(write_folder):
    block = read_block(to_utm(write_folder()))
    longitude, latitude, height = block.frame.origin
    assert (round(longitude, 4), round(latitude, 4), height) == (longitude, latitude, 0.0)
    assert abs(longitude + 50.2065) < 1e-3 and abs(latitude + 25.1334) < 1e-3
    assert block.frame == Frame("epsg", 32722, None, "true", block.frame.origin)
    utm = np.array([[1, 2, 3], [2.5, 2.5, 4], [5, 6, 7]]) + np.array([E, N, 0])
    np.testing.assert_allclose(block.start.unknowns.points[:3], frame_of(block).local(utm), rtol=0, atol=1e-6)
    stations = np.asarray(block.stations.value).reshape(-1, 3)
    expected = frame_of(block).local(np.array([[E, N, 100], [10 + E, N, 100]]))
    np.testing.assert_allclose(stations, expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(block.stations.sigma, [0.05, 0.05, 0.1, 0.1, 0.1, 0.1])
    # p2 is height control: only Z is observed, completed by object_points.csv for the way.
    np.testing.assert_array_equal(block.control.axis, [0, 1, 2, 2])
    np.testing.assert_allclose(block.control.value[3], block.start.unknowns.points[1, 2], rtol=0, atol=1e-9)


def test_heights_are_ellipsoidal_by_default_with_a_warning(write_folder, tmp_path):
    told = read_block(to_utm(write_folder()))
    (tmp_path / "block").rename(tmp_path / "first")
    silent = to_utm(write_folder(), EPSG.replace('\nvertical = "ellipsoidal"', ""))
    with pytest.warns(UserWarning, match=r"block\.toml, \[frame\]: heights are assumed ellipsoidal.*5773"):
        assumed = read_block(silent)
    assert assumed.frame == told.frame
    np.testing.assert_array_equal(assumed.control.value, told.control.value)


@pytest.mark.parametrize("yaw", ["true", "grid"])
def test_angles_come_into_the_axes_of_the_local_frame(write_folder, yaw):
    block = read_block(to_utm(write_folder(), f'{EPSG}\nyaw = "{yaw}"\norigin = [-50.0, -25.0, 0.0]'))
    system, position = frame_of(block), np.asarray(block.start.unknowns.exterior.position)[:1]
    camera = np.asarray(matrix_from_omega_phi_kappa(np.deg2rad([0.5, -0.25, 90.0])))
    np.testing.assert_allclose(
        block.start.unknowns.exterior.camera_from_object[0],
        camera @ system.local_from_grid(position)[0].T, rtol=0, atol=1e-12,
    )  # fmt: skip
    body = np.asarray(matrix_from_roll_pitch_yaw(np.deg2rad([1.0, -2.0, 45.0])))
    axes = system.local_from_level(position) if yaw == "true" else system.local_from_grid(position)
    got = matrix_from_roll_pitch_yaw(block.attitudes.roll_pitch_yaw[0])
    np.testing.assert_allclose(got, axes[0] @ body, rtol=0, atol=1e-12)
    # 20 km west of the origin the vertical is tilted, and grid north is .34 degrees west of true north.
    assert np.abs(np.rad2deg(block.attitudes.roll_pitch_yaw[0]) - [1, -2, 45]).max() > (0.05 if yaw == "true" else 0.3)


def assert_near(got, want):
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        if isinstance(b, np.ndarray | jax.Array):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-7)
        else:
            assert a == b


DEGREES = ("longitude_deg", "latitude_deg", "height_m")


def degrees(x, y, z):
    return x * 1e-5 - 50.2, y * 1e-5 - 25.1, z


@pytest.mark.parametrize(
    "frame, more",
    [
        (EPSG, {}),
        (EPSG + '\nyaw = "grid"\norigin = [-50.0, -25.0, 700.0]', {}),
        (EPSG.replace("32722", "4674"), {"names": DEGREES, "of": degrees}),
        (EPSG + "\n[corrections]\nrefraction = true", {}),
    ],
)
def test_round_trip(write_folder, tmp_path, frame, more):
    block = read_block(to_utm(write_folder(), frame, **more))
    write_block(block, tmp_path / "copy")
    assert_near(read_block(tmp_path / "copy"), block)
    written = pd.read_csv(tmp_path / "copy" / "stations.csv")
    of = more.get("of", lambda x, y, z: (x + E, y + N, z))
    names = more.get("names", ["X_m", "Y_m", "Z_m"])
    np.testing.assert_allclose(written[list(names)], np.array([of(0, 0, 100), of(10, 0, 100)]), rtol=0, atol=1e-6)


def test_velocities_turn_with_the_grid(write_folder, tmp_path):
    folder = to_utm(write_folder(), EPSG + "\norigin = [-51.0, -25.0, 0.0]")
    table = pd.read_csv(folder / "stations.csv").assign(vX_m_per_s=0.0, vY_m_per_s=60.0, vZ_m_per_s=0.0)
    table.to_csv(folder / "stations.csv", index=False)
    block = read_block(folder)
    expected = frame_of(block).local_from_grid(np.asarray(block.start.unknowns.exterior.position)[:2])[:, :, 1] * 60
    np.testing.assert_allclose(block.motion.velocity[:2], expected, rtol=0, atol=1e-9)
    write_block(block, tmp_path / "copy")
    assert_near(read_block(tmp_path / "copy"), block)


def test_control_may_be_completed_by_another_row(write_folder, tmp_path):
    """Height control whose plane coordinates are check coordinates, and no approximation."""
    rows = ("control_points.csv", "p2,,,4.0,,,,control", "p2,,,4.0,,,,control\np2,2.0,3.0,,,,,check")
    block = read_block(to_utm(write_folder(rows, ("object_points.csv", "p2,2.5,2.5,4.5\n", ""))))
    expected = frame_of(block).local(np.array([[2 + E, 3 + N, 4.0]]))[0]
    np.testing.assert_allclose(block.control.value[3], expected[2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(block.check.value[np.asarray(block.check.who) == 1], expected[:2], rtol=0, atol=1e-7)
    write_block(block, tmp_path / "copy")
    assert_near(read_block(tmp_path / "copy"), block)


REFUSED = {
    "code": ([("32722", "99999")], ["block.toml, [frame] code", "99999 is unknown", "correct"]),
    "no code": ([("code = 32722\n", "")], ["[frame] code", "missing", "add it"]),
    "feet": ([("32722", "2227")], ["[frame] code", "US survey foot", "convert"]),
    "unknown vertical": ([('"ellipsoidal"', "99999")], ["block.toml, [frame] vertical", "99999 is unknown"]),
    "no heights": ([('"ellipsoidal"', "4326")], ["block.toml, [frame] vertical", "not a vertical CRS"]),
    "vertical": ([('"ellipsoidal"', '"geoid"')], ["[frame] vertical", "geoid", "give one"]),
    "yaw": ([(EPSG, EPSG + '\nyaw = "map"')], ["[frame] yaw", "'map'", '"grid"']),
    "grid of degrees": ([("32722", "4326"), (EPSG[-13:], EPSG[-13:] + '\nyaw = "grid"')], ["no grid", '"true"']),
    "origin": ([(EPSG, EPSG + "\norigin = [580000, 7220000, 0]")], ["[frame] origin", "degrees"]),
    "far origin": ([(EPSG, EPSG + "\norigin = [10, 52, 0]")], ["[frame] origin", "km from the block", "(-50.2"]),
    "area": ([("32722", "2056")], ["images.csv: the coord", "(580005.0, 7220000.0)", "area of EPSG:2056"]),
    "curvature": ([("[sigmas]", "[corrections]\ncurvature = true\n[sigmas]")], ["curvature", "Cartesian", "remove"]),
    "sea": ([("[sigmas]", "[corrections]\nrefraction = true\nsea_level_m = 1\n[sigmas]")], ["sea_level_m", "remove"]),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_bad_frames_are_refused(write_folder, name):
    changes, words = REFUSED[name]
    folder = to_utm(write_folder())
    text = (folder / "block.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "block.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_block(folder)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.parametrize("origin", ["", "\norigin = [-50.0, -25.0, 0.0]"])
def test_one_table_outside_the_area_is_named(write_folder, origin):
    folder = to_utm(write_folder(), EPSG + origin)
    table = pd.read_csv(folder / "stations.csv")
    table.assign(X_m=table["Y_m"], Y_m=table["X_m"]).to_csv(folder / "stations.csv", index=False)
    with pytest.raises(InputError, match=r"^stations.csv: the coordinates.* outside the area of EPSG:32722"):
        read_block(folder)


@pytest.mark.parametrize("place", [(0.0, 0.0), (E - 600_000.0, N)], ids=["placeholder", "zone"])
def test_a_row_far_from_the_block_is_named(write_folder, place):
    """Zeros of a receiver without a position, and coordinates in the zone beside."""
    folder = to_utm(write_folder())
    table = pd.read_csv(folder / "control_points.csv", dtype={"point": str})
    table.loc[2, ["X_m", "Y_m"]] = place
    table.to_csv(folder / "control_points.csv", index=False)
    with pytest.raises(RowError, match=r"^control_points.csv, row 4: ") as caught:
        read_block(folder)
    assert caught.value.rows == {4}


def test_incomplete_coordinates_are_refused(write_folder):
    folder = to_utm(write_folder(("object_points.csv", "p2,2.5,2.5,4.5\n", "")))
    with pytest.raises(InputError, match=r"control_points\.csv, row 3: .*EPSG:32722 needs X_m .* object_points\.csv"):
        read_block(folder)


def test_attitudes_need_a_position(write_folder):
    station = ("stations.csv", "b,10.0,0.0,100.0,,,\n", "")
    folder = to_utm(write_folder(station, ("images.csv", "10.0,0.0,100.0,0.0,0.0,0.0", ",,,,,")))
    with pytest.raises(InputError, match=r"attitudes\.csv, row 3: .*stations\.csv nor images\.csv gives; add it"):
        read_block(folder)


def test_frames_without_a_place(write_folder):
    changes = [
        (file, "", None) for file in ("control_points.csv", "stations.csv", "attitudes.csv", "object_points.csv")
    ]
    images = ("images.csv", "", "image,camera,strip,time_s\na,kodak,one,10\nb,kodak,one,12\nc,kodak,two,20\n")
    distances = ("distances.csv", "", None)
    with pytest.raises(InputError, match=r"block\.toml, \[frame\]: the block has no coordinates .* add origin"):
        read_block(write_folder(*changes, images, distances, FRAME))


def test_grid_coordinates_are_kept_with_a_warning(write_folder, tmp_path):
    folder = write_folder(("block.toml", 'kind = "local"', 'kind = "grid"\n[corrections]\ncurvature = true'))
    with pytest.warns(UserWarning, match="not Cartesian"):
        block = read_block(folder)
    assert (block.frame, block.corrections) == (Frame("grid"), Corrections(curvature=True))
    with pytest.warns(UserWarning, match="not Cartesian"):
        write_block(block, tmp_path / "copy")
        assert_near(read_block(tmp_path / "copy"), block)


def corrected(write_folder, frame, text):
    return read_block(write_folder(("block.toml", 'kind = "local"', f'kind = "{frame}"\n[corrections]\n{text}')))


def test_corrections(write_folder, tmp_path):
    block = corrected(write_folder, "enu", "refraction = true\nsea_level_m = -12.5")
    assert block.corrections == Corrections(True, False, -12.5)
    write_block(block, tmp_path / "copy")
    assert_near(read_block(tmp_path / "copy"), block)


def test_an_epsg_frame_knows_its_sea_level(write_folder):
    text = EPSG + "\norigin = [-50.2, -25.1, 900.0]\n[corrections]\nrefraction = true"
    corrections = read_block(to_utm(write_folder(), text)).corrections
    np.testing.assert_allclose(corrections.sea_level_m, -900.0, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "frame, text, words",
    [
        ("local", "refraction = true", ["sea_level_m", '"local"', "give"]),
        ("local", "curvature = true", ["curvature", "Cartesian", "remove"]),
        ("local", "sea_level_m = 1.0", ["sea_level_m", "only refraction", "remove"]),
        ("local", "refraction = 1", ["refraction", "neither true nor false"]),
        ("local", "tides = true", ["tides", "refraction, curvature"]),
    ],
)
def test_corrections_that_are_wrong_in_the_frame_are_refused(write_folder, frame, text, words):
    with pytest.raises(InputError) as caught:
        corrected(write_folder, frame, text)
    for word in ("block.toml, [corrections]", *words):
        assert word in str(caught.value), str(caught.value)


def test_a_block_that_cannot_go_back_is_not_written(write_folder, tmp_path):
    block = read_block(to_utm(write_folder()))
    lost = dataclasses.replace(block, start=dataclasses.replace(block.start, point_known=np.zeros(4, bool)))
    with pytest.raises(BlockError, match=r"control_points\.csv, entry 2: .* needs X_m"):
        write_block(lost, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_an_adjustment_does_not_depend_on_the_system_of_the_files(tmp_path):
    """Simulated in a local frame, written as UTM, read and adjusted; the results go back into UTM."""
    block = simulated("cross").block
    frame = Frame("epsg", 32722, None, "grid", (-50.2, -25.1, 0.0))
    write_block(dataclasses.replace(block, frame=frame), tmp_path / "utm")
    in_utm = jaxphoto.adjust(read_block(tmp_path / "utm"))
    expected = adjusted("cross").unknowns
    np.testing.assert_allclose(in_utm.unknowns.exterior.position, expected.exterior.position, rtol=0, atol=1e-5)
    np.testing.assert_allclose(in_utm.unknowns.points, expected.points, rtol=0, atol=1e-5)

    write_results(Tables(in_utm), Verdict(()), tmp_path / "results", {})
    exterior = pd.read_csv(tmp_path / "results" / "exterior_map.csv")
    assert list(exterior) == ["image", "E_m", "N_m", "H_m", "omega_deg", "phi_deg", "kappa_deg"]
    start = pd.read_csv(tmp_path / "utm" / "images.csv")
    # The starts of this block are a few metres and 0.2 degrees off, local and grid axes differ by 0.34 degrees.
    assert np.abs(exterior[["E_m", "N_m", "H_m"]].to_numpy() - start[["X_m", "Y_m", "Z_m"]].to_numpy()).max() < 10
    local = np.asarray(in_utm.unknowns.exterior.position)
    np.testing.assert_allclose(exterior[["E_m", "N_m", "H_m"]], frame.map.map(local), rtol=0, atol=1e-6)
    got = jax.jit(jax.vmap(matrix_from_omega_phi_kappa))(
        np.deg2rad(exterior[["omega_deg", "phi_deg", "kappa_deg"]].to_numpy())
    )
    camera = np.asarray(in_utm.unknowns.exterior.camera_from_object) @ frame.map.local_from_grid(local)
    np.testing.assert_allclose(got, camera, rtol=0, atol=1e-12)
    points = pd.read_csv(tmp_path / "results" / "object_points_map.csv")
    assert list(points) == ["point", "E_m", "N_m", "H_m"]
    np.testing.assert_allclose(
        points[["E_m", "N_m", "H_m"]], frame.map.map(np.asarray(in_utm.unknowns.points)), rtol=0, atol=1e-6
    )


def test_vectors_and_lengths_are_not_converted(write_folder, tmp_path):
    block = read_block(to_utm(write_folder()))
    near = PointRows(np.array([1]), np.array([[1.0, 2.0, 3.0]]), np.full((1, 3), 0.1))
    axes = CameraPositions(np.array([0, 0, 0]), np.arange(3), np.array([4.0, 5.0, 6.0]), np.ones(3))
    block = dataclasses.replace(block, more=(near, correlated(axes, [[0, 1, 2]], 0.5 * np.eye(3)[None])))
    write_block(block, tmp_path / "copy")
    again = read_block(tmp_path / "copy")
    np.testing.assert_array_equal(again.distances.value, [1.5, 2.5])
    np.testing.assert_array_equal(again.more[0].value, near.value)
    np.testing.assert_array_equal(again.more[1].rows.value, [[4.0, 5.0, 6.0]])
