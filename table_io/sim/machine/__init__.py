"""Simulated machine in a separate process: plays the command and monitors its controller.

    controller (backends.machine.client)  <-- protocol.py, over a socket -->  server.py, table.py

`table.py` is the state machine, `server.py` has the sockets, `flight_recorder.py` records every
sample. The machine does not trust its controller: every message is validated, and whatever it plays
ends at rest at its mean.
"""
