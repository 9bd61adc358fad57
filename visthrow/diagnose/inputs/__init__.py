"""Inputs of a diagnosis: setup, logs, and measurements on the ground."""
