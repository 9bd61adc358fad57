"""Links: ports, MAVLink and MSP messages, and the clocks at both ends."""
