"""images.csv -> the images, their cameras, strips and times, and what is known of their orientation."""

import warnings
from typing import NamedTuple

import equinox as eqx
import numpy as np
import pandas as pd

from jaxphoto.camera import RATES
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.io.block_folder.settings import Settings
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.block_folder.temperatures import celsius_in
from jaxphoto.io.text_tables import Table
from jaxphoto.unknowns import FIXED, Unknowns

_from_angles = eqx.filter_jit(ExteriorOrientation.from_angles)


class Images(NamedTuple):
    """One entry per image, in the order of the file; `time_known` where the file has a time."""

    table: Table
    ids: tuple[str, ...]
    cameras: tuple[str, ...]
    strips: tuple[str, ...]
    times: np.ndarray
    """Seconds from the mean of the image's strip."""
    flight_times: np.ndarray
    """Seconds from the mean of all images."""
    middle_s: float
    """The mean of all images in the time of the file (s), to a nanosecond."""
    time_known: np.ndarray
    temperatures: np.ndarray
    """Degrees Celsius, NaN where not known."""
    exterior: ExteriorOrientation
    known: np.ndarray

    def find(self, table: Table, column: str = "image") -> np.ndarray:
        """The index of the image each line of `table` names. Raises BlockError for one that is not listed."""
        named = table.ids(column)
        index = pd.Index(self.ids).get_indexer(pd.Index(named))
        for line in np.flatnonzero(index < 0):
            raise table.misfit(
                line, f"image {named[line]} is not in {self.table.file}; add it there or delete this row"
            )
        return index

    @property
    def strips_are_the_flight(self) -> bool:
        """Whether the times of all strips have one mean, to a nanosecond: one strip, or a file that centred them."""
        return bool(np.allclose(self.flight_times, self.times, rtol=0.0, atol=1e-9))


def read_images(table: Table, settings: Settings) -> Images:
    """The images. Raises InputError or BlockError for duplicates, cameras without a section and impossible angles."""
    ids = table.ids("image")
    if not len(ids):
        raise BlockError(f"{table.file}: there are no images; list at least two")
    refuse_duplicates(table, {"image": ids}, "image {image} is listed twice")
    cameras = table.ids("camera")
    for number, camera in enumerate(cameras):
        if camera not in settings.cameras:
            known = ", ".join(settings.cameras)
            raise table.misfit(
                number,
                f"camera {camera} has no table [cameras.{camera}] in {settings.file}; add it or use one of {known}",
            )
    strips = table.names("strip")
    for i in np.flatnonzero(strips == "default"):
        raise table.bad(i, f"the strip name default means every strip in {settings.file}; give it another name")
    times = table.numbers("time_s", empty=True)
    exterior, oriented = _exterior(table)
    return Images(
        table,
        tuple(ids),
        tuple(cameras),
        tuple(strips),
        _centred(times, strips),
        _centred(times, np.zeros(len(times))),
        round(float(times[~np.isnan(times)].mean()), 9) if not np.isnan(times).all() else 0.0,
        ~np.isnan(times),
        celsius_in(table),
        exterior,
        oriented,
    )


def check_times(images: Images, strips: dict, priors: dict) -> None:
    """Raise BlockError where a drift needs a time that is missing."""
    for i, strip in enumerate(images.strips):
        if strip in strips and not images.time_known[i]:
            drifts = priors[strip].drift != FIXED or np.any(np.asarray(strips[strip].drift) != 0)
            if drifts:
                raise images.table.misfit(
                    i,
                    f"image {images.ids[i]} has no time_s, but its strip {strip} drifts; add the time, or make the "
                    'drift "fixed"',
                )


def check_rates(images: Images, starts: Unknowns, priors: Unknowns) -> None:
    """Raise BlockError where a camera that changes during the flight needs a time or a temperature that is missing."""
    columns = {
        "time_h": ("time_s", images.time_known),
        "temperature_K": ("temperature_c", ~np.isnan(images.temperatures)),
    }
    for rates in RATES:
        column, known = columns[rates.along]
        changing = {
            name: any(prior != FIXED for prior in vars(priors.more[rates.kind][name]).values())
            or any(np.any(np.asarray(rate) != 0) for rate in vars(start).values())
            for name, start in starts.more.get(rates.kind, {}).items()
        }
        what = column.partition("_")[0]
        for i in np.flatnonzero(~known):
            if changing.get(camera := images.cameras[i]):
                raise images.table.misfit(
                    int(i),
                    f"image {images.ids[i]} has no {column}, but its camera {camera} changes during the flight "
                    f'([unknowns.{rates.kind}]); add the {what}, or make its rates "fixed"',
                )


def refuse_duplicates(table: Table, keys: dict[str, np.ndarray], message: str) -> None:
    """Raise InputError where two lines agree in all `keys`; `message` is filled with them."""
    frame = pd.DataFrame(keys)
    for line in np.flatnonzero(frame.duplicated()):
        same = np.flatnonzero((frame == frame.iloc[line]).all(axis=1))
        names = {name: values[line] for name, values in keys.items()}
        raise table.bad(line, f"{message.format(**names)}, first in {table.place(same[0])}; delete one of the rows")


def _centred(times: np.ndarray, strips: np.ndarray) -> np.ndarray:
    """Seconds from the mean time of the image's strip, zero where there is no time."""
    seconds = pd.Series(times)
    return (seconds - seconds.groupby(strips).transform("mean")).fillna(0.0).to_numpy()


def _exterior(table: Table) -> tuple[ExteriorOrientation, np.ndarray]:
    values = np.stack([table.numbers(name, empty=True) for name in (*XYZ, *ANGLES)], axis=1)
    known = ~np.isnan(values).any(axis=1)
    partly = np.flatnonzero(~known & ~np.isnan(values).all(axis=1))
    if len(partly):
        warnings.warn(
            f"{table.place(partly[0])}: the approximate orientation of {len(partly)} image(s) is incomplete and is not "
            "used; give all six values or none",
            UserWarning,
            stacklevel=2,
        )
    values[~known] = 0.0
    check_angles(table, values[:, 3:], ANGLES)
    return call_compiled(_from_angles, values[:, :3], np.deg2rad(values[:, 3:])), known


def check_angles(table: Table, degrees: np.ndarray, columns: tuple[str, ...]) -> None:
    """Raise InputError for an angle beyond one turn: it is in another unit than degrees."""
    for line, axis in np.argwhere(np.abs(degrees) > 360):
        raise table.bad(
            line, f"{columns[axis]} = {degrees[line, axis]:g} is more than a turn; give the angle in degrees"
        )
