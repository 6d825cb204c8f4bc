"""What a photogrammetrist does with all this, as short scripts over the rooms below."""

from jaxphoto.procedures.adjust import adjust

__all__ = ["adjust"]
