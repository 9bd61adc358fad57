"""The three steps of a tick (estimate, decide and act) and the parts that they share."""
