"""Recordings of a run, and the logs, reports and views made from them."""
