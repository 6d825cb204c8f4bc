"""How it is solved: sums over tiles, the reduced normal matrix and its factor, Levenberg-Marquardt, the inverse."""
