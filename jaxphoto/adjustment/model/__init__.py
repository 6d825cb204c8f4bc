"""Model of an adjustment: unknowns, observation groups, residuals of a row, indexing."""
