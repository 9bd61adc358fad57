"""Real firmware in software with the simulator's vehicle behind it: its process, its set-up, the
bridge between the two.
"""
