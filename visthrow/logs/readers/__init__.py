"""Readers of log files, a kind a module: tables, autopilots, blackbox, and what other tools write.

`visthrow.logs` opens a file by its ending with one of them: a new reader is a module here, an
ending and a branch of ``read`` there."""
