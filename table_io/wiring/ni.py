"""An NI-DAQmx device."""

from table_io.card import Card


class NiWiring(Card):
    """What is wired where."""
