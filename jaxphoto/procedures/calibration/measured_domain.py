"""Residuals in the measured image for a distortion that is a polynomial there.

Such a model takes measured to ideal coordinates, and its residual is `ideal(measured) - projection`: the noise of the
measurement goes through the lens, and coefficients that shrink the ideal image shrink the noise with it. Over a normal
lens that is nothing. Over a wide-angle one with a noise of half a pixel it moves the estimates by standard deviations,
by more with R0 > 0, because R0 makes the scale of the ideal image one of the unknowns' affairs. Here the residual is
`measured - measured(projection)`, that of maximum likelihood, the same for every R0.
"""

from typing import ClassVar, Literal

import equinox as eqx
from jaxtyping import Array, Float

from jaxphoto.camera import AbstractDistortion, InteriorOrientation


class InMeasuredImage(AbstractDistortion):
    """`model`, whose closed form is in the measured coordinate, as a map from ideal to measured coordinates.

    The same rays, the same coefficients; only the residuals of an adjustment are others.
    """

    model: AbstractDistortion

    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Measured coordinate of an ideal one, both reduced to the principal point."""
        return self.model.measured_from_ideal(xy)

    def ideal_from_measured(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate of a measured one, in closed form."""
        return self.model.closed_form(xy)

    @property
    def coefficients(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those of the model."""
        return self.model.coefficients

    @property
    def scales(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those of the model."""
        return self.model.scales

    @property
    def normalised(self) -> bool:  # type: ignore[override]
        """As the model."""
        return self.model.normalised

    def __getattr__(self, name: str):
        # The coefficients are leaves of the model, and are read and set as if they were of this.
        if name.startswith("_") or name == "model":
            raise AttributeError(name)
        return getattr(self.model, name)


def in_measured_image(interior: InteriorOrientation) -> InteriorOrientation:
    """The same camera with residuals in the measured image."""
    if interior.distortion.domain == "ideal":
        return interior
    return eqx.tree_at(lambda i: i.distortion, interior, InMeasuredImage(interior.distortion))


def own_domain(interior: InteriorOrientation) -> InteriorOrientation:
    """The camera with its distortion as it is: the inverse of `in_measured_image`. Of priors as well."""
    model = interior.distortion
    return (
        eqx.tree_at(lambda i: i.distortion, interior, model.model) if isinstance(model, InMeasuredImage) else interior
    )


__all__ = ["InMeasuredImage", "in_measured_image", "own_domain"]
