"""Commands that reproduce the paper, a module each."""
