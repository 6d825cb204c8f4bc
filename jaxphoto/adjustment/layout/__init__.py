"""Memory layout of a block: rays in chunks, padded sizes, sharding."""
