"""How a machine card says what is wired where: one file for each kind of hardware, cards only."""
