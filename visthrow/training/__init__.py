"""Training: the task as an environment, the trainer and its progress."""
