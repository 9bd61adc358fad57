"""Control of a run: the tick from poses to a command, its states, latch, safety and landing."""
