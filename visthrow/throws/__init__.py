"""Throws on either plant: one throw, many throws, and what is made of their results."""
