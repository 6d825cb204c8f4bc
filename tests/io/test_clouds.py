"""Point clouds in LAS, LAZ and CSV: systems, units, filters, and refusals."""

import dataclasses
import warnings
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from jaxphoto import InputError
from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.io import clouds
from jaxphoto.io.clouds import EVERY_CLASS
from tests.checked_types import unchecked

LOCAL, GRID = Frame("local"), Frame("grid")
ORIGIN = (-51.0, -25.0, 100.0)
UTM = Frame("epsg", 32722, None, "true", ORIGIN)
FT, US_FT = 0.3048, 1200 / 3937


def sample(n=1000, seed=2, middle=(500_000.0, 7_234_000.0, 900.0)):
    """A cloud about `middle`, to the millimetre, so that every format holds it exactly."""
    rng = np.random.default_rng(seed)
    xyz = np.round(rng.uniform(-200, 200, (n, 3)), 3) + middle
    of = rng.integers(1, 4, n)
    return Cloud(
        xyz,
        classification=rng.choice([1, 2, 5, 6], n).astype(np.uint8),
        returns=np.stack([rng.integers(1, of + 1), of], axis=1).astype(np.uint8),
        time=rng.uniform(0, 1000, n),
        strip=rng.integers(0, 3, n),
        strips=("11", "12", "14"),
    )


def write_las(path, xyz, crs=None, scale=0.001, vlrs=(), **fields):
    """A LAS or LAZ file by laspy alone, coordinates as they are."""
    header = laspy.LasHeader(point_format=fields.pop("point_format", 6), version="1.4")
    header.scales, header.offsets = [scale] * 3, np.floor(xyz.mean(axis=0))
    if crs is not None:
        header.add_crs(CRS(crs))
    header.vlrs.extend(vlrs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    for name, values in fields.items():
        setattr(las, name, values)
    las.write(path)
    return path


def same(a, b, tolerance=1e-9):
    assert a.strips == b.strips
    np.testing.assert_allclose(a.xyz, b.xyz, rtol=0, atol=tolerance)
    for name in ("classification", "returns", "time", "strip"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Chunks that several of make up a file."""
    monkeypatch.setattr("jaxphoto.io.clouds._CHUNK", 300)


@pytest.mark.parametrize("name", ["c.las", "c.laz", "c.csv"])
def test_clouds_round_trip(tmp_path, name):
    cloud = sample()
    clouds.write_cloud(cloud, tmp_path / name)
    read = clouds.read_cloud(tmp_path / name, LOCAL)
    same(read, Cloud(read.xyz, cloud.classification, cloud.returns, cloud.time, read.strip, read.strips))
    np.testing.assert_allclose(read.xyz, cloud.xyz, rtol=0, atol=1e-9)
    assert [read.strips[k] for k in read.strip] == [cloud.strips[k] for k in cloud.strip]
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_missing_columns_are_none(tmp_path):
    bare = Cloud(sample(50).xyz)
    clouds.write_cloud(bare, tmp_path / "c.csv")
    read = clouds.read_cloud(tmp_path / "c.csv")
    assert (read.classification, read.returns, read.time, read.strip, read.strips) == (None, None, None, None, ())
    old = write_las(tmp_path / "old.las", bare.xyz, point_format=0)
    assert clouds.read_cloud(old).time is None


@pytest.mark.parametrize("returns", ["all", "first", "last", "only"])
@pytest.mark.parametrize("classes", [None, [2], [5, 6]])
def test_filters(tmp_path, returns, classes):
    cloud = sample()
    clouds.write_cloud(cloud, tmp_path / "c.laz")
    west_south, east_north = cloud.xyz[:, :2].min(axis=0) + 50, cloud.xyz[:, :2].max(axis=0) - 80
    read = clouds.read_cloud(
        tmp_path / "c.laz", classes=classes, returns=returns, within=np.array([west_south, east_north])
    )
    number, of = cloud.returns.T
    kept = ((cloud.xyz[:, :2] >= west_south) & (cloud.xyz[:, :2] <= east_north)).all(axis=1)
    kept &= np.isin(cloud.classification, classes or range(256))
    kept &= {"all": number > 0, "first": number == 1, "last": number == of, "only": of == 1}[returns]
    assert 0 < kept.sum() < len(cloud)
    np.testing.assert_allclose(read.xyz, cloud.xyz[kept], atol=1e-9)
    np.testing.assert_array_equal(read.time, cloud.time[kept])


def test_strips_without_points_are_left_out(tmp_path):
    cloud = sample()
    classification = np.where(cloud.strip == 1, 2, 1).astype(np.uint8)
    clouds.write_cloud(Cloud(cloud.xyz, classification, strip=cloud.strip, strips=cloud.strips), tmp_path / "c.las")
    read = clouds.read_cloud(tmp_path / "c.las", classes=[2])
    assert read.strips == ("12",) and not read.strip.any() and len(read) == (cloud.strip == 1).sum()


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_withheld_points_are_kept_in_written_files(tmp_path, kind):
    cloud = sample(500)
    withheld = np.arange(500) % 3 == 0
    kinds = np.where(np.arange(500) % 5 == 0, 7, 2)
    said = {"withheld": withheld, "intensity": np.arange(500), "classification": kinds, "gps_time": cloud.time}
    path, new = write_las(tmp_path / f"c.{kind}", cloud.xyz, **said), tmp_path / f"d.{kind}"
    read = clouds.read_cloud(path, classes=EVERY_CLASS)
    np.testing.assert_allclose(read.xyz, cloud.xyz[~withheld], atol=1e-9)
    assert read.withheld is None
    step = np.array([0.5, -0.25, 0.125])
    clouds.rewrite_cloud(path, new, lambda part: part.xyz + step)
    written = laspy.read(new)
    np.testing.assert_allclose(written.xyz, cloud.xyz + step, atol=1e-9)
    for name, values in said.items():
        np.testing.assert_array_equal(written[name], values)


def test_withheld_points_outside_the_system_stay(tmp_path):
    """Far from any map, without a time or of a strip that nobody knows: that is why a file withholds them."""
    xyz = sample(500).xyz
    xyz[3] = [9e8, 0.0, 0.0]
    withheld = np.arange(500) % 3 == 0
    path = write_las(tmp_path / "c.las", xyz, withheld=withheld, gps_time=np.where(withheld, np.nan, 1.0), scale=0.5)

    def moved(part):
        unknown = part.withheld & (part.xyz[:, 0] > 0)
        return np.where(unknown[:, None], np.nan, part.xyz + np.array([0.0, 0.0, 2.0]))

    before = laspy.read(path).xyz
    stay = clouds.rewrite_cloud(path, tmp_path / "d.las", moved, frame=UTM, epsg=32722)
    lifted = laspy.read(tmp_path / "d.las").xyz[:, 2] - before[:, 2]
    assert stay == (np.abs(lifted) < 0.5).sum() > 1 and lifted[3] == 0 and (lifted[~withheld] > 1).all()
    assert (lifted[withheld] > 1).any()


# Units and systems


@pytest.mark.parametrize(
    ("crs", "plane", "height"),
    [
        ("EPSG:32722", 1.0, 1.0),
        ("EPSG:2994", FT, FT),
        ("EPSG:2264", US_FT, US_FT),
        ("EPSG:6557+6360", FT, US_FT),
        ("EPSG:32610+6360", 1.0, US_FT),
        ("EPSG:2264+5703", US_FT, 1.0),
        (None, 1.0, 1.0),
    ],
)
def test_units_are_those_of_the_system(tmp_path, crs, plane, height):
    xyz = sample(100, middle=(600_000.0, 800_000.0, 400.0)).xyz
    path = write_las(tmp_path / "c.las", xyz, crs)
    np.testing.assert_allclose(clouds.read_cloud(path).xyz, xyz * [plane, plane, height], rtol=1e-15, atol=1e-9)


def geo_keys(**keys):
    """The record of GeoTIFF keys, as `k4099=9003`."""
    rows = [(1, 1, 0, len(keys)), *((int(name[1:]), 0, 1, value) for name, value in keys.items())]
    return laspy.VLR("LASF_Projection", 34735, "", np.array(rows, "<u2").tobytes())


def test_vertical_system_and_units_of_geotiff_keys(tmp_path):
    xyz = np.array([[500_000.0, 7_234_000.0, 900.0]])
    for keys, vertical, metres in (
        ({"k4096": 5703}, 5703, 1.0),
        ({"k4096": 6360}, 6360, US_FT),
        ({"k4099": 9001}, None, 1.0),
    ):
        path = write_las(tmp_path / "c.las", xyz, vlrs=[geo_keys(k3072=32722, **keys)], point_format=3)
        placement = clouds.cloud_placement(path, None)
        assert placement.vertical == vertical
        np.testing.assert_allclose(placement.factors, [1.0, 1.0, metres], rtol=1e-12)
        np.testing.assert_allclose(clouds.read_cloud(path).xyz, xyz * placement.factors, rtol=0, atol=1e-3)
    for keys in (
        {"k3072": 32722, "k4099": 9003},
        {"k3072": 32767, "k3076": 9003},
        {"k3072": 32722, "k4096": 5703, "k4099": 9002},
    ):
        path = write_las(tmp_path / "c.las", xyz, vlrs=[geo_keys(**keys)], point_format=3)
        with pytest.raises(InputError, match=r"c\.las states feet for"):
            clouds.read_cloud(path)


def topocentric(longitude, latitude, height, origin=ORIGIN):
    """Local east, north, up on GRS 80's WGS 84, by the textbook."""
    a, f = 6378137.0, 1 / 298.257223563
    square = f * (2 - f)

    def geocentric(lon, lat, h):
        lon, lat = np.deg2rad(lon), np.deg2rad(lat)
        n = a / np.sqrt(1 - square * np.sin(lat) ** 2)
        return np.stack(
            [
                (n + h) * np.cos(lat) * np.cos(lon),
                (n + h) * np.cos(lat) * np.sin(lon),
                (n * (1 - square) + h) * np.sin(lat),
            ]
        )

    away = (geocentric(longitude, latitude, height).T - geocentric(*origin)).T
    lon, lat = np.deg2rad(origin[:2])
    east = [-np.sin(lon), np.cos(lon), 0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return (np.array([east, north, up]) @ away).T


def test_into_the_frame_of_a_block(tmp_path):
    """The same places in UTM, in the neighbour zone and in degrees come to the same local points."""
    cloud = sample()
    utm = Transformer.from_crs(32722, 4326, always_xy=True)
    longitude, latitude = utm.transform(*cloud.xyz[:, :2].T)
    truth = topocentric(longitude, latitude, cloud.xyz[:, 2])
    path = write_las(tmp_path / "utm.laz", cloud.xyz, "EPSG:32722")
    read = clouds.read_cloud(path, UTM)
    np.testing.assert_allclose(read.xyz, truth, rtol=0, atol=1e-6)
    neighbour = np.stack([*Transformer.from_crs(32722, 32723, always_xy=True).transform(*cloud.xyz[:, :2].T)], axis=1)
    path = write_las(tmp_path / "other.laz", np.column_stack([neighbour, cloud.xyz[:, 2]]), "EPSG:32723", 1e-4)
    np.testing.assert_allclose(clouds.read_cloud(path, UTM).xyz, truth, rtol=0, atol=3e-4)
    degrees = np.column_stack([longitude, latitude, cloud.xyz[:, 2]])
    clouds.write_cloud(Cloud(degrees), tmp_path / "degrees.csv")
    np.testing.assert_allclose(
        clouds.read_cloud(tmp_path / "degrees.csv", UTM, epsg=4326).xyz, truth, rtol=0, atol=1e-6
    )
    # A grid is taken as it stands.
    np.testing.assert_allclose(clouds.read_cloud(tmp_path / "utm.laz", GRID).xyz, cloud.xyz, atol=1e-9)


def test_a_foot_system_comes_to_a_metric_block(tmp_path):
    frame = Frame("epsg", 2993, None, "true", (-123.0, 44.0, 0.0))
    metres = sample(middle=(194_000.0, 258_800.0, 130.0)).xyz
    path = write_las(tmp_path / "ft.laz", metres / FT, "EPSG:2994", 1e-4)
    np.testing.assert_allclose(clouds.read_cloud(path, frame).xyz, frame.map.local(metres), rtol=0, atol=1e-4)


def test_datums_without_a_known_way_are_warned_of(tmp_path):
    path = write_las(tmp_path / "c.las", sample(middle=(194_000.0, 258_800.0, 130.0)).xyz, "EPSG:2993")
    with pytest.warns(UserWarning, match="assumed identical"):
        clouds.read_cloud(path, Frame("epsg", 26910, None, "true", (-123.0, 44.0, 0.0)))


@pytest.mark.parametrize("name", ["c.laz", "c.csv"])
@pytest.mark.parametrize(
    ("frame", "said", "unit"), [(None, {}, 1.0), (None, {"epsg": 2994}, FT), (UTM, {"epsg": 32722}, 1.0)]
)
def test_rewritten_part_by_part_in_its_own_system_and_units(tmp_path, name, frame, said, unit):
    cloud = sample()
    # Blunders are moved, too, and stay where they are in the file.
    classification = np.where(np.arange(len(cloud)) % 7 == 0, 7, cloud.classification).astype(np.uint8)
    clouds.write_cloud(dataclasses.replace(cloud, classification=classification), tmp_path / name)
    step, met = np.array([0.5, -0.25, 0.125]), []

    def moved(part):
        met.append(len(part))
        return part.xyz + step

    new = tmp_path / f"new{name[1:]}"
    clouds.rewrite_cloud(tmp_path / name, new, moved, frame=frame, **said)
    assert sum(met) == len(cloud) and max(met) <= (1000 if name == "c.csv" else 300)
    before, after = (clouds.read_cloud(f, frame, classes=EVERY_CLASS, **said) for f in (tmp_path / name, new))
    np.testing.assert_allclose(after.xyz, before.xyz + step, atol=0.6e-3 * unit)
    same(after, dataclasses.replace(before, xyz=after.xyz))
    if frame is None:
        np.testing.assert_allclose(
            clouds.read_cloud(new, classes=EVERY_CLASS).xyz, cloud.xyz + step / unit, atol=0.6e-3
        )


def test_failed_writes_leave_nothing(tmp_path):
    clouds.write_cloud(sample(), tmp_path / "c.laz")

    def moved(part):
        if not (part.time == sample().time[:300]).all():
            raise InputError("no farther")
        return part.xyz

    source = tmp_path / "c.laz"
    for message, write in (
        ("no farther", lambda: clouds.rewrite_cloud(source, tmp_path / "d.laz", moved)),
        ("of one kind", lambda: clouds.rewrite_cloud(source, tmp_path / "d.csv", lambda part: part.xyz)),
        (r"\.laz", lambda: clouds.write_cloud(sample(10), tmp_path / "c.txt")),
    ):
        with pytest.raises(InputError, match=message):
            write()
    assert [p.name for p in tmp_path.iterdir()] == ["c.laz"]


def test_written_in_the_system_of_the_frame(tmp_path):
    truth = sample()
    local = Cloud(UTM.map.local(truth.xyz))
    for name in ("c.laz", "c.csv"):
        clouds.write_cloud(local, tmp_path / name, frame=UTM)
        read = clouds.read_cloud(tmp_path / name, epsg=None if name == "c.laz" else 32722)
        np.testing.assert_allclose(read.xyz, truth.xyz, rtol=0, atol=0.6e-3)
    assert laspy.read(tmp_path / "c.laz").header.parse_crs().to_epsg() == 32722


# Real data


def test_real_strip_in_international_feet(data_dir):
    path = data_dir / "lidar" / "autzen_trim.laz"
    las = laspy.read(path)
    read = clouds.read_cloud(path)
    assert len(read) == 110_000
    np.testing.assert_allclose(read.xyz, np.stack([las.x, las.y, las.z], axis=1) * FT, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(read.classification, las.classification)
    np.testing.assert_array_equal(read.time, las.gps_time)
    assert read.strips == ("7326",)
    assert len(clouds.read_cloud(path, classes=[2])) == 26_107
    frame = Frame("epsg", 26910, None, "true", (-123.07, 44.05, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        placed = clouds.read_cloud(path, frame)
    # Distances are those of the ground: the two projections' scales there differ by parts in ten thousand.
    a, b = np.random.default_rng(0).integers(0, len(read), (2, 500))
    ours, file = (np.linalg.norm(c.xyz[a] - c.xyz[b], axis=1) for c in (placed, read))
    assert np.abs(ours / file - 1)[file > 50].max() < 5e-4


def test_real_files_are_the_same_packed_or_not(data_dir):
    las, laz = (clouds.read_cloud(data_dir / "lidar" / f"simple.{kind}") for kind in ("las", "laz"))
    same(las, laz)
    assert len(las) == 1065 and len(las.strips) == 9


# What cannot be used


def complaint(path, frame=None, **options):
    with pytest.raises(InputError) as said:
        clouds.read_cloud(path, frame, **options)
    message = str(said.value)
    assert "\n" not in message and Path(path).name.split(".")[0] in message
    return message


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_files_that_are_cut_off(tmp_path, kind):
    clouds.write_cloud(sample(2000), tmp_path / f"c.{kind}")
    whole = (tmp_path / f"c.{kind}").read_bytes()
    cut = tmp_path / f"cut.{kind}"
    for length in [0, 3, 104, 300, *np.linspace(380, len(whole) - 1, 6).astype(int)]:
        cut.write_bytes(whole[:length])
        message = complaint(cut)
        assert not length or "cut off" in message or "no points" in message
    # The header promises more points.
    content = bytearray(whole)
    content[247:255] = (50_000).to_bytes(8, "little")
    cut.write_bytes(content)
    assert "cut off" in complaint(cut)


def test_invalid_files_are_refused(tmp_path):
    assert "file not found" in complaint(tmp_path / "none.las")
    (tmp_path / "c.xyz").write_text("1 2 3\n")
    assert ".laz" in complaint(tmp_path / "c.xyz")
    (tmp_path / "c.las").write_text("no cloud at all " * 50)
    complaint(tmp_path / "c.las")
    laspy.LasData(laspy.LasHeader(point_format=6, version="1.4")).write(tmp_path / "empty.las")
    assert "no points" in complaint(tmp_path / "empty.las")
    (tmp_path / "empty.csv").write_text("X_m,Y_m,Z_m\n")
    assert "no points" in complaint(tmp_path / "empty.csv")


def test_systems_that_do_not_fit(tmp_path):
    xyz = sample().xyz
    bare, utm = write_las(tmp_path / "bare.las", xyz), write_las(tmp_path / "utm.las", xyz, "EPSG:32722")
    degrees = write_las(tmp_path / "deg.las", xyz * 0 + [-51.0, -25.0, 900.0], "EPSG:4326", 1e-7)
    assert "--cloud-epsg" in complaint(bare, UTM)
    assert "frame is local" in complaint(utm, LOCAL)
    assert "degrees" in complaint(degrees)
    assert "degrees" in complaint(degrees, GRID)
    assert "99999 is unknown" in complaint(bare, UTM, epsg=99999)
    assert "not a map system" in complaint(bare, epsg=4978)
    assert "outside the area" in complaint(utm, UTM, epsg=4326)
    # EGM96 needs a geoid; where it is on this computer, it lifts the points by metres.
    egm = write_las(tmp_path / "egm.las", xyz, "EPSG:32722+5773")
    flat = clouds.read_cloud(egm, UTM, epsg=32722).xyz
    try:
        assert np.abs(clouds.read_cloud(egm, UTM).xyz[:, 2] - flat[:, 2]).min() > 1
    except InputError as error:
        assert "egm.las: the heights of EPSG:5773" in str(error) and "geoid" in str(error)


@pytest.mark.parametrize(("unit", "metres"), [('UNIT["foot",0.3048]', FT), ('UNIT["metre",1]', 1.0)])
def test_a_named_local_system_tells_its_unit(tmp_path, unit, metres):
    wkt = f'LOCAL_CS["site",LOCAL_DATUM["site",0],{unit},AXIS["X",EAST],AXIS["Y",NORTH]]'
    path = write_las(tmp_path / "site.las", sample().xyz, wkt)
    np.testing.assert_allclose(clouds.read_cloud(path, LOCAL).xyz, sample().xyz * metres, rtol=1e-15, atol=1e-9)


def test_a_system_that_proj_does_not_know(tmp_path):
    path = write_las(tmp_path / "c.las", sample().xyz, vlrs=[laspy.VLR("LASF_Projection", 2112, "", b"nonsense")])
    assert "unknown to PROJ; give it (--cloud-epsg)" in complaint(path)
    assert len(clouds.read_cloud(path, UTM, epsg=32722)) == 1000


def test_empty_selections_are_refused(tmp_path):
    cloud = sample()
    clouds.write_cloud(cloud, tmp_path / "c.laz")
    message = complaint(tmp_path / "c.laz", classes=[3, 9])
    assert "no points of these classes and returns;" in message
    (x0, y0, _), (x1, y1, _) = cloud.extent
    message = complaint(tmp_path / "c.laz", within=np.array([[0.0, 0.0], [1000.0, 2000.0]]))
    assert f"X {x0:.1f} to {x1:.1f}, Y {y0:.1f} to {y1:.1f} m" in message
    assert "X 0.0 to 1000.0, Y 0.0 to 2000.0 m" in message
    clouds.write_cloud(Cloud(cloud.xyz), tmp_path / "bare.csv")
    assert "no classification" in complaint(tmp_path / "bare.csv", classes=[2])
    assert "no return numbers" in complaint(tmp_path / "bare.csv", returns="last")
    with pytest.raises(InputError, match="unknown returns 'every'"), unchecked():
        clouds.read_cloud(tmp_path / "c.laz", returns="every")


# Tables


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1.0,two,3.0,2", "Y_m"),
        ("1.0,2.0,inf,2", "Z_m"),
        ("1.0,2.0", "classification is empty"),
        ("1.0,2.0,3.0,2,5", "5 cells"),
        ("1.0,2.0,3.0,300", "classification is 300"),
        ("1.0,2.0,3.0,2.5", "classification is 2.5"),
    ],
)
def test_faulty_rows_are_named(tmp_path, row, says):
    """After a comment and an empty line."""
    rows = ["X_m,Y_m,Z_m,classification", "# a comment", "", *["1.0,2.0,3.0,2"] * 400, row, "1.0,2.0,3.0,2"]
    (tmp_path / "c.csv").write_text("\n".join(rows))
    assert f"c.csv, row 404: {says}" in complaint(tmp_path / "c.csv")


def test_invalid_tables_are_refused(tmp_path):
    path = tmp_path / "c.csv"
    for text, says in (("", "is empty"), ("X_m,Y_m\n1,2\n", "Z_m is missing"), ("x y z\n1 2 3\n", "X_m is missing")):
        path.write_text(text)
        assert says in complaint(path)
    for rows in (0, 3000):
        path.write_bytes(b"X_m,Y_m,Z_m\n" + b"1,2,3\n" * rows + b"\xff\xfe,2,3\n")
        assert "X_m is 'ÿþ', not a number" in complaint(path)


# COPC


def test_copc_is_read_and_rewritten_as_laz(tmp_path):
    """A LAZ file that says it is COPC loses that record; other dimensions stay."""
    info = laspy.VLR("copc", 1, "COPC info", bytes(160))
    path = write_las(tmp_path / "c.copc.laz", sample().xyz, vlrs=[info], intensity=np.arange(1000))
    read = clouds.read_cloud(path)
    np.testing.assert_allclose(read.xyz, sample().xyz, atol=1e-9)
    clouds.rewrite_cloud(path, tmp_path / "d.laz", lambda part: part.xyz + np.array([0.0, 0.0, 1.5]))
    written = laspy.read(tmp_path / "d.laz")
    assert "copc" not in [record.user_id for record in written.header.vlrs]
    np.testing.assert_array_equal(written.intensity, np.arange(1000))
    np.testing.assert_allclose(written.xyz, sample().xyz + np.array([0.0, 0.0, 1.5]), atol=1e-9)
    for write in (
        lambda: clouds.write_cloud(read, tmp_path / "e.copc.laz"),
        lambda: clouds.rewrite_cloud(path, tmp_path / "e.copc.laz", lambda part: part.xyz),
    ):
        with pytest.raises(InputError, match=r"e\.copc\.laz: COPC is read only"):
            write()
