"""Messages about weak directions: unknowns that move together, size of the motion, and the simplest cure.

A direction is named by the unknowns that move: points only, an image, the block or a part of it as a rigid body, or
shared parameters with compensating motions of the images. Fixing a parameter is proposed only if the remaining
direction is not weaker than `POOR`, and control only if points move.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment.datum_messages import MOTIONS, motion_names
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.adjustment.solver.similarity import motions
from jaxphoto.adjustment.weak_directions import OPEN, POOR, WeakDirection, weak_directions, yardsticks
from jaxphoto.arrays import to_numpy
from jaxphoto.errors import counted, few

# Minimum fraction of the squared motion that a similarity must explain.
_RIGID = 0.9
# Ratio of second to first principal extent below which image points are collinear.
_LINE = 0.15
# Fraction of all images above which a motion is one of the whole block.
_WHOLE = 0.9
_SHOWN = 3
_SENTENCES = 3
_HEADING = "fly strips in opposite directions"


class WeakUnknowns(NamedTuple):
    """Weakly determined unknowns: message with its cure, and the shared unknowns that participate."""

    sentence: str
    labels: frozenset[str]
    sigma: float
    """Scaled standard deviation (`adjustment.yardsticks`)."""
    points: tuple[int, ...] = ()
    """Points that may lie anywhere along their rays, if no other unknowns participate."""


def weaknesses_of(adjusted: Adjustment, least: float = POOR) -> list[WeakUnknowns]:
    """Describe `weak_directions`, the weakest first; directions of the same unknowns share one message."""
    words = _Words(adjusted)
    alike: dict[tuple[str, ...], list[WeakDirection]] = {}
    for direction in weak_directions(adjusted, least):
        if words.harmless(direction):
            continue
        alike.setdefault(words.kind(direction), []).append(direction)
    told = [words.told(kind, directions) for kind, directions in list(alike.items())[:_SENTENCES]]
    # If most points are undetermined, report only that: all other defects follow from it.
    nowhere = next(iter(alike), ()) == ("points",) and 2 * len(next(iter(alike.values()))[0].points) > len(words.xyz)
    return told[:1] if nowhere else told


class _Words:
    """Properties of a block needed to describe its directions."""

    def __init__(self, adjusted: Adjustment) -> None:
        self.block, self.structure = adjusted.block, adjusted.structure
        self.values, self.yard = adjusted.values, yardsticks(adjusted)
        self.position = to_numpy(adjusted.unknowns.exterior.position)
        self.rotation = to_numpy(adjusted.unknowns.exterior.camera_from_object)
        self.xyz = to_numpy(adjusted.unknowns.points)
        self.cameras = adjusted.unknowns.interior

    def kind(self, d: WeakDirection) -> tuple[str, ...]:
        """Key that groups directions into one message."""
        images, fields = tuple(self.block.images[i] for i in d.images), _fields(self._labels(d))
        if not images:
            return ("shared", *fields) if fields else ("points",)
        if len(images) == 1 and len(self.block.images) > 2 and not fields:
            return ("image", *images)
        if self._as_body(d) is not None:
            return ("block", *fields) if len(images) > _WHOLE * len(self.block.images) else ("part", *fields)
        return ("images", *fields)

    def harmless(self, d: WeakDirection) -> bool:
        """Return True if only images move and their projections remain valid: a rotation compensates a shift.

        This occurs in valid blocks for images with few points. Criterion: the projections of new points in the middle
        and the corners of the image change by less than `POOR` times their scale.
        """
        images = d.images
        if not (len(images) or len(d.shared) or len(d.points)):
            # Skip this direction: most of the variance of its most affected parameter is due to another direction,
            # which reports it.
            return True
        if not len(images) or len(d.shared) or np.abs(d.moved.points).max(initial=0.0) > POOR:
            return False
        cameras = [self.block.image_camera[i] for i in images]
        half = [np.array([self.block.sensors[k].width_mm, self.block.sensors[k].height_mm]) / 2 for k in cameras]
        c = [float(self.cameras[k].c) for k in cameras]
        signs = np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
        rays = np.array([np.column_stack([h * signs, np.full(len(signs), -k)]) for h, k in zip(half, c, strict=True)])
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        s = self.structure
        distance = np.linalg.norm(self.xyz[s.point] - self.position[s.image], axis=1)
        depth = np.array([np.median(distance[s.image == i]) for i in images])[:, None, None]
        moved, turn = d.moved.exterior[images, None, :3] * self.yard.ground, d.moved.exterior[images, None, 3:]
        shift = np.einsum("nij,nkj->nki", self.rotation[images], moved)
        seen = shift + np.cross(turn * self.yard.angle, depth * rays)
        across = seen - np.sum(seen * rays, axis=2, keepdims=True) * rays
        return bool(np.linalg.norm(across, axis=2).max() < POOR * self.yard.ground)

    def told(self, kind: tuple[str, ...], directions: list[WeakDirection]) -> WeakUnknowns:
        """Return the message about directions of one kind; the weakest comes first."""
        d = directions[0]
        labels = list(dict.fromkeys(label for one in directions for label in self._labels(one)))
        if kind[0] in ("block", "part"):
            bodies = [body for one in directions if (body := self._as_body(one)) is not None]
            names = motion_names(np.array(bodies))
            sentence = self._block(d, labels, names) if kind[0] == "block" else self._part(d, labels, names)
        elif kind[0] == "points":
            points = tuple(sorted({int(p) for one in directions for p in one.points}))
            return WeakUnknowns(self._points(d), frozenset(), d.sigma, points)
        elif kind[0] == "image":
            sentence = self._image(d)
        else:
            sentence = self._shared(d, labels) if kind[0] == "shared" else self._images(d, labels)
        return WeakUnknowns(sentence, frozenset(labels), d.sigma)

    def _labels(self, d: WeakDirection) -> list[str]:
        return [self.structure.labels[j] for j in sorted(d.shared, key=lambda j: -d.share[j])]

    def _points(self, d: WeakDirection) -> str:
        angle = max(self._angle(int(p)) for p in d.points)
        cure = "measure them in an image from another position, or remove them"
        if 2 * len(d.points) > len(self.block.points):
            cure = "all images have nearly one position: add images from other positions"
        return (
            f"point {_those(self.block.points, d.points)}: {_hardly(d)} along the rays ({self._sigmas(d)}), which are "
            f"nearly parallel, {angle:.2g} deg apart at most: {cure}"
        )

    def _image(self, d: WeakDirection) -> str:
        (image,) = d.images
        mine = self.structure.image == image
        xy = to_numpy(self.block.image_points.xy)[mine]
        extent = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False) if len(xy) > 2 else np.array([1.0, 1.0])
        on_line = ", nearly on a line" if extent[1] < _LINE * extent[0] else ""
        return (
            f"image {self.block.images[image]}: its orientation is {_hardly(d)} ({self._sigmas(d)}) by its "
            f"{counted(int(mine.sum()), 'point')}{on_line}: measure more points in it"
            f"{', off that line' if on_line else ''}, give its station and attitude, or remove it"
        )

    def _shared(self, d: WeakDirection, labels: list[str]) -> str:
        along = f" with the positions of {len(d.points)} of {len(self.block.points)} points" if len(d.points) else ""
        cures = [self._holding(d, labels)]
        if along:
            cures.append(f"add control points (point {self._farthest(d)} moves most)")
            if _turns_with_heading(labels):
                cures.append(_HEADING)
        return f"{few(labels)}{along}: {_hardly(d, len(labels) > 1 or bool(along))} ({self._sigmas(d)}): {_or(cures)}"

    def _part(self, d: WeakDirection, labels: list[str], names: list[str]) -> str:
        joint = f" together with {few(labels)}" if labels else ""
        s = self.structure
        inside = np.isin(s.image, d.images)
        none = "too little" if len(np.intersect1d(s.point[inside], s.point[~inside])) else "no points"
        return (
            f"image {_those(self.block.images, d.images)}, which share {none} with "
            f"the others: {_and(names)} of this part{joint} {_hardly(d)} ({self._sigmas(d)}): measure points that it "
            "shares with the others, or add control points in it"
        )

    def _block(self, d: WeakDirection, labels: list[str], names: list[str]) -> str:
        joint = f" together with {few(labels)}" if labels else ""
        cures = [self._holding(d, labels)] if labels else []
        turns = any("rotation" in name for name in names)
        if len(d.points):
            beside = ", off the line of the existing ones" if turns and len(self.block.control) else ""
            cures.append(f"add control points{beside} (point {self._farthest(d)} moves most)")
        if _turns_with_heading(labels):
            cures.append(_HEADING)
        elif not labels:
            cures.append("add a cross strip" if len(self.block.stations) else "add camera stations")
        return f"the whole block: {_and(names)}{joint} {_hardly(d)} ({self._sigmas(d)}): {_or(cures)}"

    def _farthest(self, d: WeakDirection) -> str:
        """Return the point that moves most."""
        return self.block.points[int(np.abs(d.moved.points).max(axis=1).argmax())]

    def _images(self, d: WeakDirection, labels: list[str]) -> str:
        n, images = len(self.block.images), d.images
        who = "all images" if len(images) == n else f"image {_those(self.block.images, images)}"
        what = f"{few(labels)} with {self._coordinates(d)} of {who}" if labels else f"{self._coordinates(d)} of {who}"
        cures = [self._holding(d, labels)] if labels else []
        owners = {label.split("[")[0] for label in labels}
        if len(d.points):
            cures.append(f"add control points (point {self._farthest(d)} moves most)")
        if "interior" in owners and not owners & {"mounts", "strips"}:
            cures.append("add camera stations (GNSS), relief, a second flying height or oblique images")
        elif _turns_with_heading(labels):
            cures.append(_HEADING)
        elif not labels:
            cures.append("measure more points in these images, or give their stations and attitudes")
        return f"{what}: {_hardly(d, bool(labels))} ({self._sigmas(d)}): {_or(cures)}"

    def _holding(self, d: WeakDirection, labels: list[str]) -> str:
        """Return the cure: fix one of several unknowns if one suffices, otherwise all."""
        enough = {label for label, left in zip(self.structure.labels, self._left(d), strict=True) if left < POOR}
        will_do = [label for label in labels if label in enough]
        if will_do:
            return f"fix {few(will_do, ' or ')} at a known value, or give it a weight"
        return f"fix {few(labels, ' and ')} at known values, or give them weights"

    def _left(self, d: WeakDirection) -> np.ndarray:
        """Return the remaining sigma of the direction, for each shared unknown if it is fixed."""
        return np.sqrt(1 - d.share) * d.sigma

    def _as_body(self, d: WeakDirection) -> Float[np.ndarray, "motions"] | None:
        """Return the similarity of the motion; None if it is not a similarity."""
        images, points = d.images, d.points
        places = self.xyz[points] if len(points) else self.position[images]
        centre = places.mean(axis=0)
        size = float(np.sqrt(((places - centre) ** 2).sum(1).mean())) or 1.0
        position, rotation, places = map(to_numpy, (self.values.position, self.values.rotation, self.values.points))
        eop, xyz = motions(position, rotation, places, centre, size)
        yard = np.repeat([self.yard.ground, self.yard.angle], 3)
        columns = np.concatenate(
            [
                (eop[:, :, images] / yard[:, None]).transpose(0, 2, 1).reshape(len(MOTIONS), -1),
                xyz[:, :, points].transpose(0, 2, 1).reshape(len(MOTIONS), -1) / self.yard.ground,
            ],
            axis=1,
        ).T
        seen = np.concatenate([d.moved.exterior[images].ravel(), d.moved.points[points].ravel()])
        found, *_ = np.linalg.lstsq(columns, seen, rcond=None)
        left = np.sum((seen - columns @ found) ** 2) / np.sum(seen**2)
        # Require points: a motion of images alone is not a similarity, which would also move their points.
        return found / np.abs(found).max() if left < 1 - _RIGID and len(points) else None

    def _coordinates(self, d: WeakDirection) -> str:
        """Return the motion of the images as X, Y, Z and rotations about the object axes."""
        moved = d.moved.exterior[d.images]
        turned = np.einsum("nij,ni->nj", self.rotation[d.images], moved[:, 3:])
        parts = np.sqrt((np.concatenate([moved[:, :3], turned], axis=1) ** 2).mean(axis=0))
        names = ("X", "Y", "Z", "rotation about X", "rotation about Y", "rotation about Z")
        return _and([name for name, part in zip(names, parts, strict=True) if part > 0.3 * parts.max()])

    def _sigmas(self, d: WeakDirection) -> str:
        """Format the motions of the unknowns that participate."""
        if d.sigma > OPEN:
            return "no observation depends on this motion"
        moved, yard, found = d.moved, self.yard, []
        if len(d.points):
            found.append(f"points {yard.ground * np.abs(moved.points).max():.2g} m")
        if len(d.images):
            found.append(f"images {yard.ground * np.abs(moved.exterior[:, :3]).max():.2g} m")
            found.append(f"{np.degrees(yard.angle * np.abs(moved.exterior[:, 3:]).max()):.2g} deg")
        for j in sorted(d.shared, key=lambda j: -d.share[j])[:_SHOWN]:
            found.append(f"{self.structure.labels[j]} {yard.shared[j] * abs(moved.shared[j]):.2g}")
        return f"sigma of {', '.join(found)}"

    def _angle(self, point: int) -> float:
        """Return the largest angle between two rays of a point, in degrees."""
        s = self.structure
        to = self.position[s.image[s.point == point]] - self.xyz[point]
        to /= np.linalg.norm(to, axis=1, keepdims=True)
        return float(np.degrees(np.arccos(np.clip(to @ to.T, -1.0, 1.0)).max(initial=0.0)))


def _those(names: tuple[str, ...], which: np.ndarray) -> str:
    """Format some of the names, selected by index."""
    return few([names[k] for k in which])


def _fields(labels: list[str]) -> tuple[str, ...]:
    """Return parameter names without axes: mounts[a].lever_arm; both principal point coordinates become one."""
    return tuple(sorted({label.replace("yp_mm", "xp_mm").rsplit("_", 2)[0] for label in labels}))


def _turns_with_heading(labels: list[str]) -> bool:
    """Return True if the effect on the ground rotates with the heading: strips flown in opposite directions separate
    it.
    """
    ours = any(label.startswith(("mounts[", "interior[")) for label in labels)
    return ours and not any(label.endswith(("lever_arm_up_m", "c_mm")) for label in labels)


def _hardly(d: WeakDirection, several: bool = False) -> str:
    """Describe a direction of one unknown, or of `several` that compensate one another."""
    return f"{'not' if d.sigma > OPEN else 'hardly'} {'separable' if several else 'determined'}"


def _and(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _or(cures: list[str]) -> str:
    return ", or ".join(cures)
