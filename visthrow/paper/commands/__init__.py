"""Commands that reproduce the paper, one module for each."""
