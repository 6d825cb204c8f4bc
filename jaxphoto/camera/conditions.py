"""How a photograph was taken, as its file says: what a certificate of the camera has to state."""

from typing import NamedTuple


class Conditions(NamedTuple):
    """One photograph; "" and None stand for what its file does not say."""

    image: str
    file: str
    """Its name, without folders."""
    sha256: str
    used: bool = True
    """Whether it is an image of the block."""
    time: str = ""
    """As the camera's clock had it, such as 2016-10-11 10:23:45.50+02:00; the offset only where the file has one."""
    make: str = ""
    model: str = ""
    serial: str = ""
    """Of the body."""
    lens: str = ""
    lens_serial: str = ""
    drone: str = ""
    """Its model and serial number."""
    firmware: str = ""
    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    subject_distance_m: float | None = None
    """Where the lens was focused."""
    temperature_c: float | None = None
    """Of the air."""
    lens_temperature_c: float | None = None
    sensor_temperature_c: float | None = None
    humidity_percent: float | None = None
    pressure_hpa: float | None = None

    @property
    def camera(self) -> str:
        """Maker and model. Some makers write their name into the model again."""
        name = next(iter(self.make.split()), "")
        told = self.model.lower().startswith(name.lower())
        return self.model if told else f"{self.make} {self.model}".strip()


TEXTS = ("time", "make", "model", "serial", "lens", "lens_serial", "drone", "firmware")
NUMBERS = (
    "focal_length_mm", "f_number", "exposure_s", "iso", "subject_distance_m", "temperature_c",
    "lens_temperature_c", "sensor_temperature_c", "humidity_percent", "pressure_hpa",
)  # fmt: skip
