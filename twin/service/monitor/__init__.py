"""`shaketwin monitor`: a running test on a terminal, for whoever stands at the endpoint.

`board` holds what is known of the run, `recent` its last second, `margins` how near the machine is
to what stops it; `panels` and `screen` draw them; `watching` is the shell with link and keyboard.
"""
