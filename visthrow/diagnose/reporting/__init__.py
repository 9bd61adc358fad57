"""Reporting of a diagnosis: gain on held-out flights, page, pictures, recording."""
