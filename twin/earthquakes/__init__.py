"""The twin of the table, and the drive by which the table follows a record."""
