"""Rooms that the core does not need: other programs' formats."""
