"""A simulated machine in a process of its own: it plays, and watches its controller.

    controller (table_io/backends/machine.py)  <-- wire.py, over a socket -->  server.py, table.py

`table.py` decides, `server.py` has the sockets, `blackbox.py` remembers every sample. The machine
never trusts its controller: what it is told is checked, what it plays always ends still, at its
mean.
"""
