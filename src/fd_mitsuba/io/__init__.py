"""Files and names, with nothing in it that knows of 3D editing."""
