"""Adjusted photographs -> bundle.out of Bundler, with list.txt, as `jaxphoto.io.reconstructions.bundler` reads it.

Its cameras are f, k1 and k2, one a photograph, with the principal point in the middle: image points are those of
`same_rays`, in pixels from the principal point, x right and y up.
Source: N. Snavely, Bundler v0.4 User's Manual, "Output format".
"""

from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, translations
from jaxphoto.io.exports.same_rays import from_principal_point, radial_values
from jaxphoto.io.reconstructions.bundler import HEAD

FILE, LIST = "bundle.out", "list.txt"


def write_bundler(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write bundle.out and list.txt into `folder`; points are counted as the block has them, without those that no
    photograph shows.

    Raises InputError for a name with a blank, which list.txt cannot hold.
    """
    p = photographs
    for file in p.files:
        if len(file.split()) != 1:
            raise InputError(f"{LIST} ends names at blanks, and {quoted(file)} has one; rename the photograph")
    turns, values = np.asarray(p.exterior.camera_from_object), radial_values(p)
    moved = translations(turns, p.exterior)
    shown = [rows for rows in p.rows_of_points if len(rows)]
    lines = [HEAD, f"{len(p.images)} {len(shown)}"]
    for own, turn, shift in zip(values.tolist(), turns.tolist(), moved.tolist(), strict=True):
        lines += [_words(own), *map(_words, turn), _words(shift)]
    xy, image = from_principal_point(p).tolist(), p.image.tolist()
    key, xyz = p.place_in_image.tolist(), p.xyz.tolist()
    for rows in shown:
        seen = " ".join(f"{image[k]} {key[k]} {_words(xy[k])}" for k in rows.tolist())
        lines += [_words(xyz[p.point[rows[0]]]), "0 0 0", f"{len(rows)} {seen}"]
    (folder / FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    listed = "".join(f"{file} 0 {own[0]!r}\n" for file, own in zip(p.files, values.tolist(), strict=True))
    (folder / LIST).write_text(listed, encoding="utf-8")


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
