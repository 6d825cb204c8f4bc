"""A model is what its class declares: a user's own is read, written and told like those of jaxphoto."""

import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from jaxphoto.camera import (
    DISTORTIONS,
    PROJECTIONS,
    AbstractDistortion,
    AbstractProjection,
    Brown,
    Ebner,
    Gruen,
    InteriorOrientation,
    Perspective,
    Sensor,
    Smac,
    empty_camera,
    get_parameter,
    model_keys,
    parameter_names,
    set_parameter,
)
from jaxphoto.camera.conversion import converted
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.toml import toml_text
from jaxphoto.procedures.calibration import distortion_model
from jaxphoto.procedures.model_choice import candidate_of
from jaxphoto.unknowns import FIXED, FREE

SENSOR = Sensor(4500, 3000, 0.008)


class Tangent(AbstractDistortion):
    """ideal = measured tan(t) / t, t^2 = a r^2 / s^2: one coefficient, one constant, one word."""

    s: float
    a: float = 0.0
    way: str = eqx.field(static=True, default="out")

    name = "tangent_of_a_test"
    domain = "measured"
    coefficients = ("a",)
    powers = {"a": 0}  # noqa: RUF012
    constants = {"s_mm": "s"}  # noqa: RUF012
    choices = {"way": ("out", "in")}  # noqa: RUF012

    @classmethod
    def plain(cls, sensor):
        return cls(s=sensor.width_mm)

    def closed_form(self, xy):
        t2 = self.a / self.s**2 * (xy[0] ** 2 + xy[1] ** 2) * (1 if self.way == "out" else -1)
        stretch = 1 + t2 / 3 + 2 * t2**2 / 15
        return jnp.stack([xy[0] * stretch, xy[1] * stretch])


class Skewed(Perspective):
    """A perspective plane with a coefficient of its own."""

    skew: float = 0.0
    name = "skewed_of_a_test"
    coefficients = ("skew",)
    powers = {"skew": 0}  # noqa: RUF012

    def ideal_from_direction(self, c, u, v, w):
        return -c * (u + self.skew * v) / w, -c * v / w

    def direction_from_ideal(self, c, x, y):
        return x - self.skew * y, y, -c


OWN = InteriorOrientation(35.0, 0.1, -0.2, Tangent(30.0, 0.2, "in"), projection=Skewed(0.01))


def section_of(interior):
    priors = set_parameter(jax.tree.map(lambda _: FIXED, interior), "a", FREE)
    return {"cameras": {"own": camera_section(Camera(SENSOR, interior, priors))}}


def test_it_is_known_by_its_name_and_no_part_of_jaxphoto():
    assert AbstractDistortion.called("tangent_of_a_test") is Tangent
    assert AbstractProjection.called("skewed_of_a_test") is Skewed
    assert "tangent_of_a_test" not in DISTORTIONS and "skewed_of_a_test" not in PROJECTIONS
    assert set(DISTORTIONS) <= set(AbstractDistortion.known())


def test_block_toml_holds_it_and_gives_it_back():
    text = toml_text(section_of(OWN))
    assert 'distortion = "tangent_of_a_test"' in text and 'projection = "skewed_of_a_test"' in text
    read = read_settings(tomllib.loads(text)).cameras["own"]
    assert type(read.interior.distortion) is Tangent and read.interior.distortion.way == "in"
    assert float(read.interior.distortion.s) == 30.0 and float(read.interior.projection.skew) == 0.01
    assert read.priors.distortion.a == FREE and read.priors.projection.skew == FIXED
    for name in parameter_names(OWN):
        assert float(get_parameter(read.interior, name)) == float(get_parameter(OWN, name))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"way": "up"}, 'way: \'up\' is unknown; write "out" or "in"'),
        ({"sign": "add"}, "unknown key; use width_px, .*, interior, unknowns, .*, way"),
        ({"projection": "fish"}, "unknown projection model 'fish'; choose one of perspective, equidistant"),
        ({"distortion": "tangend"}, "unknown distortion model 'tangend'; choose one of brown, affine_brown"),
        ({"interior": {"c_mm": 35.0, "a": 0.1}}, "s_mm: the key is missing"),
        (
            {"interior": {"c_mm": 35.0, "s_mm": 9.0, "aa": 0.1}},
            "aa: unknown key; use c_mm, xp_mm, yp_mm, a, skew",
        ),
        ({"unknowns": {"A": "free"}}, "A: unknown key; use c_mm, xp_mm, yp_mm, a, skew"),
    ],
)
def test_mistakes_in_block_toml_are_told(wrong, message):
    values = section_of(OWN)
    values["cameras"]["own"] |= wrong
    with pytest.raises(InputError, match=rf"\[cameras.own.*{message}"):
        read_settings(tomllib.loads(toml_text(values)))


def test_results_tell_the_models_of_a_camera():
    told = model_keys(OWN)
    assert told == {"distortion": "tangent_of_a_test", "projection": "skewed_of_a_test", "way": "in"}
    empty = empty_camera(told)
    assert jax.tree.structure(empty) == jax.tree.structure(OWN)
    # Of a perspective camera nothing more is told than before there were others.
    assert model_keys(InteriorOrientation(35.0, distortion=Smac(sign="add"))) == {"distortion": "smac", "sign": "add"}
    assert model_keys(InteriorOrientation(35.0)) == {"distortion": "brown"}


def test_it_converts_and_is_a_candidate():
    assert candidate_of("tangent_of_a_test").free == ("a",)
    plane = InteriorOrientation(35.0, 0.1, -0.2, Tangent(30.0, 0.1))
    done = converted(plane, Brown, SENSOR)
    assert 0 < done.max_px < 0.1
    back = converted(done.interior, Tangent, SENSOR)
    assert back.interior.distortion.s == SENSOR.width_mm and back.max_px < 0.2
    # The plane of one's own is kept, and taken to that of others where they have none.
    assert type(converted(OWN, Brown, SENSOR).interior.projection) is Skewed
    assert converted(OWN, Brown, SENSOR, projection=Perspective()).max_px < 0.5


def test_the_grid_of_orthogonal_polynomials_is_chosen_in_one_place():
    for kind in (Ebner, Gruen):
        for sensor in (SENSOR, Sensor(3000, 4500, 0.008)):
            assert kind.plain(sensor).b == 18.0
            assert distortion_model(kind.name, sensor).b == 18.0
            plane = InteriorOrientation(35.0)
            assert float(converted(plane, kind, sensor).interior.distortion.b) == 18.0


# Mistakes in a class --------------------------------------------------------------------------------------


def test_a_misspelt_coefficient_is_refused_when_the_class_is_defined():
    with pytest.raises(InputError, match=r"Misspelt: k_1 declared, but no such field exists; its fields are k1$"):

        class Misspelt(AbstractDistortion):
            k1: float = 0.0
            name = "misspelt_of_a_test"
            domain = "measured"
            coefficients = ("k_1",)

    assert "misspelt_of_a_test" not in AbstractDistortion.known()


def test_a_coefficient_without_unit_is_refused():
    with pytest.raises(InputError, match="Unitless: the unit of k1 is not declared"):

        class Unitless(AbstractDistortion):
            k1: float = 0.0
            name = "unitless_of_a_test"
            domain = "measured"
            coefficients = ("k1",)


def test_a_field_that_is_declared_nowhere_is_refused():
    with pytest.raises(InputError, match="Silent: the field k2 is not declared; name it in"):

        class Silent(AbstractDistortion):
            k1: float = 0.0
            k2: float = 0.0
            name = "silent_of_a_test"
            domain = "measured"
            coefficients = ("k1",)


def test_the_name_of_another_model_is_refused_and_a_cell_may_run_again():
    with pytest.raises(InputError, match=r"another class, jaxphoto.camera.distortion.brown.Brown, is called 'brown'"):

        class Brownish(AbstractDistortion):
            name = "brown"
            domain = "measured"

    def cell(value):
        class Again(AbstractDistortion):
            name = "again_of_a_test"
            domain = "measured"
            number = value

    for number in (1, 2):
        cell(number)
        assert AbstractDistortion.called("again_of_a_test").number == number


def test_a_parameter_that_a_camera_has_not_is_named():
    with pytest.raises(InputError, match="distortion brown has no parameter 'k4'; it has c_mm, xp_mm, yp_mm, k1, k2"):
        set_parameter(InteriorOrientation(35.0), "k4", 1.0)
    with pytest.raises(InputError, match="has no parameter 'k_1'"):
        get_parameter(InteriorOrientation(35.0), "k_1")
