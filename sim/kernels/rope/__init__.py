"""Rope, payload and release: recursion of the chain, coupling to the vehicle, ballistic flight."""
