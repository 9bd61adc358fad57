"""Planning of flights: which manoeuvre, or which excitation that is optimised for it, separates
what could not be separated.
"""
