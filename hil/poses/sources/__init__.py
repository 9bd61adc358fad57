"""Sources of poses behind one face, live and replayed alike:

MAVLink, .tlog, .BIN, .ulg, CSV, motion-capture systems.

A source delivers raw poses in its own frames; `hil.poses.frames` converts them.
"""
