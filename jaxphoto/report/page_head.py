"""What every page begins with: how it looks, and what makes its tables and figures answer, inside the file."""

from pathlib import Path

from markupsafe import Markup

from jaxphoto.report.style import STYLE

_HEAD = (
    '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
    '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
    '<title>{}</title><style>{}</style><script type="module">\n{}</script></head>'
)
_SCRIPT = Path(__file__).with_name("interactive.js")


def page_head(title: str, style: str = "") -> Markup:
    """From the first line of a page to its body, with rules of its own below those of all pages.

    The script is a module, which browsers run when they have read the page.
    """
    script = _SCRIPT.read_text(encoding="utf-8")
    return Markup(_HEAD).format(title, Markup(f"{STYLE}{style}"), Markup(script))
