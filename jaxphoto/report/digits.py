"""Numbers with as many digits as their standard deviations have a use for."""

import math


def with_sigma(value: float, sigma: float) -> str:
    """A number to the second digit of its standard deviation."""
    if not sigma > 0 or not value or not math.isfinite(value):
        return f"{value:.8g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(sigma)) + 2
    return f"{value:#.{min(max(digits, 2), 12)}g}".rstrip(".")


def of_sigma(sigma: float) -> str:
    """A standard deviation in two digits."""
    return f"{sigma:#.2g}".rstrip(".") if sigma > 0 else ""
