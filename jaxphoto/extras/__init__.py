"""Optional parts: photographs (extra `photos`) and formats of other programs."""
