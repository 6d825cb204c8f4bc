"""Optional parts, each with an extra of its own: `pip install 'jaxphoto[photos]'`."""
