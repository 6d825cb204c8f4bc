"""Round trips of arbitrary numbers: camera formats, COLMAP, clouds, trajectories, exposures."""

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxphoto.camera import DISTORTIONS, PROJECTIONS, InteriorOrientation, Sensor, get_parameter, parameter_names
from jaxphoto.cloud import Cloud
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.extras.formats import CAMERA_FORMATS, colmap, export, write_camera_file
from jaxphoto.io import clouds
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.exposures import read_exposures
from jaxphoto.io.trajectory import FIELDS, Records, read_records, read_sbet, write_flight_csv, write_sbet
from tests.formulas import camera_from_object
from tests.io.test_exports import photographs

few = settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
SENSOR = Sensor(4500, 3000, 0.008)
NAMES = {"opencv": "a.yml", "colmap": "cameras.txt", "agisoft": "a.xml", "block": "a.toml"}  # fmt: skip


def close(found, wanted, **tolerance):
    np.testing.assert_allclose(found, wanted, **({"rtol": 1e-9, "atol": 1e-9} | tolerance))


# Cameras -----------------------------------------------------------------------------------------------------

lens = st.tuples(st.floats(5.0, 300.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
coefficients = st.lists(st.floats(-0.3, 0.3), min_size=16, max_size=16)
HELD = [
    (kind, f"{kind} {name}", model)
    for kind, known in CAMERA_FORMATS.items()
    for name, model in {"plane": known.plane, "fisheye": known.fisheye}.items()
    if model is not None
]


def same_camera(back, interior):
    assert type(back.distortion) is type(interior.distortion) and type(back.projection) is type(interior.projection)
    for name in parameter_names(interior):
        wanted = float(get_parameter(interior, name))
        assert float(get_parameter(back, name)) == pytest.approx(wanted, rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize(
    ("kind", "model"), [(kind, model) for kind, _, model in HELD], ids=[name for _, name, _ in HELD]
)
@few
@given(lens=lens, values=coefficients)
def test_a_camera_that_a_format_holds_round_trip(tmp_path, kind, model, lens, values):
    held = [name for name in model.distortion.coefficients if name not in model.lacks]
    distortion = model.distortion(**dict(zip(held, values, strict=False)))
    interior = InteriorOrientation(*lens, distortion, projection=model.projection)
    assert write_camera_file(tmp_path / NAMES[kind], SENSOR, interior, kind, name="7").max_px == 0
    back = read_camera_file(tmp_path / NAMES[kind], pixel_mm=SENSOR.pixel_mm)
    same_camera(back.interior, interior)
    assert back.sensor == SENSOR


@pytest.mark.parametrize("name", DISTORTIONS)
@few
@given(lens=lens, values=coefficients, length=st.floats(1.0, 20.0), projection=st.sampled_from([*PROJECTIONS.values()]))
def test_a_block_holds_every_camera(tmp_path, name, lens, values, length, projection):
    kind = DISTORTIONS[name]
    constants = dict.fromkeys((constant.removesuffix("_mm") for constant in kind.constants), length)
    distortion = kind(**dict(zip(kind.coefficients, values, strict=False)), **constants)
    interior = InteriorOrientation(*lens, distortion, projection=projection())
    write_camera_file(tmp_path / "a.toml", SENSOR, interior)
    back = read_camera_file(tmp_path / "a.toml").interior
    same_camera(back, interior)
    assert jax.tree.structure(back) == jax.tree.structure(jax.tree.map(np.asarray, interior))
    for constant in constants:
        assert float(getattr(back.distortion, constant)) == length


# COLMAP ------------------------------------------------------------------------------------------------------

metres = st.floats(-2000.0, 2000.0)
angle = st.floats(-3.1, 3.1)
poses = st.lists(st.tuples(metres, metres, metres, angle, st.floats(-1.5, 1.5), angle), min_size=4, max_size=4)


@pytest.mark.parametrize("format", ["colmap", "colmap-binary"])
@few
@given(poses=poses, seed=st.integers(0, 2**32 - 1))
def test_a_model_of_colmap_round_trip(tmp_path_factory, format, poses, seed):
    values, rng = np.array(poses), np.random.default_rng(seed)
    turn = np.stack([camera_from_object(*angles) for angles in values[:, 3:]])
    p = photographs("rational", "local")
    p = p._replace(
        files=tuple(name.replace(" ", "_") for name in p.files),
        exterior=ExteriorOrientation(values[:, :3], turn),
        xyz=rng.uniform(-5000, 5000, p.xyz.shape),
        column_row=rng.uniform(0, 4000, p.column_row.shape),
    )
    folder = tmp_path_factory.mktemp("model")
    export(p, folder, format)
    model = colmap.read(*colmap.find(folder))
    assert model.files == sorted(p.files)
    close(model.xyz, p.xyz)
    order = [p.files.index(name) for name in model.files]
    close(model.exterior.camera_from_object, turn[order])
    close(model.exterior.position, values[order, :3])
    for k, i in enumerate(order):
        np.testing.assert_array_equal(model.column_row[model.image == k], p.column_row[p.image == i])
        np.testing.assert_array_equal(model.point[model.image == k], p.point[p.image == i])
    camera = read_camera_file(folder, pixel_mm=p.cameras["one"].sensor.pixel_mm)
    same_camera(camera.interior, p.cameras["one"].interior)


# Clouds ------------------------------------------------------------------------------------------------------

# Half a unit of the last digit of LAS, and its rounding.
SCALES = {".las": 5.001e-4, ".laz": 5.001e-4, ".csv": 0.0}


@pytest.mark.parametrize("ending", SCALES)
@few
@given(seed=st.integers(0, 2**32 - 1), place=st.tuples(*[st.floats(-9e5, 9e6)] * 3), size=st.floats(0.1, 9e5))
def test_a_cloud_comes_back_within_its_scale(tmp_path, ending, seed, place, size):
    rng, n = np.random.default_rng(seed), 40
    number = rng.integers(1, 6, n)
    cloud = Cloud(
        np.array(place) + size * rng.uniform(-1, 1, (n, 3)),
        classification=rng.integers(0, 200, n).astype(np.uint8),
        returns=np.stack([number, number + rng.integers(0, 5, n)], axis=1).astype(np.uint8),
        time=rng.permutation(n) + rng.uniform(0, 0.5, n) + 1e8,
        strip=rng.permutation(np.arange(n) % 3).astype(np.int32),
        strips=("7", "2", "11"),
    )
    clouds.write_cloud(cloud, tmp_path / f"a{ending}")
    back = clouds.read_cloud(tmp_path / f"a{ending}", classes=clouds.EVERY_CLASS)
    # COPC has an order of its own; every point has its time.
    ours, theirs = np.argsort(cloud.time), np.argsort(back.time)
    close(back.xyz[theirs], cloud.xyz[ours], rtol=0 if SCALES[ending] else 1e-15, atol=SCALES[ending])
    for name in ("classification", "returns", "time"):
        np.testing.assert_array_equal(getattr(back, name)[theirs], getattr(cloud, name)[ours])
    assert np.array(back.strips)[back.strip][theirs].tolist() == np.array(cloud.strips)[cloud.strip][ours].tolist()


# Trajectories and exposures ----------------------------------------------------------------------------------

seeds = st.integers(0, 2**32 - 1)


def records(seed, geographic=True):
    """Twenty records, with standard deviations."""
    rng, n = np.random.default_rng(seed), 20
    sides = ((-180, -80, -400), (180, 80, 9000)) if geographic else ((-1e6, -1e6, -400), (9e6, 9e6, 9000))
    turns = rng.uniform([-90, -80, 0], [90, 80, 360], (n, 3))
    time = rng.uniform(0, 604_000) + np.cumsum(rng.uniform(0.004, 0.02, n))
    return Records("a.csv", time, rng.uniform(*sides, (n, 3)), geographic, turns, *rng.uniform(0.001, 1, (2, n, 3)))


@few
@given(seed=seeds, geographic=st.booleans())
def test_a_trajectory_as_csv_round_trip(tmp_path, seed, geographic):
    given_ = records(seed, geographic)
    write_flight_csv(given_, tmp_path / "a.csv")
    back = read_records(tmp_path / "a.csv")
    assert back.geographic == geographic
    for found, wanted in zip(back[1:], given_[1:], strict=True):
        np.testing.assert_array_equal(found, wanted)


@few
@given(seed=seeds, wander=st.floats(-3.0, 3.0))
def test_an_sbet_comes_back_as_records_and_as_exposures(tmp_path, seed, wander):
    wanted, rng = records(seed), np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (len(wanted.time), len(FIELDS)))
    values[:, 0] = wanted.time
    values[:, [2, 1]] = np.deg2rad(wanted.coordinates[:, :2])
    values[:, 3] = wanted.coordinates[:, 2]
    # True heading is platform heading minus wander angle.
    values[:, 7:10] = np.deg2rad(wanted.roll_pitch_yaw_deg) + np.array([0, 0, wander])
    values[:, 10] = wander
    path = tmp_path / "a.sbet"
    write_sbet(values, path)
    np.testing.assert_array_equal(read_sbet(path), values)
    back, exposures = read_records(path), read_exposures(path)
    close(back.coordinates, wanted.coordinates)
    apart = back.roll_pitch_yaw_deg - wanted.roll_pitch_yaw_deg
    close((apart + 180) % 360 - 180, 0)
    np.testing.assert_array_equal(back.time, wanted.time)
    np.testing.assert_array_equal(exposures.place, back.coordinates)
    np.testing.assert_array_equal(exposures.aircraft_deg, back.roll_pitch_yaw_deg)
