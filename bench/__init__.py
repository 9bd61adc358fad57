"""Measurements that stand behind records of this repository:

``python -m bench.NAME --help``.
"""
