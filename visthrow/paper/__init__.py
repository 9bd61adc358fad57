"""Reproduce the paper's results: baseline, sweeps of trainings, report, and the committed records.

This room is optional: nothing outside it imports it. Records of speed are in `records/bench`, those
of accuracy in `records`, each with its command and commit; `visthrow bench records` prints them."""

from pathlib import Path

RECORDS = Path(__file__).with_name("records")
"""Committed records: ``throws`` (packed results), ``training`` (runs), ``findings`` (text)."""
