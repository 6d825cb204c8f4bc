"""Distortions of the user's own that cannot work are refused where they enter."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import AbstractDistortion, InputError
from tests.blocks import simulated


class Root(AbstractDistortion):
    """Contains the distance itself, whose derivative on the axis is not finite."""

    q1: float = 0.0
    name, domain, coefficients, powers = "root_of_radius", "measured", ("q1",), {"q1": -1}

    def closed_form(self, xy):
        return xy * (1 + self.q1 * jnp.sqrt(jnp.sum(xy**2)))


class Length(AbstractDistortion):
    """Returns a number instead of a coordinate."""

    q1: float = 0.0
    name, domain, coefficients, powers = "a_length", "measured", ("q1",), {"q1": -1}

    def closed_form(self, xy):
        return self.q1 * jnp.sum(xy**2)


class Logarithm(AbstractDistortion):
    """Is not defined at the corners of the format."""

    q1: float = 0.0
    name, domain, coefficients, powers = "a_logarithm", "measured", ("q1",), {"q1": 0}

    def closed_form(self, xy):
        return xy * (1 + self.q1 * jnp.log(100 - jnp.sum(xy**2)))


@pytest.mark.parametrize("distortion", [Root(), Length(), Logarithm(), Root, None])
def test_what_is_no_distortion_is_refused(distortion):
    with pytest.raises(InputError):
        simulated("cross").block.with_distortion("one", distortion, free=("q1",))


def test_a_domain_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="undistorted"):
        type("Wrong", (AbstractDistortion,), {
            "name": "wrong_domain", "domain": "undistorted", "closed_form": lambda self, xy: xy, "__module__": __name__,
        })  # fmt: skip


def test_models_of_jaxphoto_pass():
    models = [m for m in AbstractDistortion.known().values() if m.__module__.startswith("jaxphoto.")]
    assert len(models) > 5
    for model in models:
        model.plain(simulated("cross").block.sensors["one"]).check(np.array([[0.0, 0.0], [18.0, 12.0]]))
