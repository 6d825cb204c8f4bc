"""Optional subpackages: photographs (extra `photos`) and file formats of other programs."""
