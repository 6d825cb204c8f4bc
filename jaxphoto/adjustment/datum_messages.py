"""Messages about an undetermined datum: undetermined motions by name, available observations, and the cure."""

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Block
from jaxphoto.observations import ControlCoordinates

MOTIONS = (
    "shift in X",
    "shift in Y",
    "shift in Z",
    "rotation about X",
    "rotation about Y",
    "rotation about Z",
    "scale",
)


def motion_names(combinations: Float[np.ndarray, "n motions"]) -> list[str]:
    """Return the names of the motions in combinations.

    A rotation about a point other than the centre includes a shift: shifts are named only if there are more
    combinations than rotations and scale.
    """
    shares = np.sqrt((combinations**2).sum(0))
    named = [m for m, share in zip(MOTIONS, shares, strict=True) if share > 0.05 * shares.max()]
    turns = [name for name in named if not name.startswith("shift")]
    return turns if len(turns) >= len(combinations) else named


def datum_sentence(null_motions: np.ndarray, block: Block, named: list[str], sigma: float = np.inf) -> str:
    """Return a message: undetermined motions, available observations, cure; `sigma` if only noise determines them (rad,
    or relative).
    """
    names = motion_names(null_motions)
    counts = {rows.group: int(np.size(rows.observation)) for rows in block.observations if len(rows)}
    if n := counts.pop(ControlCoordinates.group, 0) + len(block.fixed.who):
        counts[ControlCoordinates.group] = n
    what = {"control_points": "control coordinates", "stations": "station coordinates", "attitudes": "attitude angles"}
    what |= {"surfaces": "points on surfaces"}
    order = ["control_points", *(name for name in counts if name != "control_points")]
    named_counts = [(counts[name], what.get(name, name.replace("_", " "))) for name in order if name in counts]
    observed = [f"{n} {noun[:-1] if n == 1 else noun}" for n, noun in named_counts]
    cures = "add control points or camera stations"
    if names == ["scale"]:
        cures += ", or a distance"
    if not np.isfinite(sigma):
        cures += ', or set [datum] kind = "inner" (or "minimal") in block.toml'
    elif any("rotation" in name for name in names):
        cures = "add control points or camera stations off the line of the existing ones"
    if named:
        cures = "add control points, or fix " + ", ".join(named[:3]) + (" ..." if len(named) > 3 else "")
    from_what = " and ".join(observed) if observed else "image coordinates alone"
    if np.isfinite(sigma):
        known = f"{100 * sigma:.2g} %" if names == ["scale"] else f"{np.degrees(sigma):.2g} deg"
        return (
            f"the datum of the block is nearly undetermined: {', '.join(names)} cannot be determined from {from_what} "
            f"better than to {known} (noise level); {cures}"
        )
    return (
        f"the datum of the block has a defect of {len(null_motions)}: {', '.join(names)} cannot be determined from "
        f"{from_what}; {cures}"
    )
