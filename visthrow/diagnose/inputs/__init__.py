"""Inputs of a diagnosis: its setup, the logs, what was measured besides."""
