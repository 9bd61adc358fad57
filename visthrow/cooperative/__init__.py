"""Cooperative throws of several vehicles with one load, an optional room that uses the blocks of
:mod:`sim`.
"""
