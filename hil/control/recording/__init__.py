"""Recordings of a run: what is written while it flies, and what is made of it afterwards."""
