"""Plot style, panels and the shell of a page."""
