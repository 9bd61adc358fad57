"""Export of a policy's network for other programs."""
