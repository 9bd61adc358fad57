"""What can be said of logs before any model is asked."""
