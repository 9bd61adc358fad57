"""Measurements of a user's own machine, and the records of those that were made before."""
