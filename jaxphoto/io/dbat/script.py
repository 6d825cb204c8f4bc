"""A DBAT script: XML elements by place, with messages that name the file."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.text_tables import finite
from jaxphoto.io.whole_text import SMALL, read_whole


class Script(NamedTuple):
    """A script; places are paths of tags from its root, like input/cameras."""

    path: Path
    root: ET.Element

    @property
    def input(self) -> ET.Element:
        """The section <input>."""
        return self.find("input")

    def error(self, message: str) -> InputError:
        """An error about the script."""
        return InputError(f"{self.path.name}: {message}")

    def find(self, place: str) -> ET.Element:
        """An element. Raises InputError where it is missing."""
        element = self.root.find(place)
        if element is None:
            raise self.error(f"there is no <{place.replace('/', '><')}>; add it")
        return element

    def text(self, place: str, default: str) -> str:
        """The text of an element, `default` where it is missing or empty."""
        return (self.root.findtext(place) or default).strip()

    def numbers(self, place: str, default: str, n: int | None = None) -> list[float]:
        """The comma-separated numbers of an element, `n` of them if that is given."""
        text = self.text(place, default)
        values = [finite(part) for part in text.split(",")]
        known = [value for value in values if value is not None]
        if len(known) < len(values) or n not in (None, len(values)):
            many = f"{n} numbers" if n else "numbers"
            raise self.error(f"<{place.split('/')[-1]}> is {quoted(text)}; give {many} separated by commas")
        return known

    def file(self, element: ET.Element) -> Path:
        """The file an element names, by the base folder of <input>."""
        base = self.input.get("base_dir", "$HERE").replace("$HERE", str(self.path.parent))
        base = base.replace("$HOME", str(Path.home()))
        named = Path((element.text or "").strip())
        if "$" in base or "$" in str(named):
            raise self.error(f"the folder of {named} ({base}) is not known here; write it with $HERE")
        return Path(base) / named


def open_script(path: Path) -> Script:
    """The script in a file. Raises InputError with the line of a syntax error."""
    content = read_whole(path, SMALL)
    try:
        return Script(path, ET.fromstring(content))
    # An encoding that is unknown, or that the parser does not read, has errors of its own.
    except (ET.ParseError, LookupError, ValueError) as error:
        raise InputError(f"{path.name}: {error}; correct the XML there") from None


def include_cameras(script: Script) -> None:
    """Put the cameras of the files that <cameras> names in place of these."""
    cameras = script.find("input/cameras")
    for element in cameras.findall("file"):
        path = script.file(element)
        found = open_script(path).root.findall("cameras/camera")
        if not found:
            raise script.error(f"{path.name} has no <cameras><camera>; name a camera file of DBAT")
        cameras.remove(element)
        cameras.extend(found)


def setting(script: Script, operation: str, key: str) -> str:
    """What an operation says of `key` as a whole: its text or its <all>."""
    element = script.root.find(f"operations/operation/{operation}/{key}")
    if element is None:
        return "default"
    return (element.findtext("all") or element.text or "").strip()
