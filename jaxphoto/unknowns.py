"""What an adjustment solves for, and what is known of it beforehand.

`Unknowns` is a tree of numbers; `priors` is the same tree with FREE, FIXED or Weighted(value, sigma) in place of
them. "The second experiment without k_2" is one `eqx.tree_at`:

    priors = eqx.tree_at(lambda u: u.interior["kodak"].distortion.k2, priors, FIXED)

For interior orientation the leaves are scalars. `exterior.position`, `exterior.camera_from_object`, `points`, and
each mount's, strip's and scanner's vector take one prior for the whole array.
"""

import enum

import equinox as eqx
import jax
from jaxtyping import Float

from jaxphoto.arrays import Numbers
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Mount, Scanner, StripBias


class Prior(enum.Enum):
    """An unknown nobody knows anything about, or one that is not an unknown at all."""

    FREE = "free"
    FIXED = "fixed"

    def __repr__(self) -> str:
        return self.name


FREE, FIXED = Prior.FREE, Prior.FIXED


class Weighted(eqx.Module):
    """An unknown observed beforehand as `value` with standard deviation `sigma` (its own units, arrays allowed)."""

    value: Float[Numbers, "..."] | float
    sigma: Float[Numbers, "..."] | float


class Unknowns(eqx.Module):
    """All parameters of a block: per camera, per image, per point, per mount and per strip; and of a laser scanner.

    `exterior` has a leading axis over the block's images and `points` (m) over its points, in the block's order.
    """

    interior: dict[str, InteriorOrientation]
    exterior: ExteriorOrientation
    points: Float[Numbers, "points 3"]
    mounts: dict[str, Mount]
    strips: dict[str, StripBias]
    scanner: Scanner | None = None


def uniform_priors(unknowns: Unknowns, prior: Prior) -> Unknowns:
    """A tree of priors shaped like `unknowns`, `prior` everywhere."""
    return jax.tree.map(lambda _: prior, unknowns)


def default_priors(unknowns: Unknowns) -> Unknowns:
    """Exterior orientation and object points FREE, everything else FIXED."""
    priors = uniform_priors(unknowns, FIXED)
    places = lambda u: (u.exterior.position, u.exterior.camera_from_object, u.points)  # noqa: E731
    return eqx.tree_at(places, priors, (FREE, FREE, FREE))
