"""Readers of log files, one module for each format: tables, autopilots, blackbox, recordings.

`visthrow.logs` selects the reader by the file's extension. A new reader needs a module here, and an
extension and a branch of ``read`` there."""
