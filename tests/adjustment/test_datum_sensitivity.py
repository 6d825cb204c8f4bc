"""What the datum is judged by: rows as they are differenced, and directions as a dense matrix has them."""

import jax
import numpy as np
import pytest
from scipy.sparse import csr_array

from jaxphoto.adjustment.datum import _motions
from jaxphoto.adjustment.datum_sensitivity import SeenMotions, row_sensitivity
from jaxphoto.adjustment.model.block_values import values_of, with_start
from jaxphoto.adjustment.model.numbers import UnknownArrays, zero_increments
from jaxphoto.adjustment.model.row_functions import group_residuals
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.adjustment.solver.similarity import similarity
from jaxphoto.compiling import jit_quickly
from tests.blocks import VARIANTS, measured, simulated


@jit_quickly
def _residuals(values, structure, motion, shared, centre, size):
    """All rows with everything moved by `motion`, and shared unknowns by `shared`."""
    move = lambda x, r: similarity(motion, x, r, centre, size)  # noqa: E731
    position, rotation = jax.vmap(move, (1, 2), (1, 2))(values.position, values.rotation)
    points = jax.vmap(lambda x: similarity(motion, x, np.eye(3), centre, size)[0], 1, 1)(values.points)
    vector = jax.numpy.asarray(values.shared).at[structure.free].add(shared)
    there = with_start(values, UnknownArrays(position, rotation, vector, points))
    zero = zero_increments(structure)
    rows = zip(structure.observed, values.groups, strict=True)
    return [group_residuals(g, n, zero, zero, there, structure).ravel() for g, n in rows]


def test_rows_are_central_differences():
    block = measured(VARIANTS["everything"]()).block
    s = structure_of(block, block.priors)
    values = values_of(block, block.start.unknowns, block.priors, s)
    chosen = np.flatnonzero(s.free >= s.n_cameras)
    assert 0 < len(chosen) < s.n_shared
    found = row_sensitivity(values, s, _motions(values), chosen)
    centre = values.points.mean(1)
    size = np.sqrt(((values.points - centre[:, None]) ** 2).sum(0).mean())
    columns = []
    for k in range(7 + len(chosen)):
        step = 1e-6 * np.eye(7 + len(chosen))[k]
        moved = np.zeros(s.n_shared)
        moved[chosen] = step[7:]
        ahead = _residuals(values, s, step[:7], moved, centre, size)
        behind = _residuals(values, s, -step[:7], -moved, centre, size)
        columns.append([(np.asarray(a) - np.asarray(b)) / 2e-6 for a, b in zip(ahead, behind, strict=True)])
    for placed, rows in ((True, found.placed), (False, found.alone)):
        groups = [n for n, g in enumerate(s.observed) if bool(len(g.image) or len(g.point)) == placed]
        expected = np.array([np.concatenate([c[n] for n in groups]) for c in columns]).T
        rows = rows.toarray()
        assert rows.shape == expected.shape
        np.testing.assert_allclose(rows, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
        assert np.linalg.matrix_rank(rows) > 3


def dense_null(rows):
    """Motions that no row sees, of all columns together."""
    norm = np.sqrt((rows**2).sum(0))
    norm = np.where(norm > 0, norm, 1.0)
    _, s, vt = np.linalg.svd(rows / norm)
    null = (vt[int((s > 1e-9).sum()) :] / norm)[:, :7]
    _, s, basis = np.linalg.svd(null, full_matrices=False)
    return basis[s > 1e-9]


def dense_weak(rows, sigma):
    """Motions by the covariance matrix of them and of all unknowns, where nothing is open."""
    covariance = np.linalg.inv(rows.T @ rows)[:7, :7]
    squares, directions = np.linalg.eigh(np.linalg.inv(covariance))
    found = np.linalg.norm(directions[3:], axis=0) / np.sqrt(squares)
    return directions.T[found > sigma], found.max()


def chain(rng, free_end: bool):
    """Rows of twelve unknowns from knot to knot, the first of which has a prior but where it is to be free."""
    rows = np.zeros((12, 12))
    for k in range(11):
        rows[k, k : k + 2] = np.array([-0.9, 1.0]) * rng.uniform(5, 50)
    if not free_end:
        rows[11, 0] = 20.0
    return rows


def system(seed: int, seen: int, free_end: bool) -> tuple[SeenMotions, np.ndarray]:
    """Rows that see `seen` combinations of motions, each with a knot and one of two free shifts, one with a prior."""
    rng = np.random.default_rng(seed)
    combinations = np.linalg.qr(rng.standard_normal((7, 7)))[0][:seen]
    placed = np.zeros((60, 7 + 12 + 2))
    placed[:, :7] = 100 * rng.standard_normal((60, seen)) @ combinations
    placed[np.arange(60), 7 + rng.integers(0, 12, 60)] = rng.uniform(1, 30, 60)
    placed[np.arange(60), 19 + rng.integers(0, 2, 60)] = rng.uniform(1, 30, 60)
    alone = np.zeros((13, 21))
    alone[:12, 7:19] = chain(rng, free_end)
    alone[12, 20] = 3.0
    return SeenMotions(csr_array(placed), csr_array(alone)), np.concatenate([placed, alone])


@pytest.mark.parametrize("free_end", [False, True], ids=["prior", "free"])
@pytest.mark.parametrize("seen", [0, 3, 6, 7])
def test_null_motions_are_those_of_all_columns_together(seen, free_end):
    for seed in range(5):
        sensitivity, rows = system(seed, seen, free_end)
        found, expected = sensitivity.null_motions(), dense_null(rows)
        assert len(found) == 7 - seen
        np.testing.assert_allclose(found.T @ found, expected.T @ expected, atol=1e-8)


def test_a_motion_that_goes_along_with_unknowns_that_only_one_another_hold_is_open():
    """As far as knots from one to the next may move all alike; with a prior of the first they may not."""
    placed, alone = np.zeros((30, 7 + 4)), np.zeros((4, 7 + 4))
    rng = np.random.default_rng(2)
    placed[:, 1:7] = rng.standard_normal((30, 6))
    placed[:, 0], placed[np.arange(30), 7 + np.arange(30) % 4] = 1.0, -1.0
    for k in range(3):
        alone[k, 7 + k : 9 + k] = -1.0, 1.0
    (null,) = SeenMotions(csr_array(placed), csr_array(alone)).null_motions()
    np.testing.assert_allclose(np.abs(null), np.eye(7)[0], atol=1e-9)
    alone[3, 7] = 1e-3
    assert not len(SeenMotions(csr_array(placed), csr_array(alone)).null_motions())


@pytest.mark.parametrize("alike", [False, True], ids=["seen by none", "seen together alone"])
def test_unknowns_that_nothing_tells_leave_no_motion_open(alike):
    """As the rates of a camera, which image points see alone, or a lever arm beside the shift of all strips."""
    for seed in range(20):
        _, rows = system(seed, 7, False)
        more = rows[:, 20:] if alike else np.zeros((len(rows), 1))
        every = np.hstack([rows, more])
        sensitivity = SeenMotions(csr_array(every[:60]), csr_array(every[60:72]))
        assert not len(sensitivity.null_motions())


@pytest.mark.parametrize("free_end", [False, True], ids=["prior", "free"])
def test_weak_motions_are_those_of_the_covariance_matrix(free_end):
    for seed in range(5):
        sensitivity, rows = system(seed, 7, free_end)
        _, worst = dense_weak(rows, 1.0)
        for sigma in (0.5 * worst, 2 * worst):
            weak, found = sensitivity.weak_motions(sigma)
            expected, _ = dense_weak(rows, sigma)
            assert (len(weak) > 0) == (sigma < worst)
            np.testing.assert_allclose(found, worst, rtol=1e-6)
            np.testing.assert_allclose(weak.T @ weak, expected.T @ expected, atol=1e-6)


@pytest.mark.parametrize(("apart", "determined"), [(1.0, True), (1e-6, True), (1e-12, False)])
def test_rows_that_nearly_tell_unknowns_apart_do(apart, determined):
    """Squares of the second have lost what tells it; many rows are brought to a triangle in portions."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(101, 4))
    rows[:, 3] = rows[:, 0] + apart * rows[:, 3]
    seen = SeenMotions(csr_array((0, 11)), csr_array(np.pad(rows, [(0, 0), (7, 0)])))
    np.testing.assert_array_equal(seen.determined, np.arange(7, 11) if determined else [])


def test_rows_left_out_compile_nothing_new(caplog):
    """As a search for blunders leaves them out, a few at a time."""
    block = simulated("everything").block
    few = np.ones(len(block.stations), bool)
    few[[0, 7]] = False
    spoilt = block.with_observations(
        {"image_points": block.image_points.take(np.arange(len(block.image_points)) != 3)}
    ).with_observations({"stations": block.stations.take(few)})
    found = []
    for one in (block, spoilt):
        s = structure_of(one, one.priors)
        values = values_of(one, one.start.unknowns, one.priors, s)
        caplog.clear()
        with jax.log_compiles():
            found.append(row_sensitivity(values, s, _motions(values), np.flatnonzero(s.free >= s.n_cameras)))
    assert found[1].placed.shape[0] == found[0].placed.shape[0] - 2
    assert not [r for r in caplog.records if "_slopes" in r.getMessage()]
