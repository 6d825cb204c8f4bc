"""Recipes of simulations (TOML), and files of simulated blocks (docs/simulation.md)."""

from jaxphoto.io.recipe.recipe_reader import read_recipe, recipe_from
from jaxphoto.io.recipe.truth import truth_tables, write_simulation

__all__ = ["read_recipe", "recipe_from", "truth_tables", "write_simulation"]
