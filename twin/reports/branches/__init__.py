"""Report of periodic branches: figures, tables and a page to explore them."""
