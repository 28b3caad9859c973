"""The outside world: one encoder, one link, one log, one view."""
