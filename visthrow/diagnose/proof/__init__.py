"""Proof of a diagnosis: hide an effect in the reference plant, find it, train with it, fly again."""
