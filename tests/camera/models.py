"""Distortion models with numbers of real cameras, and with every coefficient at work."""

import numpy as np

from jaxphoto.camera import Balanced, Brown, Smac, constant_names
from jaxphoto.camera.distortion import AffineBrown

# Per model: the coefficients in units of the size they have on a sensor of 36 mm x 24 mm.
_BROWN = {"k1": 1e-4, "k2": 1e-7, "k3": 1e-10, "p1": 1e-5, "p2": 1e-5, "b1": 1e-3, "b2": 1e-3}
_SMAC = {"k0": 1e-2, "k1": 1e-4, "k2": 1e-7, "k3": 1e-10, "k4": 1e-13, "p1": 1e-5, "p2": 1e-5, "p3": 1e-3, "p4": 1e-6}
UNITS = {
    Brown: _BROWN,
    AffineBrown: _BROWN,
    Smac: {
        "k0": 1e-2,
        "k1": 1e-4,
        "k2": 1e-7,
        "k3": 1e-10,
        "k4": 1e-13,
        "p1": 1e-5,
        "p2": 1e-5,
        "p3": 1e-3,
        "p4": 1e-6,
    },
    Balanced: {"a1": 1e-4, "a2": 1e-7, "a3": 1e-10, "b1": 1e-5, "b2": 1e-5, "c1": 1e-3, "c2": 1e-3},
}


def build(model, numbers):
    """A model from its coefficients as multiples of `UNITS`, in the model's order; R0 = 8 mm where it has one."""
    units = UNITS[model]
    assert tuple(units) == model.coefficients, "UNITS and the model disagree"
    constants = dict.fromkeys(constant_names(model).values(), 8.0)
    return model(**{name: numbers[i] * unit for i, (name, unit) in enumerate(units.items())}, **constants)


KODAK = Brown(k1=-9.1217e-5, k2=1.0435e-7)  # paper 000, table 2, first experiment
GOPRO = Smac(k1=-3.9445e-2, k2=-1.1881e-3, k3=-1.3126e-4)  # paper 002, table 3, R0 = 0
GOPRO_XY = np.array([2.325, 1.74])  # its corner
AICON = Balanced(
    a1=-1.09607e-4, a2=1.49566e-7, b1=5.79843e-6, b2=-8.64454e-6, c1=-7.00801e-5, c2=-3.12627e-5, r0=13.488
)  # of the AICON report
