"""The whole throw as a model to diagnose: windows, initial states, replay, derivatives."""
