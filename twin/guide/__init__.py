"""User guide: Markdown pages, and pages generated from configs, commands and effects."""
