"""A controller that plays by itself; we follow it."""

from table_io.card import Card


class FollowWiring(Card):
    """What is wired where."""
