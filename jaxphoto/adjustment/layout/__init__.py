"""How a block lies in memory: rays in chunks of an image, padded sizes, several devices."""
