"""Planning of flights: manoeuvres and optimised excitation that separate effects which the flights
so far do not.
"""
