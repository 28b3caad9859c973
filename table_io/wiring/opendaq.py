"""An openDAQ device."""

from table_io.card import Card


class OpenDaqWiring(Card):
    """What is wired where."""
