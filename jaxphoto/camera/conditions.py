"""Conditions of a photograph, as recorded in its file, for the calibration certificate."""

from typing import NamedTuple


class Conditions(NamedTuple):
    """Conditions of one photograph; "" or None if its file does not record them."""

    image: str
    file: str
    """File name without folders."""
    sha256: str
    used: bool = True
    """True if the photograph is an image of the block."""
    time: str = ""
    """Time of the camera's clock, such as 2016-10-11 10:23:45.50+02:00; UTC offset only if the file has one."""
    make: str = ""
    model: str = ""
    serial: str = ""
    """Serial number of the camera body."""
    lens: str = ""
    lens_serial: str = ""
    drone: str = ""
    """Model and serial number of the drone."""
    firmware: str = ""
    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    subject_distance_m: float | None = None
    """Focus distance (m)."""
    temperature_c: float | None = None
    """Air temperature (degrees Celsius)."""
    lens_temperature_c: float | None = None
    sensor_temperature_c: float | None = None
    humidity_percent: float | None = None
    pressure_hpa: float | None = None

    @property
    def camera(self) -> str:
        """Return make and model. Some model names already contain the make."""
        name = next(iter(self.make.split()), "")
        told = self.model.lower().startswith(name.lower())
        return self.model if told else f"{self.make} {self.model}".strip()


TEXTS = ("time", "make", "model", "serial", "lens", "lens_serial", "drone", "firmware")
NUMBERS = (
    "focal_length_mm", "f_number", "exposure_s", "iso", "subject_distance_m", "temperature_c",
    "lens_temperature_c", "sensor_temperature_c", "humidity_percent", "pressure_hpa",
)  # fmt: skip
