"""Fly throws on either plant, single ones and batches, and load recorded throws."""
