"""A plan from the values a user gives, and as files: missions, GeoJSON, figures, picture."""
