"""Studies in parts on a local cluster: the same results, also if workers die, and clear errors."""

import os
import signal

import numpy as np
import pytest

from jaxphoto import InputError, adjust, bias, monte_carlo
from jaxphoto.sensitivity import Readjustment
from jaxphoto.sensitivity.monte_carlo import DrawnChange
from jaxphoto.workers import connected, in_parts
from tests.blocks import example

pytest.importorskip("distributed", reason="distributed is not installed (extra cluster)")


class Squares:
    """The squares of arrays."""

    def compute(self, part):
        return part**2


class Failing(Squares):
    """A study whose second part cannot be computed."""

    def compute(self, part):
        if part[0] == 1:
            raise OSError("no such table")
        return part


class Kept(Squares):
    """A study that counts the parts that an instance computes."""

    def __init__(self):
        self.parts = 0

    def compute(self, part):
        self.parts += 1
        return self.parts


@pytest.fixture(scope="module")
def client():
    with connected(2, None) as connection:
        yield connection


def test_draws_of_workers_are_those_of_this_process(client):
    adjusted = adjust(example())
    errors = bias(example(), "station", 0.1, per="image")
    found = monte_carlo(adjusted, errors, 300, seed=3, exterior=True, client=client)
    change = DrawnChange(errors, 3)
    here = Readjustment(adjusted, change, np.arange(300), exterior=True)
    own = here.compute(np.arange(300))
    assert found.converged.all()
    for name in ("shared", "exterior", "steps"):
        np.testing.assert_array_equal(getattr(found, name), getattr(own, name))
    np.testing.assert_array_equal(list(found.recorded.values()), list(own.recorded.values()))


def test_every_part_is_computed_once_although_workers_die(client):
    parts = [(k, np.full(3, float(k))) for k in range(60)]
    found: dict[int, np.ndarray] = {}
    for number, result in in_parts(Squares(), parts, client):
        assert number not in found
        found[number] = result
        if len(found) in (5, 30):
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
    here = dict(in_parts(Squares(), parts))
    assert found.keys() == here.keys()
    for number, result in here.items():
        np.testing.assert_array_equal(found[number], result)


def test_workers_keep_a_study_for_the_next_call():
    with connected(1, None) as own:
        counts = [n for _ in range(2) for _, n in in_parts(Kept(), [(k, k) for k in range(4)], own)]
    assert sorted(counts) == list(range(1, 9))


def test_errors_of_the_study_and_lost_schedulers_are_told_apart(client):
    with pytest.raises(OSError, match="no such table"):
        dict(in_parts(Failing(), [(k, np.full(3, float(k))) for k in range(5)], client))
    with pytest.raises(InputError, match="connection to the Dask scheduler is lost"), connected(1, None) as own:
        for number, _ in in_parts(Squares(), [(k, np.zeros(3)) for k in range(100)], own):
            if number == 3:
                own.cluster.close()


def test_only_encrypted_or_local_schedulers_are_used():
    with pytest.raises(InputError, match="unencrypted"), connected(None, "tcp://192.0.2.1:8786"):
        pass
    with connected(None, None) as nothing:
        assert nothing is None
