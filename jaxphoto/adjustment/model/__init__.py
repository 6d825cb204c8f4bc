"""What is adjusted: unknowns, observations by group, the residual of a row, and how they are numbered."""
