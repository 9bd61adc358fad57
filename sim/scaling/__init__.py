"""The plant in other units, and vehicles of one class drawn at any size."""
