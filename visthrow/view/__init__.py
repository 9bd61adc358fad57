"""Output for people: recordings for rerun and Foxglove, pictures, tables and pages."""
