"""Rope, payload and release: the chain's recursion, its coupling to the vehicle, and the ballistic
flight.
"""
