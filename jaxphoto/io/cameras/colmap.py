"""Cameras of COLMAP's cameras.txt: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...` a line.

COLMAP's centre of the upper left pixel is (0.5, 0.5), as ours. All its models without fish-eye are parts of OpenCV's.
"""

from pathlib import Path

from jaxphoto.camera import InteriorOrientation, OpenCv, Sensor
from jaxphoto.io.cameras.camera_file import CameraFile, Source, from_centre_px, in_pixels
from jaxphoto.io.tables import is_number

# fx alone stands for both focal lengths.
MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""The models that are known, simplest first, and the order of their parameters."""


def recognises(path: Path, text: str) -> bool:
    """Whether the first line that is no comment begins with an id and the name of a model."""
    first = next((line.split() for line in _lines(text)), [])
    return len(first) > 4 and first[1].isupper() and all(map(is_number, first[2:]))


def read_colmap(source: Source) -> CameraFile:
    """One camera of the file. Raises InputError for lines that are no camera and for models that are not known here."""
    lines = {}
    for line in _lines(source.text()):
        cells = line.split()
        lines[cells[0]] = cells
    name = source.chosen(list(lines))
    cells = lines[name]
    if len(cells) < 4:
        raise source.error(f"camera {name} has {len(cells)} cells; write CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    model = cells[1]
    if model not in MODELS:
        raise source.error(f"the model {model} of camera {name} is not known here; use one of {', '.join(MODELS)}")
    names = MODELS[model]
    if len(cells) != 4 + len(names):
        raise source.error(
            f"camera {name} has {len(cells) - 4} parameters, {model} has {len(names)}: {', '.join(names)}"
        )
    values = {key: source.number(f"{key} of camera {name}", cell) for key, cell in zip(names, cells[4:], strict=True)}
    sensor, assumed = source.sensor(*(source.number(f"the size of camera {name}", cell) for cell in cells[2:4]))
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    centre = values.pop("cx"), values.pop("cy")
    interior = in_pixels(source, sensor, fx, fy, centre, OpenCv, **values)
    return CameraFile(name, sensor, interior, None, assumed)


def write_colmap(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera with the distortion `OpenCv` and b2 = 0, as the simplest model that holds it."""
    fx, fy, column, row = from_centre_px(interior, sensor)
    d = interior.distortion
    values = {"fx": fx, "fy": fy, "cx": column, "cy": row}
    values |= {k: float(getattr(d, k)) for k in OpenCv.coefficients if k not in ("b1", "b2")}
    needed = {key for key, value in values.items() if value != 0 and key not in ("fx", "fy", "cx", "cy")}
    needed |= {"fx"} if fx != fy else set()
    model = next(m for m, names in MODELS.items() if needed <= set(names))
    cells = [repr(values["fy" if key == "f" else key]) for key in MODELS[model]]
    identifier = name if name.isdigit() else "1"
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    line = " ".join([identifier, model, str(sensor.width_px), str(sensor.height_px), *cells])
    path.write_text(head + line + "\n", encoding="utf-8")


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
