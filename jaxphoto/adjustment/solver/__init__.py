"""How it is solved: sums over rays, the reduced normal matrix and its factor, Levenberg-Marquardt, the inverse."""
