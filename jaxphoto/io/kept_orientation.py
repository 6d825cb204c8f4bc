"""An orientation of photographs as a piece of a long run: what took minutes is not done again after an interruption.

What comes back is what went in, in every bit; a piece is known by everything that it follows from.
"""

import json
from collections.abc import Callable, Sequence
from importlib.metadata import version

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import PaddedSizes
from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.initial.matches import PairMatches
from jaxphoto.io.kept_pieces import KeptPieces, name_of
from jaxphoto.observations import ImagePoints
from jaxphoto.procedures.orientation import GrossErrors, OrientationReport, Oriented, orient
from jaxphoto.procedures.orientation.orient_photographs import CAMERA, METHOD, photographs_block
from jaxphoto.procedures.orientation.related_pairs import Report
from jaxphoto.unknowns import FIXED, FREE, Weighted

_KINDS = {"free": FREE, "fixed": FIXED}


def kept_orient(keep: KeptPieces) -> Callable[..., Oriented]:
    """`orient`, whose outcome is a piece in `keep`, and is taken from there where it is already."""

    def kept(
        names: Sequence[str],
        sensor: Sensor,
        interior: InteriorOrientation,
        features: Sequence[Float[np.ndarray, "_ 2"]],
        matches: Sequence[PairMatches],
        sigmas_mm: Sequence[Float[np.ndarray, "_"]],
        title: str,
        report: Report,
    ) -> Oriented:
        given = jax.tree.map(float, interior)
        numbers = [np.concatenate(features), np.concatenate(sigmas_mm), *(m.features for m in matches)]
        name = name_of(
            "orientation", METHOD, version("jaxphoto"), jax.__version__, np.__version__, tuple(names), sensor, given,
            [len(xy) for xy in features], [(m.first, m.second) for m in matches], title,
            *(np.ascontiguousarray(rows).tobytes() for rows in numbers),
        )  # fmt: skip
        if (found := keep.read(name)) is not None:
            return unpacked(found, sensor, interior, title)
        made = orient(names, sensor, interior, features, matches, sigmas_mm, title=title, report=report)
        keep.write(name, **packed(made))
        return made

    return kept


def packed(oriented: Oriented) -> dict[str, np.ndarray]:
    """Return the arrays of an orientation; `unpacked` knows what they mean."""
    block = oriented.block
    interior, priors = block.start.unknowns.interior[CAMERA], block.priors.interior[CAMERA]
    prior = [get_parameter(priors, name) for name in parameter_names(priors)]
    kinds = ["free" if p == FREE else "fixed" if p == FIXED else "weighted" for p in prior]
    known = [(float(p.value), float(p.sigma)) if isinstance(p, Weighted) else (0.0, 0.0) for p in prior]
    exterior, rows = block.start.unknowns.exterior, block.image_points
    report = oriented.report._replace(gross_errors=oriented.report.gross_errors._asdict())  # type: ignore[arg-type]
    return {
        "images": np.array(block.images),
        "points": np.array(block.points),
        "report": np.array(json.dumps(report._asdict())),
        "interior": np.array([get_parameter(interior, name) for name in parameter_names(interior)], float),
        "prior_kinds": np.array(kinds),
        "prior_values": np.array(known),
        "position": np.asarray(exterior.position),
        "camera_from_object": np.asarray(exterior.camera_from_object),
        "xyz": np.asarray(block.start.unknowns.points),
        "image": np.asarray(rows.image),
        "point": np.asarray(rows.point),
        "xy": np.asarray(rows.xy),
        "sigma": np.asarray(rows.sigma),
        "residuals_mm": oriented.residuals_mm,
        "sizes": np.array(json.dumps(oriented.sizes)),
    }


def unpacked(arrays: dict[str, np.ndarray], sensor: Sensor, interior: InteriorOrientation, title: str) -> Oriented:
    """Return the orientation of `packed`; `interior` is of the camera's model."""
    names, priors = parameter_names(interior), interior
    for name, kind, known in zip(names, arrays["prior_kinds"].tolist(), arrays["prior_values"], strict=True):
        prior = _KINDS[kind] if kind in _KINDS else Weighted(np.asarray(known[0]), np.asarray(known[1]))
        priors = set_parameter(priors, name, prior)
    for name, value in zip(names, arrays["interior"].tolist(), strict=True):
        interior = set_parameter(interior, name, value)
    exterior = ExteriorOrientation(arrays["position"], arrays["camera_from_object"])  # type: ignore[arg-type]
    block = photographs_block(
        title,
        arrays["images"].tolist(),
        arrays["points"].tolist(),
        sensor,
        (jax.tree.map(as_jax_array, interior), priors),
        (exterior, arrays["xyz"]),
        ImagePoints(arrays["image"], arrays["point"], arrays["xy"], arrays["sigma"]),
    )
    report = json.loads(str(arrays["report"]))
    report = {key: tuple(value) if isinstance(value, list) else value for key, value in report.items()}
    gross = GrossErrors(**report.pop("gross_errors"))
    *most, rows = json.loads(str(arrays["sizes"]))
    sizes = PaddedSizes._make([*most, tuple((group, number) for group, number in rows)])
    return Oriented(block, arrays["residuals_mm"], OrientationReport(**report, gross_errors=gross), sizes)
