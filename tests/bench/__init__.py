"""Measurements that stand behind records of this repository:

``python -m tests.bench.NAME --help``.
"""
