"""Orientation of images without approximate values: resection, intersection, whole blocks."""
