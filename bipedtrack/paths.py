"""Where the data that travel with the package lie."""

from pathlib import Path
from typing import Literal

from bipedtrack.messages import Refusal


class MissingDataError(Refusal, FileNotFoundError):
    """A folder that should have been installed."""


def data_dir(name: Literal["models", "curricula"]) -> Path:
    """The folder of that name: inside the package when installed, beside the package in a checkout.

    Raises:
        MissingDataError: the folder is in neither place; the message names both.
    """
    package = Path(__file__).resolve().parent
    places = (package / name, package.parent / name)
    for place in places:
        if place.is_dir():
            return place
    raise MissingDataError(
        f"no folder {name!r} in {places[0].parent} or {places[1].parent}: the installation is incomplete, "
        "install bipedtrack again"
    )
