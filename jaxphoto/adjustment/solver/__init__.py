"""Solver: sums over rays, the factored reduced normal matrix, Levenberg-Marquardt, the inverse."""
