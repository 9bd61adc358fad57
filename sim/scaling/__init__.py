"""Conversion of a plant to other units, and random vehicles of one class at any size."""
