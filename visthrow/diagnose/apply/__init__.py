"""Extension of a configuration by a diagnosis."""
