"""What people look at: recordings for rerun, strips, scatter plots, tables, pages."""
