"""Training: the task as an environment, its rewards and ends, the trainer and its progress."""
