"""A target that speaks our UDP packets."""

from table_io.card import Card


class UdpWiring(Card):
    """What is wired where."""
