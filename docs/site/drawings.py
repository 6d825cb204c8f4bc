"""The drawings of docs/conventions.md: `python docs/site/drawings.py` writes docs/images/*.svg.

Every direction that is drawn comes out of the function whose convention it shows.
"""

from pathlib import Path

import jax
import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Rectangle

from jaxphoto.camera import Brown, InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Exposure, Mount, StripBias, direct_orientation
from jaxphoto.rotation import (
    matrix_from_omega_phi_kappa,
    matrix_from_roll_pitch_yaw,
    omega_phi_kappa_from_matrix,
)

IMAGES = Path(__file__).resolve().parents[1] / "images"
# Okabe and Ito (2008): told apart by the colour-blind, too.
X, Y, Z, ARM, RAY, FAINT = "#D55E00", "#009E73", "#0072B2", "#CC79A7", "#E69F00", "#9a9a9a"
# Of an axonometric view from the south-west and above: where a metre east, north and up lies on the paper.
VIEW = np.array([[0.87, 0.5, 0.0], [-0.25, 0.42, 0.95]])
_TURN_DEG = 25.0
HEADINGS = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0}


def main() -> None:
    """Write all drawings."""
    plt.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "jaxphoto", "font.size": 10, "font.family": "sans-serif"}
    IMAGES.mkdir(exist_ok=True)
    for draw in (frames, camera_angles, body_angles, headings, image_coordinates, boresight):
        figure = draw()
        # A picture each: beside one another where the page is wide, below one another on a telephone.
        for panel in figure.axes:
            for other in figure.axes:
                other.set_visible(other is panel)
            name = IMAGES / f"{'_'.join(filter(None, (draw.__name__, panel.get_label())))}.svg"
            figure.savefig(name, metadata={"Date": None}, bbox_inches="tight", pad_inches=0.05, facecolor="white")
        plt.close(figure)


def frames() -> plt.Figure:
    """Object, body and camera frame, lever arm, and a ray."""
    figure, axes = _paper(7.2, 5.2)
    for k in np.linspace(0, 6, 7):
        _line(axes, [[k, 0, 0], [k, 6, 0]], color=FAINT, lw=0.5)
        _line(axes, [[0, k, 0], [6, k, 0]], color=FAINT, lw=0.5)
    _axes(axes, np.zeros(3), np.eye(3) * 1.6, ("X east", "Y north", "Z up"))
    body = np.asarray(matrix_from_roll_pitch_yaw(np.deg2rad([0.0, 0.0, 30.0])))
    camera, arm = np.array([3.2, 3.0, 3.4]), np.array([0.9, 1.5, 2.4])
    antenna = camera + body @ arm
    # Nose, right wing, behind it, tail, left of it, left wing.
    corners = [[0, 2.2, 0], [2.6, 0, 0], [0.35, 0, 0], [0, -2.2, 0], [-0.35, 0, 0], [-2.6, 0, 0]]
    wing = antenna + np.array(corners, float) @ body.T
    outline = wing[[0, 2, 1, 2, 3, 4, 5, 4, 0]]
    axes.fill(*(VIEW @ outline.T), color="#e8eef3", ec="#5b6b78", lw=1)
    _axes(axes, antenna, body * 1.9, ("right", "forward", "up"), dashed=True)
    given = _oriented(Mount(arm, np.zeros(3)), antenna, np.deg2rad([0.0, 0.0, 30.0]))
    rows = np.asarray(given.camera_from_object)
    place = np.asarray(given.position)
    assert np.allclose(place, camera)
    _axes(axes, place, rows.T * 1.1, ("x", "y", "z"))
    _arrow(axes, place, antenna, ARM, "", (0, 0))
    axes.annotate(
        "lever arm (right, forward, up):\nfrom the projection centre\nto the antenna",
        VIEW @ (place + antenna) / 2, xytext=(-190, -6), textcoords="offset points", color=ARM,
        arrowprops={"arrowstyle": "-", "color": ARM, "lw": 0.7},
    )  # fmt: skip
    corners = place + (np.array([[-0.5, -0.4, -0.6], [0.5, -0.4, -0.6], [0.5, 0.4, -0.6], [-0.5, 0.4, -0.6]]) @ rows)
    axes.fill(*(VIEW @ corners.T), color=RAY, alpha=0.25, ec=RAY)
    point = np.array([4.6, 2.2, 0.0])
    _line(axes, [place, point], color=RAY, lw=1.5)
    axes.plot(*(VIEW @ point), "o", color=RAY, ms=5)
    axes.annotate("object point", VIEW @ point, xytext=(8, -10), textcoords="offset points")
    axes.annotate(
        "image (drawn in front:\nwhat is seen has z < 0)",
        VIEW @ corners[1],
        xytext=(14, -8),
        textcoords="offset points",
    )
    return figure


def camera_angles() -> plt.Figure:
    """omega, phi and kappa, each alone and positive."""
    views = (
        ("omega > 0\nseen from the end of X (east)", 0, 1, 2),
        ("phi > 0\nseen from the end of -Y (south)", 1, 0, 2),
        ("kappa > 0\nseen from above", 2, 0, 1),
    )
    return _panels(views, matrix_from_omega_phi_kappa, ("x", "y", "z"), ("X", "Y", "Z"))


def body_angles() -> plt.Figure:
    """roll, pitch and yaw, each alone and positive; object frame with north ahead."""
    views = (
        ("roll > 0: right wing down\nseen from behind", 0, 0, 2),
        ("pitch > 0: nose up\nseen from the right", 1, 1, 2),
        ("yaw > 0: clockwise from north\nseen from above", 2, 0, 1),
    )
    rows = lambda angles: matrix_from_roll_pitch_yaw(angles).T  # noqa: E731
    return _panels(views, rows, ("right", "forward", "up"), ("X east", "Y north", "Z up"))


def headings() -> plt.Figure:
    """Draw an aircraft from above on four headings: roll and pitch as parts of omega and phi."""
    figure, panels = plt.subplots(1, 4, figsize=(6.9, 2.7))
    # Nose, wing and tailplane to the right, tail.
    half = [(0, 1), (0.1, 0.75), (0.1, 0.3), (0.9, 0), (0.9, -0.15), (0.1, -0.05), (0.06, -0.6), (0.35, -0.8)]
    outline = np.array([*half, (0.35, -0.9), (0, -0.8)])
    outline = np.vstack([outline, outline[::-1] * [-1, 1]])
    for panel, (name, yaw) in zip(panels, HEADINGS.items(), strict=True):
        panel.set_label(name)
        level = attitude_of(0.0, 0.0, yaw)
        plan = np.asarray(matrix_from_roll_pitch_yaw(np.deg2rad([0.0, 0.0, yaw])))[:2, :2]
        panel.fill(*(plan @ outline.T), color="#e8eef3", ec="#5b6b78", lw=1)
        rows = np.asarray(matrix_from_omega_phi_kappa(np.deg2rad(level)))
        _arrow2(panel, (0, 0), 1.15 * rows[0, :2], X, "", (0, 0))
        _arrow2(panel, (0, 0), 0.8 * rows[1, :2], Y, "", (0, 0))
        for row, letter, colour, reach in ((rows[0], "x", X, 1.35), (rows[1], "y", Y, 1.0)):
            panel.text(*(reach * row[:2]), letter, color=colour, ha="center", va="center", weight="bold")
        said = [f"kappa = {level[2]:.0f}"]
        for turn, angles in (("roll", attitude_of(1.0, 0.0, yaw)), ("pitch", attitude_of(0.0, 1.0, yaw))):
            change = angles - level
            k = int(np.argmax(np.abs(change[:2])))
            said.append(f"{turn} +1 is {('omega', 'phi')[k]} {change[k]:+.0f}")
        panel.set_title(f"to the {name}, yaw {yaw:.0f}", fontsize=10)
        panel.text(0, -1.6, "\n".join(said), ha="center", va="top")
        panel.set(xlim=(-1.6, 1.6), ylim=(-2.9, 1.5), aspect="equal")
        panel.axis("off")
    figure.tight_layout()
    return figure


def attitude_of(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    """omega, phi, kappa (degrees) of a camera with x forward in a body with these angles."""
    turned = _oriented(Mount(np.zeros(3), np.zeros(3)), roll_pitch_yaw=np.deg2rad([roll_deg, pitch_deg, yaw_deg]))
    return np.rad2deg(np.asarray(omega_phi_kappa_from_matrix(turned.camera_from_object))) + 0.0


def image_coordinates() -> plt.Figure:
    """Pixels and millimetres, the principal point; the section with c; a barrel."""
    figure, (image, section, barrel) = plt.subplots(1, 3, figsize=(8.4, 3.0))
    for panel, name in ((image, "format"), (section, "section"), (barrel, "barrel")):
        panel.set_label(name)
    sensor = Sensor(8, 6, 1.0)
    image.add_patch(Rectangle((-4, -3), 8, 6, fill=False, ec="#5b6b78"))
    for k in range(1, 8):
        image.plot([k - 4, k - 4], [-3, 3], color=FAINT, lw=0.4)
    for k in range(1, 6):
        image.plot([-4, 4], [k - 3, k - 3], color=FAINT, lw=0.4)
    first = np.asarray(sensor.mm_from_px(np.array([[0.5, 0.5]])))[0]
    image.plot(*first, "s", color=Z, ms=4)
    image.annotate("first\n(0.5, 0.5)", first, xytext=(2, -26), textcoords="offset points", color=Z)
    _arrow2(image, (-4, 3), (-1.6, 3), Z, "column_px", (-4, 5))
    _arrow2(image, (-4, 3), (-4, 0.8), Z, "row_px", (-40, -4))
    _arrow2(image, (0, 0), (3, 0), X, "x (mm)", (-12, 5))
    _arrow2(image, (0, 0), (0, 2.4), Y, "y (mm)", (5, -2))
    image.plot(0.7, -0.8, "+", color="black", ms=10)
    image.annotate("principal point\n(x_p, y_p)", (0.7, -0.8), xytext=(-24, -31), textcoords="offset points")
    image.set_title("image coordinates", pad=18)
    section.plot([-1.6, 1.6], [-2, -2], color="#5b6b78", lw=2)
    section.plot(0, 0, "ko")
    section.annotate("projection centre", (0, 0), xytext=(8, 6), textcoords="offset points")
    _arrow2(section, (0, 0), (0, -2), Z, "c", (-14, 20))
    section.plot([0, 2.1], [0, -3.5], color=RAY)
    section.plot(1.2, -2, "o", color=RAY)
    section.annotate("ideal image point", (1.2, -2), xytext=(8, 2), textcoords="offset points")
    section.annotate("image", (-1.6, -2), xytext=(0, -14), textcoords="offset points")
    _arrow2(section, (0, 0), (0, 1.4), FAINT, "z", (5, -4))
    section.set_xlim(-2.2, 3.6)
    section.set_ylim(-3.6, 1.9)
    section.set_title("principal distance")
    # Of Brown's model `closed_form` gives the ideal coordinate of a measured one.
    ideal = jax.jit(jax.vmap(InteriorOrientation(10.0, 0.0, 0.0, Brown(k1=-9e-3)).closed_form))
    for along in (0, 1):
        for k in np.linspace(-3, 3, 7):
            straight = np.stack([np.full(40, k), np.linspace(-3, 3, 40)], axis=1)[:, :: 1 if along else -1]
            seen = straight.copy()
            for _ in range(50):
                seen = straight + seen - np.asarray(ideal(seen))
            barrel.plot(*straight.T, color=FAINT, lw=0.6)
            barrel.plot(*seen.T, color=X, lw=1)
    barrel.set_title("K1 < 0 of Brown: a barrel")
    for panel in (image, section, barrel):
        panel.set_aspect("equal")
        panel.axis("off")
    figure.tight_layout()
    return figure


def boresight() -> plt.Figure:
    """Draw the three boresight angles, each positive; the camera's x axis forward, level flight to the north."""
    views = (
        ("b_x > 0\nseen from ahead, the end of x", 0, 1, 2),
        ("b_y > 0\nseen from the right", 1, 0, 2),
        ("b_z > 0\nseen from above", 2, 0, 1),
    )
    nominal = np.asarray(_oriented(Mount(np.zeros(3), np.zeros(3))).camera_from_object)
    rows = lambda angles: _oriented(Mount(np.zeros(3), angles)).camera_from_object @ nominal.T  # noqa: E731
    return _panels(views, rows, ("x", "y", "z"), ("nominal x", "nominal y", "nominal z"))


def _panels(views, rows_of, names, fixed) -> plt.Figure:
    """Yield a panel per angle, alone and positive: title, number, and the axes to the right and up."""
    figure, panels = plt.subplots(1, 3, figsize=(6.7, 2.6))
    for panel, (title, angle, right, up) in zip(panels, views, strict=True):
        panel.set_label(title.split()[0])
        angles = np.zeros(3)
        angles[angle] = np.deg2rad(_TURN_DEG)
        _turned(panel, np.asarray(rows_of(angles)), right, up, names, fixed, title)
    figure.tight_layout()
    return figure


def _oriented(mount: Mount, station=(0.0, 0.0, 0.0), roll_pitch_yaw=(0.0, 0.0, 0.0)) -> ExteriorOrientation:
    still = Exposure(np.array(0.0), np.zeros(3), np.zeros(3))
    bias = StripBias(np.zeros(3), np.zeros(3))
    return direct_orientation(np.array(station), np.array(roll_pitch_yaw), mount, bias, still)


def _turned(panel: Axes, rows: np.ndarray, right: int, up: int, names, fixed, title: str) -> None:
    """Two axes (rows) as they are turned, solid, and not, dashed; the arc goes from the one to the other."""
    colours = (X, Y, Z)
    for k in (right, up):
        still = np.eye(3)[k][[right, up]]
        moved = rows[k][[right, up]]
        panel.annotate("", still, (0, 0), arrowprops={"arrowstyle": "->", "color": FAINT, "ls": "--"})
        panel.annotate(
            fixed[k],
            still * 1.04,
            color=FAINT,
            ha="left" if k == right else "center",
            va="center" if k == right else "bottom",
        )
        panel.annotate("", moved, (0, 0), arrowprops={"arrowstyle": "-|>", "color": colours[k], "lw": 2})
        beside = "left" if moved[0] > 0.5 else "center"
        panel.annotate(names[k], moved * 1.08, color=colours[k], ha=beside, va="center", weight="bold")
        a, b = (np.rad2deg(np.arctan2(v[1], v[0])) for v in (still, moved))
        panel.add_patch(Arc((0, 0), 1.3, 1.3, theta1=min(a, b), theta2=max(a, b), color=colours[k]))
    panel.plot(0, 0, "ko", ms=3)
    panel.set(xlim=(-0.75, 1.55), ylim=(-0.55, 1.3), aspect="equal", title=title)
    panel.title.set_fontsize(10)
    panel.axis("off")


def _paper(width: float, height: float) -> tuple[plt.Figure, Axes]:
    figure, axes = plt.subplots(figsize=(width, height))
    axes.set_aspect("equal")
    axes.axis("off")
    return figure, axes


def _line(axes: Axes, points, **style) -> None:
    axes.plot(*(VIEW @ np.asarray(points, float).T), **style)


def _axes(axes: Axes, origin: np.ndarray, columns: np.ndarray, names, dashed: bool = False) -> None:
    for column, name, colour in zip(columns.T, names, (X, Y, Z), strict=True):
        _arrow(axes, origin, origin + column, colour, name, (3, 3), "--" if dashed else "-")


def _arrow(axes: Axes, start, end, colour: str, name: str, at, style: str = "-") -> None:
    _arrow2(axes, VIEW @ start, VIEW @ end, colour, name, at, style)


def _arrow2(axes: Axes, start, end, colour: str, name: str, at, style: str = "-") -> None:
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6, "ls": style, "shrinkA": 0, "shrinkB": 0},
    )
    axes.annotate(name, end, xytext=at, textcoords="offset points", color=colour)


if __name__ == "__main__":
    main()
