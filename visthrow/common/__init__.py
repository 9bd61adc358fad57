"""Modules for all other packages: arguments, errors, files, devices, statistics, provenance."""
