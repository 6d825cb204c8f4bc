"""The errors a user can cause, each one sentence that names the place and the mend.

Every message says what was found, where (file, row, id or unknown), and what to do. A failed solve is
not an error: it is an outcome of the result (see `jaxphoto.adjustment.result.Outcome`).
"""


class JaxphotoError(ValueError):
    """Anything a user can mend; the command line prints it as one sentence and ends with exit code 2."""


class InputError(JaxphotoError):
    """A file, a row or a number that cannot be read as what it claims to be."""


class BlockError(JaxphotoError):
    """Observations that cannot make an adjustment: unknown ids, too few rays, points behind the camera."""


class DatumError(JaxphotoError):
    """A block whose observations leave its position, orientation or scale undetermined."""


class RankError(JaxphotoError):
    """Unknowns that the observations cannot tell apart, although the datum is determined."""
