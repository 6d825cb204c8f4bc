"""How a block lies in memory: points in tiles with the images that see them, padded sizes, several devices."""
