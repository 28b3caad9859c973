"""A run before it starts: configuration, plans of measured branches, folder, disk, pace."""
