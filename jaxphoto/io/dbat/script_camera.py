"""The camera of a DBAT script, and which of its parameters the script estimates.

DBAT counts pixels from (1, 1) at the centre of the upper left one, we from (0.5, 0.5); its principal point is in mm
from pixel (0, 0); it *adds* K, P and the aspect `as` to the measured coordinate where our Brown model subtracts,
so all of them change sign. Its model 3 applies 1 + as and the skew before the polynomial: `affine_brown` with b1 = -as;
<aspect> is 1 - as. Models 1 and 2 have neither aspect nor skew. Model 4 applies both after it, `brown_affine`. Model 5
applies 1 + as before the principal point is taken off, which divides px by it, and the skew after the polynomial:
`stretched_brown`.
"""

from typing import Any

from jaxphoto.errors import quoted
from jaxphoto.io.dbat.script import Script, setting
from jaxphoto.io.text_tables import finite

# Lens models of DBAT by what they are here, up to sign ("Backward (Photogrammetry)").
_MODELS = {
    "1": "affine_brown", "2": "affine_brown", "3": "affine_brown", "4": "brown_affine", "5": "stretched_brown"
}  # fmt: skip
_WITHOUT_AFFINITY = ("1", "2")


def camera_settings(script: Script) -> dict[str, Any]:
    """The [cameras.X] table of the one camera."""
    if len(script.find("input/cameras").findall("camera")) != 1:
        raise script.error("there is not exactly one <camera>; this reader takes one, so convert the project by hand")
    c = "input/cameras/camera"
    if (unit := script.text(f"{c}/unit", "mm")) != "mm":
        raise script.error(f"the camera's unit is {unit!r}; give the camera in mm")
    if (model := script.text(f"{c}/model", "3")) not in _MODELS:
        raise script.error(f"lens model {model} has no equal here; use one of {', '.join(_MODELS)}")
    width, height = (int(n) for n in script.numbers(f"{c}/image", "", 2))
    if min(width, height) < 1:
        raise script.error(f"<image> is {width} x {height} pixels; give the format of the camera")
    pixel = _pixel_mm(script, f"{c}/sensor", width, height)
    interior = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1"), 0.0)
    interior["c_mm"] = script.numbers(f"{c}/focal", "0")[0]
    if setting(script, "set_initial_values", "io") != "default":
        interior["c_mm"] = script.numbers(f"{c}/cc", "0")[0] or interior["c_mm"]
        px, py = script.numbers(f"{c}/pp", "0,0", 2)
        if (px, py) != (0, 0):
            # Their pixel (1, 1) is our (0.5, 0.5): the image centre lies at (width / 2 + 0.5) pixels.
            interior["xp_mm"] = px - pixel * (width / 2 + 0.5)
            interior["yp_mm"] = -(py - pixel * (height / 2 + 0.5))
        interior |= _coefficients(script, f"{c}/K", "k", 3) | _coefficients(script, f"{c}/P", "p", 2)
        interior["b1"] = script.numbers(f"{c}/aspect", "1")[0] - 1.0
        if script.numbers(f"{c}/skew", "0")[0] != 0:
            raise script.error("a <skew> other than 0 cannot be read; set it to 0")
    unknowns = _free(script, c)
    if model in _WITHOUT_AFFINITY:
        if interior["b1"] != 0 or {"b1", "b2"} & set(unknowns):
            raise script.error(f"lens model {model} has neither aspect nor skew; set aspect to 1 and estimate none")
    elif model == "5" and interior["xp_mm"] != 0:
        middle = pixel * (width / 2 + 0.5)
        interior["xp_mm"] = (interior["xp_mm"] + middle) / (1.0 - interior["b1"]) - middle
    return {
        "width_px": width, "height_px": height, "pixel_mm": pixel, "distortion": _MODELS[model],
        "interior": interior, "unknowns": unknowns,
    }  # fmt: skip


def _pixel_mm(script: Script, place: str, width: int, height: int) -> float:
    text = script.text(place, "")
    parts = [part.strip() for part in text.split(",")]
    given = [(finite(part), n) for part, n in zip(parts, (width, height), strict=False) if part != "auto"]
    sizes = [length / n for length, n in given if length is not None and length > 0]
    if len(parts) != 2 or not sizes or len(sizes) < len(given):
        raise script.error(f"<sensor> is {quoted(text)}; give width,height in mm, one of which may be auto")
    if abs(sizes[0] - sizes[-1]) > 1e-6 * sizes[0]:
        raise script.error(f"the pixels of {sizes[0]:g} x {sizes[-1]:g} mm are not square; give the aspect instead")
    return sizes[-1]


def _coefficients(script: Script, place: str, letter: str, most: int) -> dict[str, float]:
    values = script.numbers(place, "0")
    if any(value != 0 for value in values[most:]):
        raise script.error(f"<{letter.upper()}> has more than {most} coefficients; remove the others")
    return {f"{letter}{i}": 0.0 - value for i, value in enumerate(values[:most], start=1)}


def _free(script: Script, camera: str) -> dict[str, str]:
    """Which interior parameters the script asks to estimate."""
    n_k, n_p = (int(script.numbers(f"{camera}/{name}", default)[0]) for name, default in (("nK", "3"), ("nP", "2")))
    if n_k > 3 or n_p > 2:
        raise script.error(f"nK = {n_k}, nP = {n_p} are more coefficients than Brown's model has; use at most 3 and 2")
    ks, ps = tuple(f"k{i + 1}" for i in range(n_k)), tuple(f"p{i + 1}" for i in range(n_p))
    groups: dict[str, tuple[str, ...]] = {
        "cc": ("c_mm",), "pp": ("xp_mm", "yp_mm"), "px": ("xp_mm",), "py": ("yp_mm",), "K": ks, "P": ps,
        "aspect": ("b1",), "as": ("b1",), "skew": ("b2",), "sk": ("b2",),
    }  # fmt: skip
    groups |= {name.upper(): (name,) for name in (*ks, *ps)}
    for key in ("eo", "op"):
        if (asked := setting(script, "set_bundle_estimate_params", key)) not in ("true", "default"):
            raise script.error(f"<{key}> {asked!r} in <set_bundle_estimate_params> cannot be read; set it to true")
    every = setting(script, "set_bundle_estimate_params", "io") == "true"
    free = {name for names in groups.values() for name in names} if every else set()
    for element in script.root.findall("operations/operation/set_bundle_estimate_params/io/*"):
        if element.tag in ("c", "all"):
            continue
        if element.tag not in groups:
            raise script.error(f"<{element.tag}> in <io> is unknown; use all, {', '.join(groups)}")
        asked = (element.text or "").strip()
        if asked not in ("true", "false"):
            raise script.error(f"<{element.tag}> in <io> is {asked!r}; write true or false")
        free = free | set(groups[element.tag]) if asked == "true" else free - set(groups[element.tag])
    return dict.fromkeys(sorted(free), "free")
