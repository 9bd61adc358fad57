"""Sources of poses with a common interface, live and recorded:

MAVLink, .tlog, .BIN, .ulg, CSV, motion-capture systems.

A source delivers raw poses in its own frames; `hil.poses.frames` converts them.
"""
