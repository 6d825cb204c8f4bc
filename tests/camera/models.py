"""Distortion models with numbers of real cameras, and with every coefficient at work."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.camera import (
    DISTORTIONS,
    AffineBrown,
    Agisoft,
    Balanced,
    Brown,
    Brown14,
    BrownAffine,
    BundlerRadial,
    Ebner,
    Gruen,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    PpsRadial,
    RadialPolynomial,
    Smac,
    StretchedBrown,
)

# Per model: the coefficients in units of the size they have on a sensor of 36 mm x 24 mm.
_RADIAL = {"k1": 1e-4, "k2": 1e-7, "k3": 1e-10}
_BROWN = {**_RADIAL, "p1": 1e-5, "p2": 1e-5, "b1": 1e-3, "b2": 1e-3}
# Gruen's polynomials at 15 mm from the centre of a grid of 12 mm: a coefficient moves that corner by 0.03 mm.
_POLYNOMIALS = (1, 15, 150, 1500, 17000)
_GRUEN = {name: 0.03 / (_POLYNOMIALS[int(name[1]) - 1] * _POLYNOMIALS[int(name[2]) - 1]) for name in Gruen.coefficients}
UNITS = {
    Brown: _BROWN,
    AffineBrown: _BROWN,
    BrownAffine: _BROWN,
    StretchedBrown: _BROWN,
    Smac: {
        "k0": 1e-2,
        **_RADIAL,
        "k4": 1e-13,
        "p1": 1e-5,
        "p2": 1e-5,
        "p3": 1e-3,
        "p4": 1e-6,
    },
    Balanced: {"a1": 1e-4, "a2": 1e-7, "a3": 1e-10, "b1": 1e-5, "b2": 1e-5, "c1": 1e-3, "c2": 1e-3},
    RadialPolynomial: _RADIAL,
    PpsRadial: {**_RADIAL, "pps_x": 0.5, "pps_y": 0.5},
    Ebner: {f"b{i}": 1e-3 if i < 3 else 2e-4 if i < 7 else 2e-5 if i < 11 else 1e-6 for i in range(1, 13)},
    Gruen: _GRUEN,
    Brown14: {
        f"a{i}": 1e-3 if i < 3 else 2e-4 if i in (3, 4, 8, 9) else 1e-6 if i in (7, 12, 13) else 2e-5
        for i in range(1, 15)
    },
    BundlerRadial: {"k1": 1e-4, "k2": 1e-7},  # normalised: as for a c of 1 mm
    OpenCv: {**_RADIAL, "k4": 1e-5, "k5": 1e-8, "k6": 1e-11, "p1": 1e-5, "p2": 1e-5, "b1": 1e-3, "b2": 1e-3},
    Agisoft: {**_RADIAL, "k4": 1e-13, "p1": 1e-5, "p2": 1e-5, "p3": 1e-3, "p4": 1e-6, "b1": 1e-3, "b2": 1e-3},
    OpenCvFisheye: {**_RADIAL, "k4": 1e-13, **dict.fromkeys(("p1", "p2", "s1", "s2"), 1e-5), "b1": 1e-3, "b2": 1e-3},
}
# Of such a camera: the balance radius, Ebner's and Gruen's grid, the scale of Brown's a13.
CONSTANTS = {"r0": 8.0, "b": 12.0, "f": 35.0}


def _units(model):
    """Of a model that is not listed above: what moves a point 15 mm from the centre by 0.03 mm."""
    constants = {field: CONSTANTS[field] for field in model.constants.values()}

    def moved(values):
        coefficients = dict(zip(model.coefficients, values, strict=True))
        camera = InteriorOrientation(1.0, distortion=model(**coefficients, **constants))
        return camera.ideal_from_measured(jnp.array([12.0, 9.0]))

    by_coefficient = np.abs(jax.jacfwd(moved)(jnp.zeros(len(model.coefficients)))).max(axis=0)
    # Some only scale others, and move nothing by themselves.
    units = np.where(by_coefficient > 0, 0.03 / np.where(by_coefficient > 0, by_coefficient, 1.0), 1.0)
    return dict(zip(model.coefficients, units, strict=True))


UNITS |= {model: _units(model) for model in DISTORTIONS.values() if model not in UNITS}
MOST = max(map(len, UNITS.values()))


def build(model, numbers):
    """A model from its coefficients as multiples of `UNITS`, in the model's order, and `CONSTANTS`."""
    units = UNITS[model]
    assert tuple(units) == model.coefficients, "UNITS and the model disagree"
    constants = {field: CONSTANTS[field] for field in model.constants.values()}
    return model(**{name: numbers[i] * unit for i, (name, unit) in enumerate(units.items())}, **constants)


# The first camera of BAL problem 16-22106 as Ceres leaves it, f = 1486.898 pixels; its points reach 883 and 589 pixels.
FLICKR = BundlerRadial(k1=-0.175763865, k2=0.166040514)
KODAK = Brown(k1=-9.1217e-5, k2=1.0435e-7)  # paper 000, table 2, first experiment
GOPRO = Smac(k1=-3.9445e-2, k2=-1.1881e-3, k3=-1.3126e-4)  # paper 002, table 3, R0 = 0
GOPRO_XY = np.array([2.325, 1.74])  # its corner
AICON = Balanced(
    a1=-1.09607e-4, a2=1.49566e-7, b1=5.79843e-6, b2=-8.64454e-6, c1=-7.00801e-5, c2=-3.12627e-5, r0=13.488
)  # of the AICON report
