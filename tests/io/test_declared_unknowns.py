"""Round trips of every declared class of unknowns, of jaxphoto and a user, and errors in block.toml."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from jaxphoto.block import Block, Motion, Temperatures
from jaxphoto.camera import ImageMotion, RollingShutter
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.io.block_folder.parameters import keys_of, known_unknowns, static_fields
from jaxphoto.parameters import AbstractParameters, leaves_in_order
from jaxphoto.unknowns import FIXED, FREE, UNKNOWNS, Weighted, is_prior


class Refractivity(AbstractParameters):
    """Of the air, by hour: a field of each kind."""

    kind = "refractivity"
    owner = "hour"
    names = {  # noqa: RUF012
        "height": ("height_m",),
        "turn": ("turn_x_rad", "turn_y_rad"),
        "factor": ("factor",),
    }

    height: Float[Array, ""] | float
    turn: Float[Array, "2"]
    factor: Float[Array, "1"]
    model: str = eqx.field(static=True, default="edlen")


OWN = (Refractivity,)


def read(folder) -> Block:
    return read_block(folder, more=OWN)


@pytest.fixture
def block(write_folder: Callable) -> Block:
    # The time offset of a mount needs the motion of its images, and what changes with temperature that of each.
    motion, warm = Motion(np.ones((3, 3)), np.ones((3, 3))), Temperatures(np.array([20.0, 21.5, 19.0]), 20.5)
    hours = {"hour": ("8", "9", "")}
    return dataclasses.replace(read_block(write_folder()), partitions=hours, motion=motion, temperatures=warm)


def parameters_of(kind: type[AbstractParameters], prior=None, seed: int = 0):
    """Start values of a class, or priors: `prior` of each field, made of its start where it is callable."""
    rng, static = np.random.default_rng(seed), {"model": "ciddor"} if kind is Refractivity else {}
    many = (static_fields(kind)[kind.sized],) if kind.sized else None
    start = {key.field: rng.normal(1.5, size=many or key.shape) for key in keys_of(kind)}
    if prior is None:
        return kind(**start, **static)
    return kind(**{name: prior(value) if callable(prior) else prior for name, value in start.items()}, **static)


def with_unknowns(block: Block, kind: type[AbstractParameters], prior) -> Block:
    owners = [""] if kind.owner == "lidar" else list(dict.fromkeys(block.owners(kind.owner)))
    owners = [name for name in owners if name or kind.owner in ("block", "lidar")]
    starts = {name: parameters_of(kind, None, k) for k, name in enumerate(owners)}
    priors = {name: parameters_of(kind, prior, k) for k, name in enumerate(owners)}
    start, known = block.start.unknowns, block.priors
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start.with_tables(start.tables | {kind.kind: starts})),
        priors=known.with_tables(known.tables | {kind.kind: priors}),
    )


def covariance_of(value):
    n = np.size(value)
    half = np.random.default_rng(3).normal(size=(n, n))
    return Weighted(value + 0.5, covariance=(half @ half.T + np.eye(n)) / 7)


def weighted(value):
    return Weighted(value, np.full(np.shape(value), 0.3))


# What block.toml takes only together with the other.
PARTNERS = {RollingShutter: ImageMotion, ImageMotion: RollingShutter}


def in_files(block: Block, kind: type[AbstractParameters], prior) -> Block:
    """A block whose folder may hold these unknowns."""
    partner = PARTNERS.get(kind)
    return with_unknowns(with_unknowns(block, partner, FREE) if partner else block, kind, prior)


PRIORS = {
    "free": FREE,
    "fixed": FIXED,
    "weighted": weighted,
    "elsewhere": lambda value: Weighted(value + 1, 0.1 + 0 * value),
}


def assert_alike(got, want) -> None:
    """Parameters or priors, to rounding."""
    assert type(got) is type(want)
    for a, b in zip(*(jax.tree.leaves(x, is_leaf=is_prior) for x in (got, want)), strict=True):
        assert is_prior(a) == is_prior(b)
        if not isinstance(b, Weighted):
            assert (a is b) if is_prior(b) else True
            a, b = (a, b) if not is_prior(b) else (0, 0)
            np.testing.assert_allclose(a, b, rtol=1e-15)
            continue
        assert (a.covariance is None) == (b.covariance is None)
        np.testing.assert_allclose(a.value, b.value, rtol=1e-15)
        np.testing.assert_allclose(a.sigma, b.sigma, rtol=1e-15)
        if b.covariance is not None:
            np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-14)


GENERIC = tuple(kind for kind in (*UNKNOWNS, *OWN) if kind.kind not in ("scanner",))


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("kind", GENERIC, ids=lambda kind: kind.kind)
def test_unknowns_round_trip(block, tmp_path, kind, prior):
    made = in_files(block, kind, PRIORS[prior])
    write_block(made, tmp_path / "copy")
    got = read(tmp_path / "copy")
    assert got.partitions == made.partitions
    for table, want in (
        (got.start.unknowns.tables, made.start.unknowns.tables),
        (got.priors.tables, made.priors.tables),
    ):
        assert list(table[kind.kind]) == list(want[kind.kind])
        for name, parameters in want[kind.kind].items():
            assert_alike(table[kind.kind][name], parameters)


@pytest.mark.parametrize("kind", GENERIC, ids=lambda kind: kind.kind)
def test_covariances_of_vectors_round_trip(block, tmp_path, kind):
    made = in_files(block, kind, lambda value: covariance_of(value) if np.ndim(value) else FREE)
    write_block(made, tmp_path / "copy")
    for name, want in made.priors.tables[kind.kind].items():
        assert_alike(read(tmp_path / "copy").priors.tables[kind.kind][name], want)


def test_every_class_has_a_way_into_files():
    """Those of jaxphoto that [unknowns] does not hold are the three with sections of their own."""
    rest = {kind.kind for kind in UNKNOWNS} - {kind.kind for kind in known_unknowns(())}
    assert rest == {"scanner", "mounts", "strips"}


numbers = st.floats(-1e9, 1e9, allow_subnormal=False)


@given(height=numbers, factor=numbers, sigma=st.floats(1e-9, 1e9))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_numbers_round_trip_exactly(write_folder, tmp_path_factory, height, factor, sigma):
    folder = tmp_path_factory.mktemp("any")
    source = folder.parent / "source_of_unknowns"
    if not source.exists():
        write_folder().rename(source)
    block = dataclasses.replace(read_block(source), partitions={"hour": ("8", "8", "8")})
    made = with_unknowns(block, Refractivity, FREE)
    where = lambda b: b.start.unknowns.more["refractivity"]["8"]  # noqa: E731
    made = eqx.tree_at(where, made, Refractivity(height, np.zeros(2), np.array([factor]), "ciddor"))
    known = Refractivity(Weighted(height, sigma), FREE, FIXED, "ciddor")
    made = eqx.tree_at(lambda b: b.priors.more["refractivity"]["8"], made, known)
    write_block(made, folder / "copy")
    got = read(folder / "copy")
    assert [float(np.squeeze(v)) for v in leaves_in_order(where(got)) if np.size(v) == 1] == [height, factor]
    prior = got.priors.more["refractivity"]["8"]
    assert (float(prior.height.value), float(prior.height.sigma)) == (height, sigma)


HOURS = (
    ("images.csv", "image,camera,strip", "hour,image,camera,strip"),
    ("images.csv", "a,kodak", "8,a,kodak"),
    ("images.csv", "b,kodak", "9,b,kodak"),
    ("images.csv", "c,kodak", "9,c,kodak"),
)
TOP = ("block.toml", 'title = "small"', 'title = "small"\npartitions = ["hour"]')


def section(text: str):
    return "block.toml", "[datum]", f"{text}\n[datum]"


def test_unknowns_of_block_toml_are_read(write_folder):
    text = """[unknowns.flight_bias]
shift_m = [0.1, 0.2, 0.3]
shift = "free"
[unknowns.camera_rates.kodak]
c_rate = { sigma_mm_per_h = 1e-3 }
k1_rate_per_h = 1e-7
[unknowns.refractivity.default]
turn_deg = [0.0, 180.0]
[unknowns.refractivity.8]
height_m = 4.0
factor_start = [2.0]
factor = { sigma = 0.5, value = [3.0] }
model = "ciddor"
"""
    block = read(write_folder(*HOURS, TOP, section(text)))
    start, priors = block.start.unknowns.more, block.priors.more
    assert block.partitions == {"hour": ("8", "9", "9")}
    np.testing.assert_array_equal(start["flight_bias"][""].shift, [0.1, 0.2, 0.3])
    assert priors["flight_bias"][""].shift == FREE
    assert priors["flight_bias"][""].drift == FIXED
    assert float(priors["camera_rates"]["kodak"].c_rate.sigma) == 1e-3
    assert float(start["camera_rates"]["kodak"].k1_rate) == 1e-7
    assert list(start["refractivity"]) == ["8", "9"]
    assert float(start["refractivity"]["8"].height) == 4.0
    assert [start["refractivity"][hour].model for hour in "89"] == ["ciddor", "edlen"]
    np.testing.assert_allclose(start["refractivity"]["9"].turn, [0.0, np.pi])
    np.testing.assert_array_equal(priors["refractivity"]["8"].factor.value, [3.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([section("[unknowns.tides]")], r"\[unknowns\] tides: no class is known for these unknowns; pass it"),
        (
            [section("[unknowns.camera_rates.leica]")],
            r"\[unknowns\.camera_rates\] leica: unknown key; use default, kodak",
        ),
        ([section("[unknowns.flight_bias]\nshift_m = [1, 2]")], r"shift_m: \[1, 2\] has 2 entries; give 3"),
        (
            [section("[unknowns.flight_bias]\nshift = { covariance = [[1,2,0],[2,1,0],[0,0,1]] }")],
            r"shift: the covariance is not symmetric and positive definite",
        ),
        (
            [section('[unknowns.shutters.kodak]\nreadout_ms = 20000.0\nreadout = "free"')],
            r"\[unknowns\.shutters\.kodak\] readout_ms: 20000 ms is not a plausible readout time; give milliseconds",
        ),
        (
            [section("[unknowns.shutters.default]\nreadout_ms = 30.0\n[unknowns.motions.a]\n[unknowns.motions.c]")],
            r"shutters\.kodak\]: 1 photograph of this camera \(b\) have no motion; give velocity_m_per_s",
        ),
        (
            [section("[unknowns.motions.default]\nvelocity_m_per_s = [0.0, 10.0, 0.0]")],
            r"\[unknowns\.motions\]: motion during .* only; add \[unknowns\.shutters\.CAMERA\]",
        ),
        (
            [section("[unknowns.refractivity.default]")],
            r"\[unknowns\.refractivity\]: images have no partition hour; add the column hour",
        ),
        ([TOP], r"images\.csv, row 1: the column hour is missing"),
        ([("block.toml", 'title = "small"', 'partitions = ["strip"]')], r"partitions: strip is reserved"),
        (
            [*HOURS[:3], ("images.csv", "c,kodak", "default,c,kodak"), TOP],
            r"images\.csv, row 4: the hour default means every hour in \[unknowns\]",
        ),
    ],
)
def test_mistakes_are_named(write_folder, changes, words):
    with pytest.raises((InputError, BlockError), match=words):
        read(write_folder(*changes))


def test_two_classes_of_one_name_are_refused(write_folder):
    class Strips(Refractivity):
        kind = "strips"

    with pytest.raises(BlockError, match=r"\[unknowns\.strips\] is of another class; give Strips\.kind another name"):
        read_block(write_folder(), more=(Strips,))


def test_fields_that_files_cannot_hold_are_refused(write_folder):
    class Mixed(AbstractParameters):
        kind = "mixed"
        owner = "block"
        names = {"both": ("shift_m", "turn_rad")}  # noqa: RUF012

        both: Float[Array, "2"]

    with pytest.raises(
        TypeError, match=r"Mixed\.both is not a number or vector of one unit; split it into several fields"
    ):
        keys_of(Mixed)
