"""G-code as files: their names, and what a slicer wrote into them."""
