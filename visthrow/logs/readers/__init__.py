"""Readers of log files, a kind a module: tables, autopilots, blackbox, and what other tools write."""
