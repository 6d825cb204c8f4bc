"""Recipes of simulations (TOML) and what a simulation leaves beside its block (docs/simulation.md)."""

from jaxphoto.io.recipe.reader import read_recipe, recipe_from
from jaxphoto.io.recipe.truth import write_simulation

__all__ = ["read_recipe", "recipe_from", "write_simulation"]
