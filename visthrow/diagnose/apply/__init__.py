"""Extending a configuration by the effects and laws that a diagnosis found."""
