"""Several vehicles throw one load: an optional room on the blocks of :mod:`sim`."""
