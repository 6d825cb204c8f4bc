"""Observations with known truth."""

from jaxphoto.simulation.remeasure import image_coordinates, remeasure

__all__ = ["image_coordinates", "remeasure"]
