"""Round trips of every declared class of observations, of jaxphoto and a user, and errors in their files."""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block
from jaxphoto.camera import StripCamera
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.io import read_block, write_block
from jaxphoto.observations import (
    OBSERVATIONS,
    AbstractObservations,
    CameraPositions,
    Correlated,
    Distances,
    KnownParameters,
    RelativeAttitudes,
    RelativePositions,
    RigPlaces,
    RigTurns,
    correlated,
    index_of,
)
from jaxphoto.observations.columns import columns_of, row_fields
from jaxphoto.rotation import small_rotation
from jaxphoto.unknowns import FIXED
from tests.io.test_write_block import assert_same
from tests.levelling import HeightDifferences


class Everything(AbstractObservations):
    """A field of each kind: stacks, whole numbers, vectors, angles, names of its own, and one that is in no file."""

    group = "everything"
    unit = "rad"
    axes = ("u", "v")
    columns = {"weather": "weather_code", "base": ("east_m", "up_m", "north_m"), "offset": ()}  # noqa: RUF012

    pair: Int[np.ndarray, "n 2"] = index_of("image")
    who: Int[np.ndarray, "n"] = index_of("strips")
    weather: Int[np.ndarray, "n"]
    value: Float[ArrayLike, "n 2"]
    base: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 2"]
    offset: Float[ArrayLike, "n"]

    def residual(self, pair, who) -> Float[Array, "2"]:
        """Nothing that means anything."""
        return self.value


OWN = (HeightDifferences, Everything)
TURN = np.pi / 180


def rows_of(kind: type[AbstractObservations], n: int, seed: int = 0) -> AbstractObservations:
    """Rows with numbers that a file may hold, as declared: each touches other images and points."""
    rng, fields = np.random.default_rng(seed), {}
    in_files = {column.field for column in columns_of(kind)}
    for name, touches, whole, shape in row_fields(kind):
        size = {"image": 3, "point": 4, "strips": 2, "trajectory_knots": 1}.get(
            touches, 3 if kind.group in ("stations", "control_points", "trajectory_stations") else 1
        )
        index = (np.arange(n)[:, None] + np.arange(int(np.prod(shape)))) % size
        number = np.abs(rng.normal(1.0, 0.3, (n, *shape))) + 1e-3
        fields[name] = index.reshape(n, *shape) if whole else number if name in in_files else 0 * number
    if kind in (RigPlaces, RigTurns):
        fields["image"] = (fields["reference"] + 1) % 3
    if kind in (RelativePositions, RelativeAttitudes):
        fields["image_2"] = (fields["image_1"] + 1) % 3
    if kind.group == "prior_rotations":
        fields["value"] = np.array(jax.vmap(small_rotation)(rng.normal(0, 0.3, (n, 3))))
    for name in {"weights", "weights_a", "weights_b"} & set(fields):
        fields[name] /= fields[name].sum(axis=1, keepdims=True)
    if "kept" in fields:
        fields["kept"] /= 10
    if "normal" in fields:
        fields["normal"] = np.tile([0.0, 0.6, 0.8], (n, 1))
    return kind(**fields)


def read(folder) -> Block:
    return read_block(folder, more=OWN)


def with_rows(block: Block, rows: AbstractObservations) -> Block:
    """In their own place where a block has one, so that they are written as it is."""
    place = {"control_points": "control"}.get(rows.group, rows.group)
    if place == "control":
        block = dataclasses.replace(block, fixed=rows.none(), check=rows.none())
    if place in {f.name for f in dataclasses.fields(Block)}:
        return dataclasses.replace(block, **{place: rows})
    return dataclasses.replace(block, more=(rows,))


def found(block: Block, kind: type[AbstractObservations]) -> AbstractObservations:
    place = {"control_points": "control"}.get(kind.group, kind.group)
    return getattr(block, place) if hasattr(block, place) else block.more[0]


def assert_rows(got: AbstractObservations, want: AbstractObservations) -> None:
    assert type(got) is type(want)
    for name, value in vars(want).items():
        degrees = any(c.field == name and c.scale != 1 for c in columns_of(type(want)))
        tolerance = {"rtol": 1e-15, "atol": 0} if degrees else {"rtol": 0, "atol": 0}
        np.testing.assert_allclose(getattr(got, name), value, **tolerance, err_msg=name)


@pytest.fixture
def block(write_folder: Callable) -> Block:
    """With a camera of each strip, which steps touch, and a knot of a trajectory."""
    block = read_block(write_folder())
    strips = [name for name in dict.fromkeys(block.image_strip) if name]
    more = lambda u, value, knot: dataclasses.replace(  # noqa: E731
        u,
        more={
            StripCamera.kind: {name: StripCamera(value, value, value) for name in strips},
            TrajectoryKnot.kind: {"1 at 0.000 s": TrajectoryKnot(knot, knot)},
        },
    )
    start = dataclasses.replace(block.start, unknowns=more(block.start.unknowns, 0.0, np.zeros(3)))
    return dataclasses.replace(block, start=start, priors=more(block.priors, FIXED, FIXED))


def many(kind: type[AbstractObservations]) -> int:
    """Rows such that none touches what another one does, where files allow one only."""
    return 2 if kind.group in ("distances", "attitudes") else 3


@pytest.mark.parametrize("kind", (*OBSERVATIONS, *OWN), ids=lambda kind: kind.group)
def test_rows_round_trip(block, tmp_path, kind):
    if kind.group == "image_points":
        pytest.skip("a block is made of these: test_write_block")
    rows = rows_of(kind, many(kind))
    write_block(with_rows(block, rows), tmp_path / "copy")
    assert_rows(found(read(tmp_path / "copy"), kind), rows)


@pytest.mark.parametrize("kind", (*OBSERVATIONS, *OWN), ids=lambda kind: kind.group)
def test_correlated_sets_round_trip(block, tmp_path, kind):
    rows, k = rows_of(kind, 6), len(kind.axes)
    rng = np.random.default_rng(1)

    def sets(index):
        n = k * len(index[0])
        half = rng.normal(size=(len(index), n, n))
        return correlated(rows, index, half @ np.swapaxes(half, 1, 2) + np.eye(n))

    groups = sets([[0, 2], [3, 1]]), sets([[4, 5, 0]])
    write_block(dataclasses.replace(block, more=groups), tmp_path / "copy")
    back = read(tmp_path / "copy").more
    assert len(back) == 2
    for got, want in zip(back, groups, strict=True):
        assert isinstance(got, Correlated)
        exact = 0.0 if kind.unit != "rad" else 1e-13
        np.testing.assert_allclose(got.covariance, want.covariance, rtol=exact)
        np.testing.assert_allclose(got.whitener, want.whitener, rtol=100 * exact, atol=100 * exact)
        np.testing.assert_allclose(got.observation, want.observation, rtol=1e-15)
        for (_, a), (_, b) in zip(got.indices(), want.indices(), strict=True):
            np.testing.assert_array_equal(a, b)
        assert (got.group, got.unit, got.axes) == (want.group, want.unit, want.axes)


def test_known_parameters_round_trip(block, tmp_path):
    known = (
        KnownParameters(
            ("interior[kodak].c_mm", "mounts[default].boresight_x_rad"), np.array([5.1, 0.1]), np.eye(2) / 3
        ),
        KnownParameters(("strips[one].shift_X_m",), np.array([0.3]), np.array([[0.1]]), "it was foggy, and late"),
    )
    write_block(dataclasses.replace(block, more=known), tmp_path / "copy")
    with pytest.warns(UserWarning, match="of the prior information on strips.one..shift_X_m: it was foggy, and late"):
        read = read_block(tmp_path / "copy")
    for got, want in zip(read.more, known, strict=True):
        assert isinstance(got, KnownParameters)
        assert (got.labels, got.reservation) == (want.labels, want.reservation)
        np.testing.assert_array_equal(got.value, want.value)
        np.testing.assert_array_equal(got.covariance, want.covariance)


numbers = st.floats(-1e9, 1e9, allow_subnormal=False)


@given(st.lists(st.tuples(st.permutations(range(4)), numbers, st.floats(1e-9, 1e9)), min_size=1, max_size=5))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_numbers_of_user_classes_round_trip(write_folder, tmp_path_factory, rows):
    folder = tmp_path_factory.mktemp("any")
    source = folder.parent / "source_of_declared"
    if not source.exists():
        write_folder().rename(source)
    who, value, sigma = zip(*rows, strict=True)
    start, end = np.array(who)[:, :2].T
    own = HeightDifferences(start, end, np.array(value), np.array(sigma))
    block = dataclasses.replace(read_block(source), more=(own,))
    write_block(block, folder / "copy")
    assert_same(read(folder / "copy"), dataclasses.replace(block, more=(jax.tree.map(np.asarray, own),)))


LEVELLED = ("height_differences.csv", "start,end,value_m,sigma_m\np1,p2,0.5,0.001\np3,p2,-0.25,\n")
SIGMA = ("block.toml", "station_m", "height_difference_m = 0.002\nstation_m")


def test_defaults_of_user_classes(write_folder):
    folder = write_folder(SIGMA)
    (folder / LEVELLED[0]).write_text(LEVELLED[1])
    (rows,) = read(folder).more
    np.testing.assert_array_equal(rows.start, [0, 2])
    np.testing.assert_array_equal(rows.end, [1, 1])
    np.testing.assert_array_equal(rows.value, [0.5, -0.25])
    np.testing.assert_array_equal(rows.sigma, [0.001, 0.002])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("p3,p2", "p3,p9", r"height_differences\.csv, row 3: point p9 is measured in no image; measure it or delete"),
        ("p3,p2", "p3,", r"row 3: the end is empty; give its id"),
        ("-0.25,", "x,", r"row 3: value_m is 'x', not a number"),
        ("-0.25,", ",", r"row 3: value_m is empty; give a number"),
        ("0.001", "0", r"row 2: sigma_m is 0; a standard deviation is positive"),
        ("start", "begin", r"row 1: the column start is missing"),
        ("", "", r"row 3: missing standard deviation; .* sigma_m, or add height_difference_m under \[sigmas\]"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*not used:UserWarning")
def test_mistakes_are_named(write_folder, old, new, words):
    folder = write_folder()
    (folder / LEVELLED[0]).write_text(LEVELLED[1].replace(old, new))
    with pytest.raises((InputError, BlockError), match=words):
        read(folder)


@pytest.mark.parametrize(
    ("column", "cell", "words"),
    [
        ("who", "three", r"everything\.csv, row 2: strips three is none of the strips of this block \(one, two\)"),
        ("weather_code", "1.5", "row 2: weather_code is 1.5, not a whole number"),
        ("value_u_deg", "400", "row 2: value_u_deg = 400 is more than a full rotation"),
        ("pair_2", "z", r"row 2: image z is not in images\.csv"),
    ],
)
def test_mistakes_in_further_kinds_of_fields_are_named(block, tmp_path, column, cell, words):
    write_block(dataclasses.replace(block, more=(rows_of(Everything, 1),)), tmp_path / "copy")
    path = tmp_path / "copy" / "everything.csv"
    header, row = (line.split(",") for line in path.read_text().splitlines())
    row[header.index(column)] = cell
    path.write_text(",".join(header) + "\n" + ",".join(row))
    with pytest.raises((InputError, BlockError), match=words):
        read(tmp_path / "copy")


def test_a_comma_in_an_id_is_no_decimal_comma(write_folder):
    folder = write_folder()
    for file in folder.glob("*.csv"):
        file.write_text(file.read_text().replace("p1", '"p,1"'))
    toml = folder / "block.toml"
    toml.write_text(toml.read_text().replace('"p1"', '"p,1"'))
    (folder / LEVELLED[0]).write_text("start;end;value_m;sigma_m\np,1;p2;0,5;0,001\n")
    (rows,) = read(folder).more
    assert (float(rows.value[0]), float(rows.sigma[0])) == (0.5, 0.001)


def test_tables_without_a_class_are_refused(block, tmp_path):
    write_block(dataclasses.replace(block, more=(rows_of(HeightDifferences, 2),)), tmp_path / "copy")
    with pytest.raises(InputError, match=r"observations: no class is known for height_differences\.csv; pass it"):
        read_block(tmp_path / "copy")
    write_block(block, tmp_path / "copy")
    assert not (tmp_path / "copy" / "height_differences.csv").exists()
    assert_same(read_block(tmp_path / "copy"), block)


def test_observations_that_files_cannot_hold_are_refused(block, tmp_path):
    second = rows_of(CameraPositions, 2)
    with pytest.raises(
        BlockError, match=r"Block\.more contains stations, but stations\.csv is reserved for Block\.stations"
    ):
        write_block(dataclasses.replace(block, more=(second,)), tmp_path / "copy")
    tilted = dataclasses.replace(rows_of(Everything, 1), offset=np.ones(1))
    with pytest.raises(BlockError, match="everything: offset has no file format and must be zero"):
        write_block(dataclasses.replace(block, more=(tilted,)), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_two_classes_of_one_name_are_refused(write_folder):
    class Stations(HeightDifferences):
        group = "stations"

    with pytest.raises(BlockError, match=r"stations\.csv is a table of another class; give Stations\.group another"):
        read_block(write_folder(), more=(Stations,))


def test_groups_of_one_class_share_a_table(block, tmp_path):
    first, second = rows_of(HeightDifferences, 2), rows_of(HeightDifferences, 3, seed=1)
    bar = Distances(np.array([[0, 3]]), np.array([2.0]), np.array([0.1]))
    write_block(dataclasses.replace(block, more=(first, bar, second)), tmp_path / "copy")
    got = read(tmp_path / "copy")
    assert_rows(got.more[0], HeightDifferences.joined(first, second))
    assert_rows(got.distances, Distances.joined(block.distances, bar))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("1,2,1,", "1,7,1,"), r"covariance\.csv, row 3: a and b count the numbers of set 1, 1 to 2; correct 7, 1"),
        (("1,2,2,", "2,2,2,"), r"covariance\.csv, row 4: set 2 is not in correlated_height_differences\.csv"),
        (("1,2,2,4.0", "1,1,2,0.5\n1,2,2,4.0"), r"row 4: the covariance of 1 and 2 of set 1 is given with two"),
        (("1,2,2,4.0", "1,2,2,0.5"), r"the covariance matrix of set 1 is not positive definite; give a variance"),
    ],
)
def test_mistakes_in_covariances_are_named(block, tmp_path, change, words):
    joint = correlated(rows_of(HeightDifferences, 2), [[0, 1]], np.array([[[2.0, 1.0], [1.0, 4.0]]]))
    write_block(dataclasses.replace(block, more=(joint,)), tmp_path / "copy")
    path = tmp_path / "copy" / "correlated_height_differences_covariance.csv"
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change))
    with pytest.raises((InputError, BlockError), match=words):
        read(tmp_path / "copy")


def test_incomplete_annotations_and_columns_are_refused():
    class Open(HeightDifferences):
        group = "open"
        extra: Float[ArrayLike, "n k"]

    class Short(HeightDifferences):
        group = "short"
        columns = {"value": ("a", "b")}  # noqa: RUF012

    with pytest.raises(TypeError, match=r"Open\.extra: shape 'n k' has no fixed number of components"):
        columns_of(Open)
    with pytest.raises(TypeError, match=r"Short\.columns: value has 1 numbers per row"):
        columns_of(Short)
